"""The leader's hand on the log: what its store does is appended in order, one record in flight, until it is refused.

An append that is not answered is sent again for as long as it takes: the log lets at most one copy in, because each
names its predecessor. If it is refused, what stands behind the predecessor says why: this very record, or the epoch of
another leader. Then this one has been deposed, and nothing of what was not acknowledged is in the log, or ever will be.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Sequence
from typing import Final, NamedTuple, TypeVar

from ..actors.errors import HoldfastError
from .log_records import BASE, CHANGES, EPOCH, DamagedLog, RecordMaker, decode_epoch, encode_changes, read_part
from .ports import Engine, LogRecord, OutOfTurn, Unanswered
from .silence import SilenceOfServers
from .store_contents import Change, MemoryContents

MOST_BYTES: Final = 256 << 10
"""About how much is written in one go: what comes meanwhile waits for the next one."""
LEAST_BASE: Final = 4 << 20
"""Bytes that the log has at least grown by before all that lives is written anew."""
FIRST_PAUSE, LONGEST_PAUSE = 0.02, 1.0
"""Seconds between attempts while the engine does not answer."""
T = TypeVar("T")


class Deposed(HoldfastError, text="epoch {epoch} is over: {leader} leads, in epoch {current}"):
    """Another leader's epoch stands in the log: this one can append nothing any more."""

    epoch: int
    current: int
    leader: str


class LogWrite(NamedTuple):
    """What is to be written, in its turn.

    Attributes:
        changes: of the store; none at all is only a look whether this leader still leads.
        size: about how many bytes they take.
        puts: blobs that they refer to, kept before.
        drops: blobs that nothing refers to behind them.
        base: all that lives at this moment, to be written anew.
    """

    changes: Sequence[Change] = ()
    size: int = 0
    puts: Sequence[tuple[str, bytes]] = ()
    drops: Sequence[str] = ()
    base: MemoryContents | None = None


class LogWriter:
    """Writes what a leader's store does to the log. All methods are for the loop of the engine, but `submit`.

    Args:
        engine: keeps the log.
        maker: of the leader's epoch.
        grown: bytes that the log has beside the newest base.
        silence: told when what is written is not answered, and when it is.
        written: told how many of the writes that were submitted stand in the log.
        want_base: called when it is worth writing all that lives anew: to submit that.

    Attributes:
        steps: how many records and large values the engine has taken.
        asked: since when the engine has not answered what is written now, on the loop's clock; inf: it owes nothing.
    """

    def __init__(
        self,
        engine: Engine,
        maker: RecordMaker,
        *,
        grown: int,
        silence: SilenceOfServers,
        written: Callable[[int], None],
        want_base: Callable[[], None],
    ) -> None:
        self._engine, self._maker, self.silence = engine, maker, silence
        self._written, self._want_base = written, want_base
        self._queue: deque[LogWrite] = deque()
        self._work = asyncio.Event()
        self._may_write = asyncio.Event()
        self._may_write.set()
        self._freed: deque[str] = deque()
        self._has_freed = asyncio.Event()
        self._done = self.steps = 0
        self.asked = math.inf
        self._grown, self._base_size = grown, 0
        self._base: Iterator[bytes] | None = None  # its further parts
        self._base_begins = 0
        self._is_base_wanted = False

    @property
    def after(self) -> int:
        """The number of the last record that this leader knows to stand in the log."""
        return self._maker.after

    # -- from the journal -------------------------------------------------------------------------------------------

    def submit(self, write: LogWrite) -> None:
        """Take in a write; from any thread. `wake` has to follow, on the engine's loop."""
        self._queue.append(write)

    def wake(self) -> None:
        """Have what was submitted written: nobody else tells the writer of it."""
        self._work.set()

    def hold(self) -> None:
        """Write nothing more for now, and only look: somebody else may be about to lead, or does so already."""
        self._may_write.clear()

    def go_on(self) -> None:
        """Write again, now that nobody else is about to lead."""
        self._may_write.set()

    # -- writing ----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Write what is submitted, for ever.

        Raises:
            Deposed: another leader has begun.
            DamagedLog: what stands in the log cannot be used.
        """
        while True:
            if not self._queue and self._base is None:
                await self._work.wait()
                self._work.clear()
            if not self._may_write.is_set():
                await self._look()
                continue
            if self._queue:
                await self._write_some()
            if self._base is not None:
                await self._write_base_part()

    async def _look(self) -> None:
        """See without an append whether another leads: whoever is held back would learn of it from nobody else.

        Raises:
            Deposed: another leads.
        """
        found = await behind(self._engine, self._maker.after, self.silence.unanswered)
        if found is not None:
            raise _deposed(found, self._maker.epoch)

    async def _write_some(self) -> None:
        """Write what has gathered, as one; a base on its own."""
        taken: list[LogWrite] = []
        size = 0
        while self._queue and size < MOST_BYTES and (not taken or self._queue[0].base is None):
            taken.append(self._queue.popleft())
            size += taken[-1].size
            if taken[-1].base is not None:
                break
        for write in taken:
            for name, data in write.puts:
                await self._insist(self._engine.blobs.put, name, data)
                self.steps += 1
        if taken[0].base is not None:
            await self._begin_base(taken[0].base)
        else:
            changes = (change for write in taken for change in write.changes)
            for record in self._maker.parts(CHANGES, encode_changes(changes)):
                await self._append(record)
        self._done += len(taken)
        self._written(self._done)
        for write in taken:
            self._freed.extend(write.drops)
        self._has_freed.set()
        if self._grown > max(LEAST_BASE, 2 * self._base_size) and not self._is_base_wanted:
            self._is_base_wanted = True
            self._want_base()

    async def _begin_base(self, contents: MemoryContents) -> None:
        """Write the first part of a base: what comes next in the queue stands behind it."""
        self._base = self._maker.parts(BASE, encode_changes(contents.as_changes()))
        self._grown = self._base_size = 0
        await self._write_base_part()
        self._base_begins = self._maker.after

    async def _write_base_part(self) -> None:
        assert self._base is not None
        record = next(self._base, None)
        if record is not None:
            await self._append(record)
            self._grown -= len(record)
            self._base_size += len(record)
        else:
            self._base, self._is_base_wanted = None, False
            with contextlib.suppress(Unanswered):  # The next base does it.
                await self._engine.log.forget(self._base_begins)

    async def drop_freed(self) -> None:
        """Drop the blobs to which nothing refers behind what is written, for ever; no write waits for that."""
        while True:
            await self._has_freed.wait()
            self._has_freed.clear()
            while self._freed:
                with contextlib.suppress(Unanswered):  # The next leader drops what nothing refers to.
                    await self._engine.blobs.drop(self._freed.popleft())

    # -- appending --------------------------------------------------------------------------------------------------

    async def _append(self, record: bytes) -> None:
        """Append one record behind the last one, as long as it takes."""
        self.asked = asyncio.get_running_loop().time()
        stands = await append_behind(self._engine, record, self._maker.after, unanswered=self._unanswered)
        self._taken()
        if not isinstance(stands, int):
            raise _deposed(stands, self._maker.epoch)
        self._maker.after = stands
        self.steps += 1
        self._grown += len(record)

    async def _insist(self, call: Callable[[str, bytes], Awaitable[None]], name: str, data: bytes) -> None:
        self.asked = asyncio.get_running_loop().time()
        await insist(lambda: call(name, data), self._unanswered)
        self._taken()

    def _unanswered(self, problem: str) -> None:
        self.silence.unanswered(problem, self.asked)

    def _taken(self) -> None:
        self.asked = math.inf
        self.silence.answered()


def pass_over(problem: str) -> None:
    """Tell nobody why there is no answer."""


async def insist(call: Callable[[], Awaitable[T]], unanswered: Callable[[str], None] = pass_over) -> T:
    """Call again and again until the engine answers; `unanswered` is told each time why it does not."""
    pause = FIRST_PAUSE
    while True:
        try:
            return await call()
        except Unanswered as error:
            unanswered(error.problem)
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)


async def append_behind(
    engine: Engine,
    record: bytes,
    after: int,
    patience: float = math.inf,
    unanswered: Callable[[str], None] = pass_over,
) -> int | LogRecord:
    """Append a record behind the one with the number `after`, however long it takes, up to so many seconds.

    `unanswered` is told each time why the engine does not answer.

    Returns:
        Its number; or, if another one stands there for good, that one.

    Raises:
        Unanswered: the engine has not answered for `patience` seconds. The record may stand there or not.
    """
    pause, loop = FIRST_PAUSE, asyncio.get_running_loop()
    until = loop.time() + patience
    while True:
        try:
            return await engine.log.append(record, after)
        except Unanswered as error:
            if loop.time() > until:
                raise
            unanswered(error.problem)
        except OutOfTurn:
            found = await behind(engine, after, unanswered)
            if found is not None:
                return found.sequence if found.data == record else found
        await asyncio.sleep(pause)  # Nothing there may be a stale answer, of one who has not come so far.
        pause = min(2 * pause, LONGEST_PAUSE)


def _deposed(found: LogRecord, epoch: int) -> Deposed | DamagedLog:
    """What it means that this record stands where one of that epoch was to stand."""
    part = read_part(found)
    if part.epoch <= epoch:
        return DamagedLog(found.sequence, f"two leaders have written in epoch {epoch}")
    leader = decode_epoch(part.data).leader if part.kind == EPOCH else "somebody"
    return Deposed(epoch, part.epoch, leader)


async def behind(engine: Engine, after: int, unanswered: Callable[[str], None] = pass_over) -> LogRecord | None:
    """The record that stands behind the one with that number, if the engine shows any now."""

    async def read() -> LogRecord | None:
        reader = await engine.log.read(after)
        try:
            records = await reader.next(LONGEST_PAUSE)
            return records[0] if records else None
        finally:
            await reader.close()

    return await insist(read, unanswered)
