"""A restart by order: a life ends in good order, and the supervisor begins the next one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..actors.control.orders import Ready
from ..actors.control.orders_lane import order
from ..actors.errors import AskTimeout, SpecError
from ..actors.exit_reasons import KILLED, SHUTDOWN, Crash, ExitReason
from ..actors.kernel.cell import Cell
from ..supervision.intensity import recent_restarts
from ..supervision.spec import ChildSpec
from ..supervision.supervisor import Supervisor
from .wire import NotEnded, NotUpYet

if TYPE_CHECKING:
    from ..system.system import ActorSystem

ASKED = Crash("holdfast.Restart", "an operator has asked for it")
"""The reason of a life that would not be followed by another one if it ended as when it is stopped."""


async def restart_actor(system: ActorSystem, path: str, timeout: float, *, at_once: bool = False) -> str:
    """End a life in good order, and wait until the next one is up; returns how it ended, in words.

    What waits at the address waits for the next life. With `at_once` the life is killed, in the middle of
    its turn, and the next one is not waited for.

    Raises:
        SpecError: nobody would start it again, or its supervisor is suspended, or would give up over it.
        NotUpYet: its life has ended, and the next one is not up within `timeout` seconds.
        NotEnded: it has not ended within `timeout` seconds, and will.
    """
    ref = system.ref(path)
    cell = ref._cell.living
    if cell.parent is None:
        raise SpecError(path, "the root is not restarted: end the program, and start it again")
    if cell.spec is None and cell.parent.actor is not None:
        raise SpecError(path, "no supervisor looks after it, so that it would not come back")
    reason: ExitReason = KILLED if at_once else SHUTDOWN
    if isinstance(cell.spec, ChildSpec):
        reason = KILLED if at_once else SHUTDOWN if cell.spec.restarts(SHUTDOWN) else ASKED
        if not cell.spec.restarts(reason):
            raise SpecError(path, f"its spec ({cell.spec.restart}) does not let it come back: stop it, and start it")
    above = cell.parent
    check_allowed(above, path)
    if (await system.get_status(above.ref, timeout=timeout)).state == "suspended":
        raise SpecError(path, f"{above.path} is suspended, and starts nobody: resume it first")
    try:
        ended = await system.terminate(ref, reason, timeout=timeout)
    except AskTimeout as late:
        raise NotEnded(path, timeout, f", for {late.turn}" if late.turn else "") from late
    if not at_once:  # The next life of one that is killed may hang as this one did: it is not asked.
        try:
            await order(ref._cell.living, Ready(), timeout)
        except AskTimeout as late:
            raise NotUpYet(path, str(ended), timeout, above.path) from late
    return str(ended)


def check_allowed(above: Cell, path: str) -> None:
    """Whether a supervisor has a restart left. Raises SpecError: it would give up, and end all below it."""
    actor = above.actor
    if not isinstance(actor, Supervisor) or "_flags" not in actor.__dict__:
        return  # It lives in another process, and only it knows.
    flags = actor._flags
    recent = recent_restarts(actor._restarts, above.node.loop.time(), flags.period)
    if len(recent) >= flags.intensity:
        used = f"{len(recent)} of {flags.intensity} restarts within {flags.period:g} s are used up"
        raise SpecError(path, f"{above.path} would give up over its restart ({used}): wait, or allow more of them")
