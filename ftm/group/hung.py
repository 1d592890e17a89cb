"""Turns and bricks that do not end, though their process lives.

A turn is tried once more, and then its message is put aside. Another replica tries; if there is none, the same one,
from the state before.
Attempts are counted here, at the home's input, as deaths in the turn of a message are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from ...actors.errors import HoldfastError
from ...checkpoint.home.disposal import put_into_quarantine
from ...checkpoint.protocol import FAILED
from ..bricks.replica_orders import Computes, Doing, EndTurn, Stalled
from ..events import TurnHung

if TYPE_CHECKING:
    import asyncio

    from ...checkpoint.protocol import TurnEnd
    from .group import Group

MOST = 2
"""Attempts after which it is the message, and not who handles it."""
ANSWERED_WITHIN = 5.0
"""Seconds after which a replica that was told to end a turn is told again."""
STUCK_AFTER: Final = 5.0
"""Seconds that the bricks have for what has come to them."""
ASKED_WITHIN: Final = 2.0
"""Seconds that a replica has, besides, to say how that went."""


class Stuck:
    """Which inputs have held up a replica, and which are to be put aside."""

    def __init__(self, group: Group) -> None:
        self._group = group
        self._counted: set[tuple[int, int]] = set()  # epoch and input
        self._given_up: set[int] = set()
        self._telling: asyncio.Future[Any] | None = None

    def told(self, stalled: Stalled) -> None:
        """A replica says that the turn of an input has taken it too long."""
        group, name, number = self._group, stalled.name, stalled.number
        life = group.life_of(name)
        if stalled.epoch != group.epoch or group.members.get(name) != life:
            return
        if name != group.primary:
            # A follower may wait for what the one that leads has not got either: that one is looked at then.
            if group.primary is not None and number not in group.switch.open:
                self._suspect(name, life, number)
            return
        source = group.switch.open.get(number)
        if source is None:
            return  # Its end is known: the turn is over by now.
        self._counted = {one for one in self._counted if one[1] in group.switch.open}
        if (group.epoch, number) not in self._counted:
            self._counted.add((group.epoch, number))
            source.deliveries += 1
            group.node.emit(TurnHung(group.path, name, group.epoch, source.name, source.deliveries))
        if source.deliveries >= min(MOST, group.switch.method.max_deliveries):
            self._given_up.add(number)
            self._tell(name, number, again=False)
        elif group.backups():
            self._suspect(name, life, number)
        else:
            self._tell(name, number, again=True)

    def _suspect(self, name: str, life: int, number: int) -> None:
        self._group.suspect(name, life, f"it does not end the turn of input {number}")

    def _tell(self, name: str, number: int, *, again: bool) -> None:
        """Have it end the turn; if that gets lost, it will be heard of again."""
        if self._telling is not None and not self._telling.done():
            return
        group = self._group
        try:
            self._telling = group.protocol(name).ask(EndTurn(group.epoch, number, again), ANSWERED_WITHIN)
        except HoldfastError:
            return  # It has died.
        attempt = group.epoch, number

        def told(done: asyncio.Future[Any]) -> None:
            if not done.cancelled() and done.exception() is None and again:
                self._counted.discard(attempt)  # What is heard of it from now on is another one.

        self._telling.add_done_callback(told)

    def takes(self, end: TurnEnd) -> bool:
        """Whether this turn was ended because it hung: its message is put aside."""
        if end.id not in self._given_up:
            return False
        self._given_up.discard(end.id)
        source = self._group.switch.open.get(end.id)
        if source is None or end.status != FAILED:
            return False
        put_into_quarantine(self._group.switch, source)
        return True


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
