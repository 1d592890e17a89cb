"""The journal of a leader: its store is in memory, and all that it does goes to the log, in order.

A call that writes changes the memory and is queued for the log at once, and nothing waits for that, except `sync`: what
has to be safe is safe when that returns. So the log always has a prefix of what was done, and whoever leads next begins
with such a prefix, which contains all that anybody was told of.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import uuid
import zlib
from collections.abc import Callable, Collection, Generator, Sequence
from typing import Final

import msgspec

from ..actors.errors import HoldfastError
from ..checkpoint.encoding.compression import LibraryMissing, compressor, decompress
from ..checkpoint.encoding.entry_codec import check_entry, is_plain
from ..checkpoint.journal import DamagedStore, Entry, SafeAt, Saved, StaleEpoch, StoreFailed
from ..checkpoint.snapshot.shared_blocks import Segment
from .engine_thread import EngineLoop, end_tasks
from .leadership import Leading
from .log_writer import FIRST_PAUSE, LONGEST_PAUSE, Deposed, LogWrite, LogWriter, insist
from .ports import Engine, LogGone, Unanswered
from .silence import SilenceOfServers
from .store_contents import Change
from .write_progress import BlobsUnderWay, Tell, WriteProgress

LARGE: Final = 64 << 10
"""Bytes of a snapshot from which on it is kept beside the log."""
MOST_UNSENT: Final = 64 << 20
"""Bytes beside the log that may wait to be sent, before whoever has more waits for them."""
MOST_FETCHED: Final = 256 << 20
"""Bytes of snapshots that are read before the tree is started."""
CLOSE_SECONDS: Final = 5.0
"""How long a journal that is closed waits for what is not in the log yet."""
READ_SECONDS: Final = 30.0
"""How long a read of something large waits for the engine."""
LOOK_SECONDS: Final = 2.0
"""How often it is looked whether the log answers while nothing is written."""
MOST_MISSES: Final = 2
"""Looks in a row that have to miss what was written last, before the log is gone: one may be an old answer."""
_ENTRY_BYTES: Final = 60  # about, beside its bodies


class PackedBlock(msgspec.Struct, array_like=True, gc=False):
    """A block of a large snapshot, as it is kept: where it is in its pack, and its bytes as `codec` has made them."""

    offset: int
    length: int
    codec: int
    crc: int
    data: bytes


class ReplicatedJournal:
    """A `Journal` whose log survives the loss of machines. All methods may be called from any thread.

    Args:
        engine: keeps the log.
        loop: on which the engine's work runs.
        leading: what this leader begins with.
        lost: told, on the engine's loop, why nothing can be written any more: another leads, or the log is damaged.
        silence: told when the log does not answer, and when it does again.
        patience: seconds in which the engine must have taken something when somebody waits for it in `sync`, so that a
            tool ends when the servers are away; a system waits for them.
    """

    durable = True
    in_hand = None
    safe_at: SafeAt = "sync"

    def __init__(
        self,
        engine: Engine,
        loop: EngineLoop,
        leading: Leading,
        *,
        lost: Callable[[HoldfastError], None] = lambda error: None,
        silence: SilenceOfServers | None = None,
        patience: float = math.inf,
    ) -> None:
        self.path = engine.name
        self.epoch = leading.maker.epoch
        self._engine, self._loop, self._lost, self._patience = engine, loop, lost, patience
        self._contents = leading.contents
        self._lock = threading.RLock()  # of the contents; the engine's loop, which keeps the lease, never waits for it
        self._joint: list[LogWrite] | None = None
        self._is_base_due = False
        self._count_lock = threading.Lock()  # of what follows
        self._progress = WriteProgress()
        self._blobs = BlobsUnderWay(name for name in leading.contents.kept() if isinstance(name, str))
        self._failure: HoldfastError | None = None
        self._is_open = True
        self._is_awake = False
        self._keeper = leading.keeper
        loop.wait(self._begin(leading, silence or SilenceOfServers(lambda problem: None, lambda seconds: None)))

    async def _begin(self, leading: Leading, silence: SilenceOfServers) -> None:
        self._writer = LogWriter(
            self._engine,
            leading.maker,
            grown=leading.grown,
            silence=silence,
            written=self._take_written,
            want_base=self._want_base,
        )
        self._leading = asyncio.ensure_future(self._lead())

    async def fetch(self) -> None:
        """Have the newest large snapshots in memory, however long the engine is away: a tree is about to need them.

        For the loop of the engine. What is over MOST_FETCHED is read when it is needed, and whoever needs it waits.
        """
        size = 0
        for kept in list(self._contents.snapshots.values()):
            name = kept[-1].data if kept else None
            if isinstance(name, str) and size < MOST_FETCHED:
                pause = FIRST_PAUSE
                while self._failure is None:  # Else another leads: nobody needs it.
                    try:
                        data = await self._engine.blobs.get(name)
                    except Unanswered:
                        await asyncio.sleep(pause)
                        pause = min(2 * pause, LONGEST_PAUSE)
                        continue
                    if data is not None:
                        self._blobs.fetched[name] = data
                        size += len(data)
                    break

    async def _lead(self) -> None:
        """Write, keep the lease and tidy up, until the journal is closed or another leads."""
        works = (
            self._writer.run(),
            self._writer.drop_freed(),
            self._keep_lease(),
            self._watch_log(),
            self._drop_orphans(),
        )
        tasks = [asyncio.ensure_future(work) for work in works]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        finally:
            await end_tasks(*tasks)  # Not by a group: that cancels only once, and a wait may miss it.
        causes = [error for task in tasks if not task.cancelled() and (error := task.exception()) is not None]
        if causes:
            cause = next((one for one in causes if isinstance(one, Deposed)), causes[0])
            failure: StaleEpoch | StoreFailed
            if isinstance(cause, Deposed):
                failure = StaleEpoch(self.path, epoch=cause.epoch, current=cause.current)
            else:  # Also what nobody expects of an engine: no sync may wait for a dead writer.
                failure = StoreFailed(self.path, f"{cause}" or type(cause).__name__)
            self._fail(failure)
            self._lost(cause if isinstance(cause, HoldfastError) else failure)
        await self._keeper.release()  # Whoever leads next need not wait for its end.

    async def _keep_lease(self) -> None:
        await self._keeper.run(hold=self._writer.hold, go_on=self._writer.go_on, look=lambda: self._queue(LogWrite()))

    async def _watch_log(self) -> None:
        """See now and then, while nothing comes into the log, whether it answers, and has what was written last.

        Raises:
            LogGone: it has not.
        """
        loop, writer = asyncio.get_running_loop(), self._writer
        steps, misses = writer.steps, 0
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            if writer.steps != steps:
                steps, misses = writer.steps, 0
                continue
            asked, after = loop.time(), writer.after
            try:
                last = await self._engine.log.last()
                gone = None if last is not None and last.sequence >= after else LogGone(f"the log of {self.path}")
            except LogGone as error:
                gone = error
            except Unanswered as error:
                writer.silence.unanswered(error.problem, asked)
                continue
            misses = misses + 1 if gone is not None else 0
            if gone is not None and misses >= MOST_MISSES:
                raise gone
            if gone is None and writer.asked == math.inf:
                writer.silence.answered()

    async def _drop_orphans(self) -> None:
        """Remove what earlier leaders have kept beside the log and nothing in it refers to."""
        names: set[str] = set()
        with contextlib.suppress(Unanswered):  # The next leader does it.
            names = await self._engine.blobs.names()
        with self._count_lock:
            orphans = self._blobs.orphans(names)
        if orphans:  # Once a look is written, nobody led before it who could have kept any of these since.
            self._queue(LogWrite(drops=sorted(orphans)))

    # -- from the engine's loop -------------------------------------------------------------------------------------

    def _take_written(self, count: int) -> None:
        """So many of the writes that were submitted stand in the log."""
        with self._count_lock:
            ready = self._progress.take(count)
            self._blobs.sent(count)
        for tell in ready:
            tell(None)

    def _fail(self, failure: HoldfastError) -> None:
        """Refuse everything from now on, and tell whoever waits."""
        with self._count_lock:
            self._failure = failure
            waiting = self._progress.give_up()
        for tell in waiting:
            tell(failure)

    def _want_base(self) -> None:
        self._is_base_due = True  # Whoever writes next has the lock, and copies what there is.

    # -- writing ----------------------------------------------------------------------------------------------------

    def _refuse_failed(self) -> None:
        """Raise why nothing can be written any more, if that is so.

        Raises:
            StaleEpoch, StoreFailed: it is.
        """
        failure = self._failure
        if failure is not None:
            raise type(failure)(*failure.args)
        if not self._is_open:
            raise StoreFailed(self.path, "it is closed")

    def _submit(self, write: LogWrite) -> None:
        """Queue a write for the log; the lock is held."""
        if self._joint is not None:
            self._joint.append(write)
            return
        self._queue(write)
        if self._is_base_due:
            self._is_base_due = False
            self._queue(LogWrite(base=self._contents.copy()))

    def _queue(self, write: LogWrite) -> None:
        with self._count_lock:
            self._progress.submitted += 1
            for name, data in write.puts:
                self._blobs.add(self._progress.submitted, name, data)
            self._writer.submit(write)
            is_awake, self._is_awake = self._is_awake, True
        if not is_awake:
            self._loop.soon(self._wake)

    def _wake(self) -> None:
        self._is_awake = False
        self._writer.wake()

    def _change(self, change: Change, size: int, puts: Sequence[tuple[str, bytes]] = ()) -> None:
        """Make a change here, and have it made in the log."""
        with self._lock:
            self._refuse_failed()
            drops = [one for one in self._contents.make(change) if isinstance(one, str)]
            self._submit(LogWrite((change,), size, puts, drops))

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Append (address, entry) pairs as one; see `Journal`."""
        if not entries:
            return []
        size = 0
        for _, entry in entries:
            if not is_plain(entry):
                check_entry(entry)
            size += _ENTRY_BYTES + sum(len(part) for part in entry if isinstance(part, (bytes, str)))
        with self._lock:
            self._change(("append", (tuple(entries),)), size)
            last = self._contents.last
        return list(range(last - len(entries) + 1, last + 1))

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """Keep a snapshot, and forget what it contains; see `Journal`."""
        data = bytes(snapshot)
        gone = drop if isinstance(drop, range) else frozenset(drop)
        with self._lock:
            dropped = tuple(position for position in self._contents.entries.get(address, ()) if position in gone)
            if len(data) < LARGE:
                self._change(("cut", (address, data, dropped, turn, keep)), len(data) + 9 * len(dropped))
            else:
                name = uuid.uuid4().hex
                self._change(("cut", (address, name, dropped, turn, keep)), 9 * len(dropped), [(name, data)])
        self._wait_for_room()

    def erase(self, address: str) -> None:
        """Forget an address; see `Journal`."""
        self._change(("erase", (address,)), len(address))

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        """Keep blocks of a large snapshot; see `Journal`."""
        deflate = compressor(compress)
        packed: list[PackedBlock] = []
        for offset, block in blocks:
            codec, data = deflate(block)
            packed.append(PackedBlock(offset, len(block), codec, zlib.crc32(block), bytes(data)))
        name = uuid.uuid4().hex
        self._change(("keep_pack", (address, number, name)), 0, [(name, msgspec.msgpack.encode(packed))])
        self._wait_for_room()

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """Remove packs of an address; see `Journal`."""
        self._change(("forget_packs", (address, tuple(numbers))), 8 * len(numbers))

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small fact; see `Journal`."""
        kept = None if value is None else bytes(value)
        self._change(("note", (key, kept)), len(key) + len(kept or b""))

    @contextlib.contextmanager
    def together(self) -> Generator[None, None, None]:
        """Have all that this thread writes meanwhile be in the log completely, or not at all; see `Journal`."""
        with self._lock:
            self._refuse_failed()
            before = self._contents.copy()
            joint: list[LogWrite] = []
            self._joint = joint
            try:
                yield
            except BaseException:
                self._contents = before
                raise
            finally:
                self._joint = None
            changes = tuple(change for write in joint for change in write.changes)
            puts = tuple(put for write in joint for put in write.puts)
            drops = tuple(name for write in joint for name in write.drops)
            self._submit(LogWrite(changes, sum(write.size for write in joint), puts, drops))

    # -- waiting ----------------------------------------------------------------------------------------------------

    def _tell_written(self, tell: Tell) -> None:
        """Have it called, on any thread, when all that was submitted is in the log, or never will be."""
        with self._count_lock:
            self._refuse_failed()
            if self._progress.wait(tell):
                return
        tell(None)

    def synced(self) -> asyncio.Future[None]:
        """Done when all that was written so far survives the loss of machines; for the running loop.

        Raises:
            StaleEpoch, StoreFailed: it never will; the future may end with them, too.
        """
        loop = asyncio.get_running_loop()
        done: asyncio.Future[None] = loop.create_future()

        def finish(error: HoldfastError | None) -> None:
            if done.done():
                return
            if error is None:
                done.set_result(None)
            else:
                done.set_exception(type(error)(*error.args))

        def tell(error: HoldfastError | None) -> None:
            with contextlib.suppress(RuntimeError):  # That loop has ended.
                loop.call_soon_threadsafe(finish, error)

        self._tell_written(tell)
        return done

    def sync(self) -> None:
        """Wait until all that was written so far survives the loss of machines; see `Journal`.

        Raises:
            StaleEpoch: another leads. StoreFailed: the log cannot be written.
        """
        self._loop.wait(self._written())

    async def _written(self) -> None:
        """Wait until what was written so far stands in the log, as long as the engine takes something now and then."""
        done, loop = self.synced(), asyncio.get_running_loop()
        steps, until = self._writer.steps, loop.time() + self._patience
        while not done.done():
            left = None if self._patience == math.inf else max(until - loop.time(), 0.0)
            await asyncio.wait([done], timeout=left)
            if self._writer.steps != steps:
                steps, until = self._writer.steps, loop.time() + self._patience
            elif not done.done():
                done.cancel()
                problem = f"no server has taken anything for {self._patience:g} s"
                raise StoreFailed(self.path, f"{problem}; see whether they run, and whether their disks have room")
        done.result()

    def _wait_for_room(self) -> None:
        if self._blobs.size > MOST_UNSENT and self._joint is None:
            self.sync()

    # -- reading ----------------------------------------------------------------------------------------------------

    def load(self, address: str, *, older: int = False) -> Saved:
        """Read an address back; see `Journal`."""
        with self._lock:
            self._refuse_failed()
            found, entries = self._contents.load(address, int(older))
        if found is None:
            return Saved(None, 0, entries)
        data = found.data
        if isinstance(data, str):
            data = self._blob(data)
            if data is None:
                raise DamagedStore(self.path, address, None, f"its snapshot of turn {found.turn} is missing")
        return Saved(data, found.turn, entries)

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """Blocks of a pack, verified; see `Journal`."""
        with self._lock:
            self._refuse_failed()
            name = self._contents.packs.get(address, {}).get(number)
        data = None if name is None else self._blob(name)
        if data is None:
            raise DamagedStore(self.path, address, None, f"pack {number} is missing")
        wanted = set(places)
        blocks: list[tuple[int, bytes]] = []
        try:
            for one in msgspec.msgpack.decode(data, type=list[PackedBlock]):
                if (one.offset, one.length) in wanted:
                    block = decompress(one.codec, one.data, one.length)
                    if zlib.crc32(block) != one.crc:
                        raise ValueError(f"the checksum of the block at {one.offset} is wrong")
                    blocks.append((one.offset, block))
                    wanted.discard((one.offset, one.length))
        except LibraryMissing as error:
            raise StoreFailed(self.path, str(error)) from error
        except ValueError as error:
            raise DamagedStore(self.path, address, None, f"pack {number}: {error}") from error
        if wanted:
            raise DamagedStore(self.path, address, None, f"pack {number} has no block at {min(wanted)[0]}")
        return Segment.of(number, blocks)

    def _blob(self, name: str) -> bytes | None:
        """A large value, from memory if it is not sent yet; `None` if the log refers to it, and it is not there.

        Raises:
            StaleEpoch: another leads: it removes what only this leader still refers to.
            StoreFailed: the engine does not answer.
        """
        with self._count_lock:
            unsent = self._blobs.get(name)
        with self._lock:
            if unsent is None and self._joint is not None:
                unsent = next((data for write in self._joint for known, data in write.puts if known == name), None)
        if unsent is not None:
            return unsent
        if (fetched := self._blobs.fetched.pop(name, None)) is not None:
            return fetched
        try:
            # Again and again: at a takeover servers may be choosing a leader, and who cannot read cannot lead.
            data = self._loop.wait(insist(lambda: self._engine.blobs.get(name)), READ_SECONDS)
            if data is None:  # Once a look is written, nobody led before it who could have removed it.
                self._queue(LogWrite())
                self._loop.wait(self._written(), READ_SECONDS)
            return data
        except TimeoutError as error:
            problem = f"no server has answered for {READ_SECONDS:g} s with a large snapshot; start the program again"
            raise StoreFailed(self.path, problem) from error

    def packs(self, address: str) -> set[int]:
        """Return the packs of an address; see `Journal`."""
        with self._lock:
            return set(self._contents.packs.get(address, ()))

    def addresses(self) -> list[str]:
        """Every address that has something stored, sorted."""
        with self._lock:
            return self._contents.addresses()

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or `None`."""
        with self._lock:
            return self._contents.notes.get(key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """All facts whose keys begin so; see `Journal`."""
        with self._lock:
            return self._contents.notes_from(prefix)

    def has_failed(self) -> bool:
        """Whether everything is refused from now on."""
        return self._failure is not None

    # -- the end ----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Have what was written reach the log, give the lease up, and let go of the engine; a second call does nothing.

        Raises:
            StoreFailed: the engine has not answered in time: what was not acknowledged may be lost.
        """
        if not self._is_open:
            return
        try:
            self._loop.finish(self.end(), 4 * CLOSE_SECONDS)
        except TimeoutError as error:
            raise StoreFailed(self.path, "its work for the engine does not end") from error
        finally:
            self._is_open = False
            self._loop.close()

    async def end(self) -> None:
        """Do what `close` does before it ends the engine's loop; for somebody on that loop.

        Raises:
            StoreFailed: the engine has not answered in time: what was not acknowledged may be lost.
        """
        with self._count_lock:
            if not self._is_open and self._leading.done():
                return
            self._is_open = False
            submitted = self._progress.submitted
            done = asyncio.get_running_loop().create_future()
            if self._failure is not None or not self._progress.wait(lambda error: done.set_result(None)):
                done.set_result(None)  # Nothing more will be written.
        silent = max(asyncio.get_running_loop().time() - self._writer.asked, 0.0)  # Whoever ends the system has waited.
        await asyncio.wait([done], timeout=max(CLOSE_SECONDS - silent, 0.0))
        left = submitted - self._progress.written if self._failure is None else 0
        await end_tasks(self._leading)
        lasts = (self._keeper.release, self._engine.close) if silent < CLOSE_SECONDS else (self._engine.close,)
        for last in lasts:  # Servers that do not answer cost neither its time.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_SECONDS):
                    await last()
        if left > 0:
            problem = f"it has not answered for {CLOSE_SECONDS:g} s: {left} writes may be lost"
            self._fail(StoreFailed(self.path, problem))
            raise StoreFailed(self.path, problem)
