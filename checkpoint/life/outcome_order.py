"""The outcomes of the turn in hand: it hears them one after another, in the order in which they came first.

A handler may race what it waits for (`asyncio.wait`), and goes on with what comes first. A later life of its turn gets
all that is known as soon as it asks for it; so each outcome has its place in the journal, and is held until the handler
has had those before it, has had the time to act on them, and has let out what it had let out by then. A turn that only
asks gets what has come at once: on a busy loop the steps between two outcomes take long, and many are asked together.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from ...actors.kernel.cell import RUNNING
from ...actors.kernel.loop import TurnRemains
from ..protocol import GIVEN_UP, MESSAGE, STEPS, GivenUp, Outcome, untimed
from .recorded_context import Resting

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from .recorded_life import Life

PATIENCE: Final = 5.0
"""Seconds after which an outcome is told all the same: the handler has gone another way, as a comparison will show."""

Place = tuple[int, int]


class OutcomeOrder:
    """Tells one life the outcomes of its turn in hand, in order, and its home what the turn has given up.

    Attributes:
        due: outcomes that have come too early, by their place among those of the turn.
        is_used: whether there may be something to forget of the turn.
        has_rested: whether the turn has had an effect, or has waited for a moment or a message.
    """

    __slots__ = ("_given", "_handle", "_late", "_left", "_life", "due", "has_rested", "is_used")

    def __init__(self, life: Life) -> None:
        self._life = life
        self.due: dict[int, Outcome] = {}
        self.is_used = self.has_rested = False
        self._given = 0  # outcomes that the turn has heard
        self._late: list[Outcome] = []  # of which it had not heard at its end
        self._left = 0  # steps of the loop until the next one may be told
        self._handle: asyncio.Handle | None = None

    def begin(self) -> None:
        """A turn begins, which has heard nothing."""
        self.close()
        self.due.clear()
        self._given, self._late, self.is_used, self.has_rested = 0, [], False, False
        outcomes = self._life.waits.outcomes
        for place in [place for place, (future, _) in outcomes.items() if future.done()]:
            del outcomes[place]  # Given up, and nothing comes of it.

    def close(self) -> None:
        """Tell no further outcome: the turn in hand, or the life, is over."""
        self._left = 0
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def rests(self) -> None:
        """The turn has an effect from here on, or waits for a moment or a message: perhaps in a race."""
        self.has_rested = self.is_used = True

    # -- hearing ----------------------------------------------------------------------------------------------------

    def take(self, record: Outcome) -> None:
        """An outcome has come from home: tell it now, or when it is its turn."""
        life, nth = self._life, record.answer.nth
        if not nth or record.turn != life.turn or life.feed is None:
            life.hear(record)
        elif nth < 0:
            self._late.append(record)
            self.is_used = True
        elif nth <= self._given:
            life.hear(record)  # Whoever led before has told it, perhaps before the turn had come so far.
        else:
            self.due[nth], self.is_used = record, True
            self.go_on()

    def go_on(self) -> None:
        """Tell what may be told now."""
        life = self._life
        while self.due and not self._left:
            record = self.due.get(self._given + 1)
            if record is None or record.answer.after > life.last_k:
                if self._handle is None:
                    self._handle = life.cell.node.loop.call_later(PATIENCE, self._hurry)
                return
            self._tell(self._given + 1)

    def _tell(self, nth: int) -> None:
        life, record = self._life, self.due.pop(nth)
        self.close()
        self._given = nth
        if life.hear(record) and self.has_rested and life.waits.outcomes:
            self._left = STEPS  # Another one could come before the handler has acted on this.
            self._handle = life.cell.node.loop.call_soon(self._step)

    def _step(self) -> None:
        """One more step of the loop is over."""
        self._left -= 1
        if self._left:
            self._handle = self._life.cell.node.loop.call_soon(self._step)
        else:
            self._handle = None
            self.go_on()

    def _hurry(self) -> None:
        """The handler does not come to where it was when the next outcome came."""
        self._handle = None
        if self.due:
            self._tell(min(self.due))
            self.go_on()

    # -- giving up --------------------------------------------------------------------------------------------------

    def cancelled(self, place: Place) -> None:
        """What comes of an output is not awaited any more."""
        life = self._life
        if life.feed is not None and not life.stage.is_over and place[0] == life.turn and place in life.waits.outcomes:
            self.give_up(place)  # Else the life is over, or the turn was left: the next life waits on.

    def give_up(self, place: Place) -> None:
        """Tell the home that the turn in hand waits no more for what comes of its output, if the handler says so.

        What is cancelled because the turn is killed is wanted by the next life: a `TaskGroup` cancels its tasks then,
        and what comes meanwhile finds nobody.
        """
        if not is_killed(self._life.cell):
            self._life.port.to_home(GivenUp(*place))

    def ignored(self, record: Outcome) -> None:
        """An outcome has come that its turn had given up: a message that was taken for it is somebody else's."""
        life = self._life
        if life.feed is not None and record.turn == life.turn and untimed(record.answer)[0].kind == MESSAGE:
            self.give_up((record.turn, record.k))

    def end_turn(self) -> None:
        """The turn in hand ends: it gives up what it rests for still, and what it did not hear comes now."""
        life, late = self._life, self._late
        for place, (future, _) in list(life.waits.outcomes.items()):
            if place[0] == life.turn and isinstance(future, Resting) and (not future.done() or future.cancelled()):
                self.give_up(place)
        self.close()
        self._late = []
        for record in late:
            life.hear(record)


def is_killed(cell: Cell) -> bool:
    """Whether the turn in hand is killed: it is being cancelled, or has ended so, and its life ends."""
    if cell.state is not RUNNING:
        return True  # A turn that ends by itself has done so before its life winds down.
    more, queue = cell.more, cell.queue
    turn = None if more is None else more.turn
    if turn is None and queue and isinstance(queue[0], TurnRemains):
        turn = queue[0].turn
    return turn is not None and turn.killed


def is_given_up(record: Outcome) -> bool:
    """Whether nothing has come of an output, as an earlier life of its turn has given it up: so will this one."""
    return record.answer.kind == GIVEN_UP
