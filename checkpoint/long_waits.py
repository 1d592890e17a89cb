"""What turns of a recorded actor wait for in days: moments and messages. Clocks run, and messages come, at home."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import msgspec

from ..actors.errors import UnknownMessage, WaitTimeout
from ..actors.kernel.cell import TurnRest
from ..actors.kernel.message import message_name
from .inputs import Batch, Input
from .protocol import MESSAGE, MOMENT, REPLY, SINCE_THEN, Answer, Glance, Glanced, Out, timed

if TYPE_CHECKING:
    from .home.switch import Switch
    from .journal import Entry

LONGEST: Final = 3600.0
"""Seconds after which a longer wait looks at its clock again: that may have been set, or the machine has slept."""
HAD: Final = Answer(REPLY, "", msgspec.msgpack.encode(None))
"""What the sender of a message gets that a turn has waited for."""

Place: TypeAlias = tuple[int, int]
"""A turn, and the number of its output."""


def is_span(out: Out) -> bool:
    """Whether a wait is over after so many seconds, and not at a moment, or never."""
    return (out.verb == "sleep" and out.to == SINCE_THEN) or (out.verb == "wait" and out.seconds > 0)


def span_of(out: Out) -> float:
    """Seconds after which a wait is over; 0.0 if it ends at a moment, or never."""
    return out.seconds if is_span(out) else 0.0


def due_entry(turn: int, k: int, when: float) -> Entry:
    """What the journal has of when the wait of output (turn, k) has begun: that moment and its span, in Unix time."""
    return "due", turn, k, when


class LongWaits:
    """What the turn in hand at one home waits for. It ends with the life; the next one's turn waits again.

    A wait of so many seconds goes by a clock that nobody sets, over all lives of this program. What is left of it in
    the next program only the wall clock tells; it is never more than those seconds.
    """

    __slots__ = ("_clocks", "_ends", "_home", "_since", "taken", "wanted")

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._clocks: dict[Place, asyncio.TimerHandle] = {}
        self._since: dict[Place, float] = {}  # when the turn in hand first came there, in whichever life
        self._ends: dict[Place, tuple[float, bool]] = {}  # until when, on that clock; True: on the wall clock
        self.taken: dict[Place, Input] = {}  # the messages that the turn in hand has waited for
        self.wanted: dict[Place, str] = {}  # "A|B": types of messages, "": a moment; in the order of the waits

    @property
    def is_busy(self) -> bool:
        """Whether the turn in hand waits for a moment or a message."""
        return bool(self.wanted)

    def fix(self, turn: int, out: Out, batch: Batch) -> None:
        """Since when and until when a turn waits is fixed when it first wants to, for all of its lives."""
        home = self._home
        if is_span(out):
            self._ends[turn, out.k] = home.node.clock.passed() + out.seconds, False
        when = home.ledger.waits.dues[turn, out.k] = home.node.clock.wall() + span_of(out)
        home.note(turn, due_entry(turn, out.k, when), batch)

    def begin(self, turn: int, key: int, out: Out) -> None:
        """The turn with input `key` waits: until a moment, or for a message, for which there may be a time limit."""
        place = turn, out.k
        if place in self.wanted:
            return
        names = out.name if out.verb == "wait" else ""
        if names:
            source = next((one for one in self._home.ledger.open.values() if self._suits(one, names, key)), None)
            if source is not None:
                self._take(place, source)
                return
        self.wanted[place] = names
        self._since = {known: when for known, when in self._since.items() if known[0] == turn}
        self._ends = {known: when for known, when in self._ends.items() if known[0] == turn}
        clock = self._home.node.clock
        due = self._home.ledger.waits.dues.get(place)
        if place not in self._since:
            begun = clock.wall() if due is None else due - span_of(out)
            self._since[place] = clock.passed() - max(0.0, clock.wall() - begun)
        if is_span(out):
            if place not in self._ends:  # Another program has begun to wait.
                left = (due or 0.0) - clock.wall()
                self._ends[place] = clock.passed() + min(left, out.seconds), False
            self._look(place)
        elif not names:
            self._ends[place] = out.seconds, True
            self._look(place)
        if self.wanted:
            self.show(self._home.ledger.open.values())

    def _suits(self, source: Input, names: str, running: int) -> bool:
        """Whether an input is a message that a turn waits for, and nobody has begun it."""
        is_free = source.kind == MESSAGE and source.id != running and not source.held
        is_wanted = is_free and self._is_of(source, names) and source.id not in self._home.ledger.stashed()
        return is_wanted and not self._is_given_up(source)

    def _is_of(self, source: Input, names: str) -> bool:
        """Whether a message is of one of these types, or, as far as that is known here, of one that derives from it."""
        wanted, cell = names.split("|"), self._home.cell
        if source.name in wanted:
            return True
        if not names or cell is None:
            return False
        try:
            kind = cell.table.kind_named(source.name)
        except UnknownMessage:
            return False
        return any(message_name(base) in wanted for base in kind.__mro__)

    def _is_given_up(self, source: Input) -> bool:
        """Whether nobody waits any more for what an input was to lead to."""
        return bool(source.begins_by) and self._home.node.clock.is_past(source.begins_by)

    def takes(self, source: Input) -> bool:
        """Whether a message that has come is what a turn waits for; it has it then."""
        if source.kind != MESSAGE:
            return False
        place = next((place for place, names in self.wanted.items() if self._is_of(source, names)), None)
        if place is None or self._is_given_up(source):
            return False
        self._take(place, source)
        return True

    def _take(self, place: Place, source: Input) -> None:
        """The message is no input any more, but an outcome of the turn, in one append."""
        home, batch = self._home, Batch()
        self.withdraw(place)
        self.taken = {known: one for known, one in self.taken.items() if known[0] == place[0]} | {place: source}
        home.end_without_turn(source, HAD if source.ask is not None else Answer(), batch)
        outcome = timed(Answer(MESSAGE, source.name, source.body), home.node.clock.wall())
        home.calls.outcome(*place, outcome, batch)
        batch.commit(home.journal)

    def _look(self, place: Place) -> None:
        """End the wait of this place, if it is time; else look again later."""
        home = self._home
        when, is_moment = self._ends[place]
        clock = home.node.clock
        left = when - (clock.wall() if is_moment else clock.passed())
        if left > 0:
            self._clocks[place] = home.node.loop.call_later(min(left, LONGEST), self._look, place)
            return
        names = self.wanted[place]
        self.withdraw(place)
        if not names:
            answer = Answer(MOMENT)
        else:
            answer = Answer(*home.node.codec.encode_error(WaitTimeout(home.path, names.replace("|", " or "))))
        home.calls.outcome(*place, timed(answer, clock.wall()), None)

    def withdraw(self, place: Place) -> None:
        """Wait no more for what this output of the turn waits for, if anything."""
        clock = self._clocks.pop(place, None)
        self.wanted.pop(place, None)
        if clock is not None:
            clock.cancel()

    def rests(self) -> list[TurnRest]:
        """What the turn in hand waits for, since when and until when."""
        clock = self._home.node.clock
        ago = clock.wall() - clock.passed()  # Unix time at the beginning of the other clock
        found: list[TurnRest] = []
        for place, names in self.wanted.items():
            when, is_moment = self._ends.get(place, (None, True))
            until = when if when is None or is_moment else when + ago
            kind: Literal["wait", "sleep"] = "wait" if names else "sleep"
            found.append(TurnRest(kind, names.replace("|", " or "), self._since[place] + ago, until))
        return found

    def abandon(self) -> None:
        """Wait for nothing any more, since the life is over."""
        for place in list(self.wanted):
            self.withdraw(place)

    # -- asks that change nothing -----------------------------------------------------------------------------------

    def show(self, sources: Iterable[Input]) -> None:
        """Have the life answer those of these inputs beside its turn that are asks and change nothing.

        Not while a turn that had begun in an earlier life comes so far again: what was seen then is not unseen.
        """
        home = self._home
        if home.life.port is None or not home.life.is_released:
            return
        if home.life.owed and not home.life.is_as_far:
            return
        for source in sources:
            if source.ask is not None and not source.ask.is_done and self._home.changes_nothing(source):
                source.ask.started = True
                home.life.port.to_life(Glance(source.feed()))

    def glanced(self, record: Glanced) -> None:
        """Such an ask has its answer: it is no input any more."""
        source = self._home.ledger.open.get(record.id)
        if source is not None and self._home.changes_nothing(source):
            batch = Batch()
            self._home.end_without_turn(source, record.answer, batch)
            batch.commit(self._home.journal)
