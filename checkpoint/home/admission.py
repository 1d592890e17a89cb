"""Admission to the journal, and the ends of turns there: as few rows as can be.

A message from outside counts once it is as safe as it has to be. An ask may be handled before that: nobody hears of it
until all of it is safe, and if its turn is over when it is written, both are one row. Messages of one type that come in
a row from one sender stand in one row, and so do the ends of turns in a row that have let nothing out, and that nobody
waits for.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError
from ...actors.exit_reasons import pack_exit
from ...actors.kernel import links
from ..inputs import RowPlace
from ..protocol import DOWN, EXIT, MESSAGE
from .disposal import lose

if TYPE_CHECKING:
    from ...actors.kernel.envelope import Ask, Item
    from ..inputs import Batch, Input, Turn
    from ..journal import Entry, Primitive
    from .switch import Switch

MOST_ENDS = 1_000
"""Turns whose ends become one row."""
MOST_INPUTS = 128
"""Messages that stand in one row."""
MOST_BYTES = 16 << 10
"""Bytes in a row from which on no more messages are added to it."""
PATIENCE = 1.0
"""Seconds that an ask whose time is over waits for the store; then nobody can say whether the next program knows."""


class InputRow:
    """Inputs that stand in one row of the journal, perhaps with the ends of their turns.

    More can be added until it is written: messages of one type from one sender, which wait for that (`held`) all of
    them or none.
    """

    __slots__ = ("_accepted", "_batches", "_ends", "_home", "_place", "_room", "sources")

    def __init__(self, home: Switch, source: Input) -> None:
        self._home, self._place = home, RowPlace([])
        self.sources = [source]
        self._room = MOST_BYTES - len(source.body)
        self._ends: dict[int, tuple[Primitive, ...]] = {}
        self._batches: dict[int, Batch] = {}  # what follows from these ends
        self._accepted: dict[int, asyncio.Future[None]] = {}
        source.row = self._place

    def takes(self, source: Input) -> bool:
        """Have this input stand here, too; False if it may not."""
        sources, room = self.sources, self._room
        first = sources[0]
        if (
            room <= 0
            or len(sources) >= MOST_INPUTS
            or first.name != source.name
            or first.sender != source.sender
            or first.held != source.held
            or not first.kind == source.kind == MESSAGE
            or first.origin
            or source.origin
        ):
            return False
        sources.append(source)
        source.row = self._place
        self._room = room - len(source.body)
        return True

    def end(self, number: int, turn: Turn, batch: Batch) -> None:
        """The turn of an input is over before it is written; `batch` has what follows when both are safe."""
        _, _, _, status, _, *more = turn.entry(number)
        self._ends[turn.input.id] = (number, status, *more)
        self._batches[turn.input.id], batch.is_taken = batch, True

    @property
    def weight(self) -> int:
        """How many messages it is worth."""
        return len(self.sources)

    @property
    def entries(self) -> Sequence[tuple[str, Entry]]:
        """The row, with all that has been added until now."""
        sources, ends = self.sources, self._ends
        first = sources[0]
        if len(sources) == 1:
            return ((self._home.path, (*first.entry(), *ends.get(first.id, ()))),)
        inputs: list[Primitive] = []
        for source in sources:
            inputs += (source.id, source.time, source.body)
        row = ("ins", first.name, first.sender, tuple(inputs), *((key, *end) for key, end in ends.items()))
        return ((self._home.path, row),)

    def accepted(self, source: Input) -> asyncio.Future[None]:
        """For a sender that waits until its message counts."""
        future = self._accepted[source.id] = self._home.node.loop.create_future()
        return future

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._place.positions.append(positions[0])
        self._place.left = len(self.sources)
        self._home.outputs.rows.written(self)

    def safe(self) -> None:
        """Its inputs count, and are fed, or what their turns lead to takes effect."""
        for source in self.sources:
            try:
                if source.held:
                    self._home.admitted(source)
                elif self._batches and (batch := self._batches.get(source.id)) is not None:
                    batch.safe()
            except Exception as error:  # One's trouble is not another's.
                self._home.journal.commits.report(error)
        for future in self._accepted.values():
            if not future.done():
                future.set_result(None)

    def refused(self, error: HoldfastError) -> bool:
        """It was not written: nobody has heard of it. What comes from the runtime, and what was fed already, waits."""
        if not self.sources[0].held or self.sources[0].kind != MESSAGE:
            return False
        self._home.outputs.rows.written(self)
        for source in self.sources:
            source.row = None
            future = self._accepted.get(source.id)
            take_back(self._home, source, error, told=future is not None)
            if future is not None and not future.done():
                future.set_exception(error)
                future.exception()  # The sender may have gone.
        return True

    def abandoned(self, error: HoldfastError) -> None:
        """Nobody waits for what comes from the runtime itself; who waits for the end of a turn is told, also later."""
        self._home.outputs.rows.written(self)
        for batch in self._batches.values():
            batch.abandoned(error)


class QuietEnds:
    """The ends of turns in a row that have let nothing out: the same turns come of their inputs if it is lost."""

    weight = 1
    __slots__ = ("_first", "_home", "_inputs")

    def __init__(self, home: Switch, first: int, key: int) -> None:
        self._home, self._first = home, first
        self._inputs = [key]

    @property
    def entries(self) -> Sequence[tuple[str, Entry]]:
        """The row, with all turns that it has got until it is written."""
        return ((self._home.path, ("ends", self._first, tuple(self._inputs))),)

    def takes(self, number: int, key: int) -> bool:
        """Have the end of one more turn stand here, of this input; False if it does not follow, or there is no room."""
        count = len(self._inputs)
        if number != self._first + count or count >= MOST_ENDS:
            return False
        self._inputs.append(key)
        return True

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._home.ledger.shared.ends.setdefault(self._first + len(self._inputs) - 1, []).append(positions[0])
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
        self._row: InputRow | None = None  # for inputs
        self._ahead: dict[int, InputRow] = {}  # for the end of an input: it stands behind every end that there is

    def admit(self, source: Input) -> None:
        """Have an input journaled.

        Raises:
            HoldfastError: it comes from outside, and the store takes nothing now.
        """
        row = self._row
        if row is not None and row.takes(source):
            return
        row = InputRow(self._home, source)
        if source.kind != MESSAGE:
            self._home.journal.submit(row)
        else:
            try:
                self._home.journal.admit(row)
            except HoldfastError:
                _forget(self._home, source)
                raise
        self._row = row

    def accepted(self, source: Input) -> asyncio.Future[None] | None:
        """For a sender that waits until its message counts; None if nothing waits for that."""
        row = self._row
        return row.accepted(source) if row is not None and row.sources[-1] is source else None

    def let_ahead(self, ask: Ask, name: str, body: bytes, sender: str | None) -> bool:
        """Have an ask handled before it stands in the journal, if nothing that came earlier waits for that.

        What kills this process then takes the ask with it, as it takes whoever has asked.

        Raises:
            HoldfastError: the store takes nothing now.
        """
        home, life = self._home, self._home.life
        if not life.is_released or life.port is None or home.intake.bound is not None:
            return False
        if home.calls.rests.wanted or home.calls.long:
            return False
        commits = home.journal.commits
        last = home.intake.last
        if name not in home.shapes.noted or (last is not None and last.held and last.id in home.ledger.open):
            return False
        commits.check()
        source = home.ledger.admit(MESSAGE, name, body, home.node.clock.wall(), sender)
        home.awaits(source, ask)
        home.forward(source)  # In front of the submission: the loop comes to its turn before it comes to the store.
        row = self._row
        if row is None or not row.takes(source):
            self._row = row = InputRow(home, source)
            commits.submit(row)
        self._ahead[source.id] = row
        return True

    def end_quietly(self, number: int, key: int) -> None:
        """A turn has ended that has let nothing out."""
        if self._quiet is None or not self._quiet.takes(number, key):
            self.close()
            self._quiet = QuietEnds(self._home, number, key)
            self._home.journal.submit(self._quiet)

    def end_with_input(self, number: int, turn: Turn, batch: Batch) -> bool:
        """Have the end of a turn stand in the row of its input, if that is not written and in its place."""
        key = turn.input.id
        if batch.entries or turn.digests or key not in self._ahead:
            return False
        self._quiet = None
        for before in list(self._ahead):
            row = self._ahead.pop(before)
            if before == key:
                row.end(number, turn, batch)
                break
        return True

    def close(self) -> None:
        """What comes now stands in a row of its own, behind all there are."""
        self._quiet = self._row = None
        if self._ahead:
            self._ahead.clear()

    def written(self, row: InputRow) -> None:
        """A row of inputs can be added to no more."""
        if self._row is row:
            self._row = None
        if self._ahead:
            for source in row.sources:
                self._ahead.pop(source.id, None)

    def closed(self, quiet: QuietEnds) -> None:
        """A row of ends can be added to no more."""
        if self._quiet is quiet:
            self._quiet = None


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


class Withdrawal:
    """An input that is not begun any more, as the next program reads it; `then` hears once whether it will."""

    weight = 1
    __slots__ = ("_home", "_positions", "_source", "_then", "_timer")

    def __init__(self, home: Switch, source: Input, then: Callable[[bool], None]) -> None:
        self._home, self._source = home, source
        self._then: Callable[[bool], None] | None = then
        if source.positions is None:
            source.positions = []
        self._positions = source.positions
        self._timer: asyncio.TimerHandle = home.node.loop.call_later(PATIENCE, self._tell, False)

    @property
    def entries(self) -> Sequence[tuple[str, Entry]]:
        """What the next program reads."""
        return ((self._home.path, ("late", self._source.id)),)

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._positions += positions

    def safe(self) -> None:
        """What it has written outlives the program from now on."""
        self._tell(True)

    def refused(self, error: HoldfastError) -> bool:
        """It has happened: it waits."""
        return False

    def abandoned(self, error: HoldfastError) -> None:
        """The next program will not know."""
        self._tell(False)

    def _tell(self, lasts: bool) -> None:
        self._timer.cancel()
        then, self._then = self._then, None
        if then is not None:
            then(lasts)


def withdraw(home: Switch, source: Input, then: Callable[[bool], None]) -> None:
    """Have an input never begun that no life has begun; `then` hears, within a second, whether that will last."""
    commits = home.journal.commits
    source.is_late = True
    if not home.journal.durable:
        then(True)  # Nothing of it outlives this process.
    elif commits.blocked is not None or commits.stopped is not None:
        then(False)
    else:
        home.outputs.rows.close()
        home.journal.submit(Withdrawal(home, source, then))
