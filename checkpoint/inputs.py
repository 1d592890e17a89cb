"""The records a home keeps of one actor: inputs, ended turns, timers, and the batch of one append."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import msgspec

from ..actors.errors import HoldfastError
from ..actors.kernel.envelope import Ask
from .journal import Entry
from .protocol import MESSAGE, PIPE, TICK, Feed

if TYPE_CHECKING:
    from .group_commit import Commits, Unkept

HomeJournal: TypeAlias = "Commits | Unkept"
"""What a home writes to."""
OVERHEAD = 200
"""Bytes an input is counted with besides its payload."""
EXPIRED = 1e-9
"""A deadline that has passed. (Asks forget theirs when they expire.)"""


NO_DIGESTS: list[int] = []
"""Of a turn that has let nothing out. Never added to."""


class RowPlace(msgspec.Struct, gc=False, eq=False):
    """A row of the journal in which inputs stand: it stays until a snapshot contains all of them.

    Attributes:
        positions: where it stands; none until it is written.
        left: how many of its inputs no snapshot contains.
        over: the others.
    """

    positions: list[int]
    left: int = 0
    over: tuple[int, ...] = ()


class Input(Feed, gc=False, eq=False):
    """One journaled input: what is fed, and what its home knows of it.

    A life in the process of its home gets the input itself, if there is no more to say; another one what `feed` makes.
    (Not seen by the garbage collector: there can be many, and nothing here refers back.)

    Attributes:
        ask: who waits for its answer.
        deliveries: deaths of the process in this very turn.
        positions: of rows of its own, if it has any.
        row: that it shares, perhaps.
        held: whether it is not as safe yet as it has to be: it must not be fed.
        was_cut: whether a life has ended in its turn.
        was_stashed: whether a turn has put it aside.
        is_late: whether it is not begun any more: whoever has asked was told so.
    """

    ask: Ask | None = None
    deliveries: int = 0
    positions: list[int] | None = None
    row: RowPlace | None = None
    held: bool = False
    was_cut: bool = False
    was_stashed: bool = False
    is_late: bool = False

    @property
    def size(self) -> int:
        """What it counts against the journal's limit, in bytes."""
        return len(self.body) + OVERHEAD

    @property
    def begins_by(self) -> float:
        """Until when its turn may begin, on the loop's clock (0: always): then whoever has asked has given up."""
        if self.is_late:
            return EXPIRED
        return 0.0 if self.ask is None else self.ask.deadline or EXPIRED

    def entry(self) -> Entry:
        """Its entry in the journal."""
        return "in", self.id, self.kind, self.name, self.body, self.time, self.sender, self.origin

    def feed(
        self, turn: int = -1, pipes: tuple[int, ...] = (), *, has_begun: bool = False, was_asked: bool = False
    ) -> Feed:
        """As the life gets it.

        `was_asked`: it was an ask when it was handled first, and is replayed as one.
        """
        kind, origin = self.kind, self.origin
        if origin and kind not in (TICK, PIPE):
            origin = ""
        return Feed(
            self.id, turn, kind, self.name, self.body, self.time, self.sender,
            was_asked or self.ask is not None, self.chain, pipes, self.begins_by, origin, has_begun,
        )  # fmt: skip


class Turn(msgspec.Struct, gc=False, eq=False):
    """One ended turn since the last snapshot."""

    input: Input
    status: str
    digests: list[int]
    state: int = 0  # digest of the state it has left, if that is checked
    reply: int = 0  # digest of its reply, if it was asked for one

    def entry(self, number: int) -> Entry:
        """Its entry in the journal: of the state and the reply only what there is to say."""
        more = (self.state, self.reply) if self.reply else (self.state,) if self.state else ()
        return "end", number, self.input.id, self.status, tuple(self.digests), *more


class Contained(NamedTuple):
    """What of a journal a snapshot contains.

    Attributes:
        turn: after which it was made.
        inputs: those that have ended by then.
        rows: that inputs share, each with those of them that it contains and that no earlier one has contained.
    """

    turn: int
    inputs: Sequence[Input] = ()
    rows: Mapping[RowPlace, list[int]] = {}


def spread(entry: Entry) -> Iterable[tuple[Any, ...]]:
    """The inputs of a row, each as if it had one of its own; anything else as it is.

    >>> for one in spread(("ins", "app:Note", None, (4, 0.5, b"a", 5, 0.5, b"b"), (4, 9, "ok"))):
    ...     print(one)
    ('in', 4, 'message', 'app:Note', b'a', 0.5, None, '', 9, 'ok')
    ('in', 5, 'message', 'app:Note', b'b', 0.5, None, '')
    """
    values: tuple[Any, ...] = entry
    if values[0] != "ins":
        yield entry
        return
    _, name, sender, inputs, *ended = values
    ends = {key: end for key, *end in ended}
    for key, time, body in zip(inputs[::3], inputs[1::3], inputs[2::3], strict=True):
        yield "in", key, MESSAGE, name, body, time, sender, "", *ends.get(key, ())


class TimerState:
    """A timer of the actor; its clock runs here, whoever lives."""

    __slots__ = ("body", "due", "handle", "interval", "name")

    def __init__(self, name: str, body: bytes, due: float, interval: float) -> None:
        self.name, self.body, self.due, self.interval = name, body, due, interval
        self.handle: asyncio.TimerHandle | None = None


class Batch:
    """What becomes one append, and what happens when it is safe.

    Attributes:
        is_taken: whether somebody else has it take effect.
    """

    weight = 1
    __slots__ = ("after", "asks", "entries", "is_taken", "sinks")

    def __init__(self) -> None:
        self.is_taken = False
        self.asks: list[Ask] = []  # what it answers when it is safe
        self.entries: list[tuple[str, Entry]] = []
        self.sinks: list[list[int]] = []
        self.after: list[Callable[[], None]] = []

    def add(self, path: str, entry: Entry, sink: list[int]) -> None:
        """One more entry, of a home that keeps a journal; `sink` gets its position."""
        self.entries.append((path, entry))
        self.sinks.append(sink)

    def commit(self, journal: HomeJournal, *, is_patient: bool = False) -> None:
        """Have all of it appended; then it takes effect. `is_patient`: it need not be appended by itself."""
        if self.entries:
            journal.submit(self, is_patient=is_patient)
        elif not self.is_taken:
            self.safe()

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        for sink, position in zip(self.sinks, positions, strict=True):
            sink.append(position)

    def safe(self) -> None:
        """Let the batch take effect, in order."""
        for effect in self.after:
            effect()

    def refused(self, error: HoldfastError) -> bool:
        """It has happened: it waits."""
        return False

    def abandoned(self, error: HoldfastError) -> None:
        """What it was to answer is answered with the error: whether it has happened is seen when the store is back."""
        for ask in self.asks:
            ask.fail(error)
