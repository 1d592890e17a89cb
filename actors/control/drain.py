"""Draining: an actor handles what is queued before it is stopped."""

from __future__ import annotations

from ..errors import ActorStopped, AskFailed, AskTimeout
from ..kernel import mailbox
from ..kernel.cell import GONE, Cell
from .orders import Mark
from .orders_lane import order


async def drain(cell: Cell, seconds: float) -> bool:
    """Have what is queued handled, and let nothing new in: asks fail with ActorStopped, tells are dead letters.

    What the actor tells itself meanwhile is handled, too. It goes on over restarts. A suspended actor handles nothing,
    so there only the time passes.

    Returns:
        Whether all was handled within `seconds`. If so or not: nothing is let in from now on.
    """
    cell.extra()
    clock, before = cell.node.loop.time, cell.admit
    end = clock() + seconds
    try:
        while not cell.is_dead:
            cell.admit = mailbox.admit_closing  # Each time: a life that begins may have opened it.
            left = end - clock()
            if left <= 0:
                return False
            try:
                behind = await order(cell, Mark(), left)
            except AskFailed:  # Its process has ended: what it had not begun is handled by the next life.
                continue
            except AskTimeout:
                return False
            if not behind and cell.host.backlog(cell) == 0:
                return True
    except ActorStopped:
        pass
    except BaseException:  # Whoever wanted the stop does not want it any more.
        if cell.state is not GONE:
            cell.admit = before
        raise
    return True
