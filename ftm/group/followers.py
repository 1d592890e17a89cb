"""Followers: nobody waits for the bricks of a replica that does not lead, so somebody has to look at them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ..bricks.replica_orders import Computes, Doing

if TYPE_CHECKING:
    from .group import Group

STUCK_AFTER: Final = 5.0
"""Seconds that the bricks have for what has come to them."""
ASKED_WITHIN: Final = 2.0
"""Seconds that a replica has, besides, to say how that went."""


async def end_stuck(group: Group) -> str | None:
    """Have a follower replaced whose bricks have let nothing pass, though its actor does nothing; its name.

    Raises:
        HoldfastError: one has not answered. If it has died, that is seen elsewhere; else it is asked once more.
    """
    for name in group.backups():
        seconds, starved = STUCK_AFTER + group.at_work(name), group.starved(name)
        life, order = group.members.get(name, 0), Computes(group.switch.turn, seconds)
        doing: Doing = await group.protocol(name).ask(order, seconds + ASKED_WITHIN)
        if doing.passes or doing.computes or name not in group.backups() or group.members.get(name) != life:
            continue
        if group.starved(name) - starved < seconds / 2:  # Else it was no fault of theirs.
            why = f"its bricks have let nothing pass for {STUCK_AFTER:g} s"
            group.at_fault(name, why)
            group.suspect(name, life, why)
            return name
    return None
