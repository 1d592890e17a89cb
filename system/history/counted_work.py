"""What an actor has done, read from counts that are kept anyway: no turn pays for the history."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...checkpoint.home.recorded_home import switch_of
from .past_event import Plain

if TYPE_CHECKING:
    from ...actors.kernel.node import Node

COUNTED = frozenset(
    {"ActorStarted", "ActorCrashed", "ChildStopped", "ChildTerminated", "EndedByLink", "FailedOver", "ProcessDied"}
)
"""Events at which a life begins or ends."""


def count_work(node: Node, address: str) -> dict[str, Plain]:
    """The turns at an address so far, `turns`, and the longest of the present life, as far as somebody counts them.

    The journal numbers the turns of recorded and protected actors. Of others they are counted while their statistics
    are on, and then the longest turn is measured too; in a process of their own that count ends with the process.
    """
    cell = node.find(address)
    if cell is None:
        return {}
    found: dict[str, Plain] = {}
    tap = cell.more.tap if cell.more is not None else None
    if tap is not None and tap.counting and cell.host.place.is_here:
        found["turns"] = tap.counts().turns
        message, seconds = tap.slowest
        if message:
            found["longest_turn"], found["longest_message"] = seconds, message
    switch = switch_of(cell)
    if switch is not None:
        found["turns"] = max(0, switch.turn)
    return found
