"""Finds turns and bricks that do not end although their process lives, and has them replaced or put aside.

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

    from ...checkpoint.home.switch import Switch
    from ...checkpoint.protocol import TurnEnd
    from .replicas import Replicas

ANSWERED_WITHIN = 5.0
"""Seconds after which a replica that was told to end a turn is told again."""
STUCK_AFTER: Final = 5.0
"""Seconds that the bricks have for what has come to them."""
ASKED_WITHIN: Final = 2.0
"""Seconds that a replica has, besides, to say how that went."""


class Stuck:
    """Which inputs have held up a replica, and which are to be put aside."""

    def __init__(self, replicas: Replicas, switch: Switch) -> None:
        self._replicas, self._switch = replicas, switch
        self._counted: set[tuple[int, int]] = set()  # epoch and input
        self._given_up: set[int] = set()
        self._telling: asyncio.Future[Any] | None = None

    def told(self, stalled: Stalled) -> None:
        """A replica says that the turn of an input has taken it too long."""
        replicas, known, waiting = self._replicas, self._replicas.membership, self._switch.open
        name, number = stalled.name, stalled.number
        life, why = replicas.life_of(name), f"it does not end the turn of input {number}"
        if stalled.epoch != known.epoch or known.members.get(name) != life:
            return
        source = waiting.get(number)
        if name != known.primary:
            # A follower may wait for what the one that leads has not got either: that one is looked at then.
            if known.primary is not None and source is None:
                replicas.suspect(name, life, why)
            return
        if source is None or self._switch.rests_in(number):
            return  # Its end is known: the turn is over by now. Or it waits until a moment, as it wants.
        self._counted = {one for one in self._counted if one[1] in waiting}
        if (known.epoch, number) not in self._counted:
            self._counted.add((known.epoch, number))
            source.deliveries += 1
            replicas.node.emit(TurnHung(replicas.path, name, known.epoch, source.name, source.deliveries))
        if source.deliveries >= self._switch.method.most_deliveries(has_hung=True):
            self._given_up.add(number)
            self._tell(name, number, again=False)
        elif replicas.backups():
            replicas.suspect(name, life, why)
        else:
            self._tell(name, number, again=True)

    def _tell(self, name: str, number: int, *, again: bool) -> None:
        """Have it end the turn; if that gets lost, it will be heard of again."""
        if self._telling is not None and not self._telling.done():
            return
        attempt = self._replicas.membership.epoch, number
        try:
            self._telling = self._replicas.ask(name, EndTurn(*attempt, again), ANSWERED_WITHIN)
        except HoldfastError:
            return  # It has died.

        def told(done: asyncio.Future[Any]) -> None:
            if not done.cancelled() and done.exception() is None and again:
                self._counted.discard(attempt)  # What is heard of it from now on is another one.

        self._telling.add_done_callback(told)

    def takes(self, end: TurnEnd) -> bool:
        """Whether this turn was ended because it hung: its message is put aside."""
        if end.id not in self._given_up:
            return False
        self._given_up.discard(end.id)
        source = self._switch.open.get(end.id)
        if source is None or end.status != FAILED:
            return False
        put_into_quarantine(self._switch, source)
        return True


async def end_stuck(replicas: Replicas, turn: int) -> str | None:
    """Have a follower replaced whose bricks have let nothing pass, though its actor does nothing; its name.

    `turn`: the last one that home knows of.

    Raises:
        HoldfastError: one has not answered. If it has died, that is seen elsewhere; else it is asked once more.
    """
    for name in replicas.backups():
        seconds, starved = STUCK_AFTER + replicas.at_work(name), replicas.starved(name)
        life = replicas.membership.members.get(name, 0)
        doing: Doing = await replicas.ask(name, Computes(turn, seconds), seconds + ASKED_WITHIN)
        is_same = name in replicas.backups() and replicas.membership.members.get(name) == life
        if doing.passes or doing.computes or not is_same:
            continue
        if replicas.starved(name) - starved < seconds / 2:  # Else it was no fault of theirs.
            replicas.blame(name, life, f"its bricks have let nothing pass for {STUCK_AFTER:g} s")
            return name
    return None
