"""Admission to the journal, and the ends of turns there: as few rows as can be.

A message from outside counts once it is as safe as it has to be. An ask may be handled before that: nobody hears of it
until all of it is safe, and if its turn is over when it is written, both are one row. Turns in a row that have let
nothing out, and that nobody waits for, have one row for all their ends.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError
from ...actors.exit_reasons import pack_exit
from ...actors.kernel import links
from ..protocol import DOWN, EXIT, MESSAGE
from .disposal import lose

if TYPE_CHECKING:
    from ...actors.kernel.envelope import Ask, Item
    from ..inputs import Batch, Input, Turn
    from ..journal import Entry
    from .switch import Switch

MOST_ENDS = 1_000
"""Turns whose ends become one row."""


class InputAdmission:
    """One input that stands alone in its submission, perhaps with the end of its turn."""

    __slots__ = ("_accepted", "_end", "_home", "_source", "entries")

    def __init__(self, home: Switch, source: Input) -> None:
        self._home, self._source = home, source
        self.entries = ((home.path, source.entry()),)
        self._accepted: asyncio.Future[None] | None = None
        self._end: Batch | None = None  # what follows from the end of its turn

    def end(self, number: int, turn: Turn, batch: Batch) -> None:
        """Its turn is over before it is written; `batch` has what follows when both are safe."""
        _, _, _, status, _, *more = turn.entry(number)
        self.entries = ((self._home.path, (*self._source.entry(), number, status, *more)),)
        self._end, batch.is_taken = batch, True

    def accepted(self) -> asyncio.Future[None]:
        """For a sender that waits until it counts."""
        self._accepted = self._home.node.loop.create_future()
        return self._accepted

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._source.positions.append(positions[0])
        self._home.outputs.rows.written(self._source)

    def safe(self) -> None:
        """It counts, and is fed, or what its turn leads to takes effect."""
        if self._source.held:
            self._home.admitted(self._source)
        elif self._end is not None:
            self._end.safe()
        if self._accepted is not None and not self._accepted.done():
            self._accepted.set_result(None)

    def refused(self, error: HoldfastError) -> bool:
        """It was not written: nobody has heard of it. What comes from the runtime, and what was fed already, waits."""
        if not self._source.held or not take_back(self._home, self._source, error, told=self._accepted is not None):
            return False
        if self._accepted is not None and not self._accepted.done():
            self._accepted.set_exception(error)
            self._accepted.exception()  # The sender may have gone.
        return True

    def abandoned(self, error: HoldfastError) -> None:
        """Nobody waits for what comes from the runtime itself; who waits for the end of a turn is told."""
        if self._end is not None:
            self._end.abandoned(error)


class QuietEnds:
    """The ends of turns in a row that have let nothing out: the same turns come of their inputs if it is lost."""

    __slots__ = ("_first", "_home", "_inputs")

    def __init__(self, home: Switch, first: int) -> None:
        self._home, self._first = home, first
        self._inputs: list[int] = []

    @property
    def entries(self) -> Sequence[tuple[str, Entry]]:
        """The row, with all turns that it has got until it is written."""
        return ((self._home.path, ("ends", self._first, tuple(self._inputs))),)

    def takes(self, number: int) -> bool:
        """Whether this turn follows on the others, and there is room."""
        return number == self._first + len(self._inputs) and len(self._inputs) < MOST_ENDS

    def add(self, key: int) -> None:
        """One more turn has ended; `key` is its input."""
        self._inputs.append(key)

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._home.ledger.rows.setdefault(self._first + len(self._inputs) - 1, []).append(positions[0])
        self._home.outputs.rows.closed(self)

    def safe(self) -> None:
        """Do nothing: quiet turns have let nothing out."""

    def refused(self, error: HoldfastError) -> bool:
        """It has happened: it waits."""
        return False

    def abandoned(self, error: HoldfastError) -> None:
        """Tell nobody, for nobody waits for a quiet turn."""


class TurnRows:
    """Which rows of the journal a home may still add to. What they stand for takes effect in the order of the rows."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._quiet: QuietEnds | None = None
        self._ahead: dict[int, InputAdmission] = {}  # by input, behind the end of every turn that has ended

    def let_ahead(self, ask: Ask, name: str, body: bytes, sender: str | None) -> bool:
        """Have an ask handled before it stands in the journal, if nothing that came earlier waits for that.

        What kills this process then takes the ask with it, as it takes whoever has asked.

        Raises:
            HoldfastError: the store takes nothing now.
        """
        home, life = self._home, self._home.life
        if not life.is_released or life.port is None or home.intake.bound is not None or home.calls.rests.wanted:
            return False
        commits = home.journal.commits
        last = home.intake.last
        if name not in home.shapes.noted or (last is not None and last.held and last.id in home.ledger.open):
            return False
        commits.check()
        source = home.ledger.admit(MESSAGE, name, body, home.node.clock.wall(), sender)
        source.positions, source.ask, source.chain = [], ask, ask.chain
        home.forward(source)  # In front of the submission: the loop comes to its turn before it comes to the store.
        self._ahead[source.id] = admission = InputAdmission(home, source)
        commits.submit(admission)
        return True

    def end_quietly(self, number: int, key: int) -> None:
        """A turn has ended that has let nothing out."""
        quiet = self._quiet
        if quiet is None or not quiet.takes(number):
            self.close()
            quiet = self._quiet = QuietEnds(self._home, number)
            self._home.journal.submit(quiet)
        quiet.add(key)

    def end_with_input(self, number: int, turn: Turn, batch: Batch) -> bool:
        """Have the end of a turn stand in the row of its input, if that is not written and in its place."""
        key = turn.input.id
        if batch.entries or turn.digests or key not in self._ahead:
            return False
        self._quiet = None
        for before in list(self._ahead):
            admission = self._ahead.pop(before)
            if before == key:
                admission.end(number, turn, batch)
                break
        return True

    def close(self) -> None:
        """What comes now stands in a row of its own, behind all there are."""
        self._quiet = None
        if self._ahead:
            self._ahead.clear()

    def written(self, source: Input) -> None:
        """The row of an input can be added to no more."""
        self._ahead.pop(source.id, None)

    def closed(self, quiet: QuietEnds) -> None:
        """A row of ends can be added to no more."""
        if self._quiet is quiet:
            self._quiet = None


def submit(home: Switch, source: Input) -> None:
    """Have an input journaled.

    Raises:
        HoldfastError: it comes from outside, and the store takes nothing now.
    """
    admission = InputAdmission(home, source)
    if source.kind != MESSAGE:
        home.journal.submit(admission)
        return
    try:
        home.journal.admit(admission)
    except HoldfastError:
        _forget(home, source)
        raise


def take_back(home: Switch, source: Input, error: HoldfastError, *, told: bool) -> bool:
    """The store refused an input; False if it has happened all the same. `told`: its sender hears of it."""
    if source.kind != MESSAGE:
        return False
    if _forget(home, source):
        ask, source.ask = source.ask, None
        if ask is not None:
            ask.started = False
            ask.fail(error)
        elif not told:
            lose(home, source, str(error))
    return True


def _forget(home: Switch, source: Input) -> bool:
    """An input was not admitted after all; False if it has ended meanwhile."""
    is_open = home.ledger.withdraw(source)
    if is_open and home.intake.bound is not None:
        home.intake.bound.ended(source)
    return is_open


def taken_up(home: Switch, item: Item) -> tuple[str, str, bytes] | None:
    """An EXIT or DOWN as the input that it becomes: kind, name and body; None if nobody waits for it any more.

    Raises:
        HoldfastError: it is something else.
    """
    if isinstance(item, links.Exit):
        data: dict[str, Any] = {"source": item.source.path, "reason": pack_exit(item.reason)}
        home.ties.over("link", item.source.path)
        return EXIT, "", msgspec.msgpack.encode(data)
    if not isinstance(item, links.Down):
        raise HoldfastError(f"{type(item).__name__} cannot be journaled for {home.path}")
    if not item.watch.active:
        return None
    verb, target = "watch" if item.watch.for_good else "monitor", item.watch.target.path
    data = {"source": target, "reason": pack_exit(item.reason), "recovering": item.recovering, "verb": verb}
    if not item.recovering:
        home.ties.over(verb, target)
    return DOWN, "", msgspec.msgpack.encode(data)
