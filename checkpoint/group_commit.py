"""Group commit: one append per tick for all homes; each submission takes effect once it is safe enough.

Two lanes, each in order. What is only to outlive this process (`durability="os"`) takes effect when it is written; what
is to outlive the machine (`"fsync"`) when it is synced too, which a thread does for all that has gathered meanwhile. In
a store that is safe only when it is synced, there is one lane, the slower one.
Whoever has something in the slow lane stays there with all that follows, so that nobody's outputs change their order.

What is submitted lives here, not in the message handler that has it written: that one may be killed at any moment.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import dataclasses
import functools
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from ..actors.errors import HoldfastError
from ..actors.events import Event, JournalBlocked, JournalGoesOn, JournalStopped
from .commit_lanes import CommitLanes, Submission
from .journal import Entry, InHand, MemoryJournal, Saved, StaleEpoch, StoreEngine, StoreFailed
from .method import Durability
from .protocol import STEPS

if TYPE_CHECKING:
    from .snapshot.shared_blocks import Segment

RETRY_SECONDS = 0.05
"""Until the first attempt after a store had no room; each further one comes twice as late, up to the next figure."""
MOST_RETRY_SECONDS = 1.0
MOST = 250
"""Messages written and let out in one go, or their ends: about 2 ms of the loop's time."""
PATIENCE_SECONDS = 0.05
"""How long the message handler may take to come, before the homes do its work themselves."""


@dataclasses.dataclass(slots=True)
class _Retry:
    """When a store that had no room is tried again.

    Attributes:
        delay: seconds until the next attempt.
        timer: of that, if one is set.
        tried_at: when the last one was made, on the clock of the loop.
    """

    delay: float = RETRY_SECONDS
    timer: asyncio.TimerHandle | None = None
    tried_at: float = 0.0


class Commits:
    """The journal of a root's homes: an engine, and what waits for it.

    Args:
        engine: writes.
        loop: on which everything but a sync happens.
        durability: of homes whose method says nothing.
        emit: told when the engine refuses, and when it goes on.
        where: the address that those events have.
    """

    def __init__(
        self,
        engine: StoreEngine,
        loop: asyncio.AbstractEventLoop,
        *,
        durability: Durability = "os",
        emit: Callable[[Event], None] = lambda event: None,
        where: str = "/",
    ) -> None:
        self.engine, self.durable, self.epoch = engine, engine.durable, engine.epoch
        self.commits = self
        self.durability: Durability = durability if engine.durable else "memory"
        self.wake_handler: Callable[[], None] | None = None  # has the message handler come, if there is one
        self._loop, self._emit, self._where = loop, emit, where
        self._lanes = CommitLanes(engine.safe_at == "sync", self.durability == "fsync")
        self._context = contextvars.copy_context()
        self._is_awake = self._is_running = self._is_patient = False
        self._overdue: asyncio.TimerHandle | None = None
        self._thread: ThreadPoolExecutor | None = None
        self._syncing: asyncio.Future[None] | None = None
        self._retry = _Retry()
        self.blocked: HoldfastError | None = None  # why nothing is written at the moment
        self.stopped: HoldfastError | None = None  # why nothing is written any more

    @property
    def in_hand(self) -> InHand | None:
        """Which inputs are in hand, if the engine keeps that."""
        return self.engine.in_hand

    # -- who wants what ---------------------------------------------------------------------------------------------

    def want(self, path: str, durability: Durability | None) -> None:
        """How safe what this home submits has to be."""
        is_synced = self.engine.safe_at == "sync" or (durability or self.durability) == "fsync"
        self._lanes.want(path, is_synced=is_synced)

    def rename(self, paths: Mapping[str, str]) -> None:
        """Homes have other addresses from now on; nothing of theirs waits to be written."""
        self._lanes.rename(paths)

    # -- submitting -------------------------------------------------------------------------------------------------

    def admit(self, submission: Submission) -> None:
        """Take in what may still be refused.

        Raises:
            HoldfastError: the store does not take anything now.
        """
        self.check()
        self.submit(submission)

    def check(self) -> None:
        """Raise what `admit` would raise now; who comes to a store that had no room looks whether there is some.

        Raises:
            HoldfastError: the store does not take anything now.
        """
        if (
            self.blocked is not None
            and self.stopped is None
            and self._loop.time() - self._retry.tried_at >= RETRY_SECONDS
        ):
            self._look_again()
        error = self.stopped or self.blocked
        if error is not None:
            raise type(error)(*error.args)

    def submit(self, submission: Submission, *, is_patient: bool = False) -> None:
        """Take in what has happened: it is written at the end of this tick, or when the store has room again.

        If it `is_patient`, nothing waits for it itself: it is written with what its turn says next, as one
        append, or when that has had its `STEPS`.
        """
        if self.stopped is not None:  # It never leaves: what is open now is taken up again when the store is.
            submission.abandoned(self.stopped)
            return
        self._lanes.submit(submission)
        if self._is_awake:
            return
        if not is_patient:
            self._wake()
        elif not self._is_patient:
            self._is_patient = True
            self._wait(STEPS)

    def _wait(self, steps: int) -> None:
        """Have what is patient written after so many steps, if nobody has had it written before."""
        if steps and self._lanes.pending and not self._is_awake:
            self._loop.call_soon(self._wait, steps - 1, context=self._context)
            return
        self._is_patient = False
        if self._lanes.pending and not self._is_awake:
            self._wake()

    def _wake(self) -> None:
        self._is_awake = True
        if self.wake_handler is None:
            self._loop.call_soon(self.flush, context=self._context)
            return
        if self._overdue is None:
            self._overdue = self._loop.call_later(PATIENCE_SECONDS, self._help, context=self._context)
        try:
            self.wake_handler()
        except HoldfastError:  # It has ended for good.
            self.wake_handler = None
            self._loop.call_soon(self.flush, context=self._context)

    def come(self) -> None:
        """What the message handler does when it was woken, in nobody's name."""
        self._context.run(self.flush)

    def _help(self) -> None:
        """The message handler has not come: it may be between two lives."""
        self._overdue = None
        if self._is_awake:
            self.flush()

    # -- writing ----------------------------------------------------------------------------------------------------

    def flush(self) -> None:
        """Write what was submitted, and let what is safe now take effect. (The message handler's work.)"""
        self._is_awake = False
        if self._may_write:
            self._write(MOST)
        self._run()
        if self._lanes.pending and not self._is_awake and self._may_write:
            self._wake()  # The rest in its turn: others want the loop, too.

    @property
    def _may_write(self) -> bool:
        """Whether it is worth writing now: what has to be synced gathers while a sync is under way."""
        return self.blocked is None and (self._lanes.is_urgent or self._syncing is None)

    def barrier(self) -> None:
        """Have everything that was submitted written, now.

        Raises:
            HoldfastError: the store refuses.
        """
        if self._lanes.pending:
            self._write()
            if self._lanes.ready and not self._is_running and not self._is_awake:
                self._wake()
        self.check()

    def _write(self, most: int | None = None) -> None:
        """Write what was submitted, of so many messages if `most` is given."""
        lanes = self._lanes
        pending = lanes.pending if most is None else lanes.pending[: lanes.first(most)]
        if not pending or self.stopped is not None:
            return
        rows = [submission.entries for submission, _ in pending]
        entries = [entry for own in rows for entry in own]
        try:
            positions = self.engine.append(entries) if entries else []
        except StoreFailed as error:
            if isinstance(error, StaleEpoch) or self.engine.has_failed():
                self._stop(error)
            else:
                self._block(error)
            return
        except HoldfastError as error:
            self._stop(error)
            return
        lanes.take_written([len(own) for own in rows], positions)
        if self._lanes.unsynced and self._syncing is None:
            self._sync()
        if self.blocked is not None:
            self.blocked, self._retry.delay = None, RETRY_SECONDS
            self._emit(JournalGoesOn(self._where))

    def _run(self) -> None:
        """Let what is safe take effect, one after the other."""
        if self._is_running:
            return
        self._is_running = True
        ready = self._lanes.ready
        try:
            while ready:
                submission = ready.popleft()
                try:
                    submission.safe()
                except Exception as error:  # One's trouble is not another's.
                    self.report(error)
        finally:
            self._is_running = False

    def report(self, error: Exception) -> None:
        """Tell whoever looks after the loop that what a committed turn leads to has failed."""
        self._loop.call_exception_handler({"message": "an effect of a committed turn failed", "exception": error})

    def _block(self, error: HoldfastError) -> None:
        """Nothing was written: refuse what can be refused, and try again with the rest."""
        first = self.blocked is None
        self.blocked = error
        self._lanes.refuse(error)
        if first:
            self._emit(JournalBlocked(self._where, str(error)))
        self._retry.tried_at = self._loop.time()
        if self._retry.timer is not None:
            self._retry.timer.cancel()
        self._retry.timer = self._loop.call_later(self._retry.delay, self._try_again, context=self._context)
        self._retry.delay = min(2 * self._retry.delay, MOST_RETRY_SECONDS)

    def _try_again(self) -> None:
        self._retry.timer = None
        if self.blocked is not None and self.stopped is None:
            self._look_again()

    def _look_again(self) -> None:
        """See whether there is room now; what has waited for that takes effect later, in nobody's name."""
        if self._lanes.pending:
            self._write()
            if self._lanes.ready and not self._is_running and not self._is_awake:
                self._wake()
        else:  # Nothing is left that could show whether there is room: the next admission does.
            self.blocked, self._retry.delay = None, RETRY_SECONDS
            self._emit(JournalGoesOn(self._where))

    def _stop(self, error: HoldfastError) -> None:
        """From here on nothing is written, and nothing takes effect that was not safe (T13)."""
        if self.stopped is not None:
            return
        self.stopped = error
        self._lanes.abandon(error)
        self._emit(JournalStopped(self._where, str(error)))

    # -- syncing ----------------------------------------------------------------------------------------------------

    def _sync(self) -> None:
        """Have the engine, or a thread, sync all that is written so far."""
        written = self._lanes.written
        try:
            self._syncing = self.engine.synced() or self._synced_in_thread()
        except Exception as error:
            self._syncing = self._loop.create_future()
            self._syncing.set_exception(error)
        self._syncing.add_done_callback(functools.partial(self._synced_to, written), context=self._context)

    def _synced_in_thread(self) -> asyncio.Future[None]:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "holdfast-sync")
        try:
            return self._loop.run_in_executor(self._thread, self.engine.sync)
        except RuntimeError:  # No thread can be started now: everybody waits for the disk, this once.
            self.engine.sync()
            done = self._loop.create_future()
            done.set_result(None)
            return done

    def _synced_to(self, number: int, done: asyncio.Future[None]) -> None:
        self._syncing = None
        error = None if done.cancelled() else done.exception()
        if self.stopped is not None:
            return
        if error is not None:
            failure = error if isinstance(error, HoldfastError) else StoreFailed(self._where, str(error))
            self._stop(failure)
            return
        self._lanes.take_synced(number)
        if self.blocked is None:
            self._write()  # What has gathered meanwhile.
        if self._lanes.unsynced and self._syncing is None:
            self._sync()
        self._run()

    # -- what else a journal does -----------------------------------------------------------------------------------

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Append at once, behind everything that was submitted."""
        self.barrier()
        return self.engine.append(entries)

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """Keep a snapshot, behind everything that was submitted; see `Journal`."""
        self.barrier()
        self.engine.cut(address, snapshot, drop, turn=turn, keep=keep)

    def load(self, address: str, *, older: int = False) -> Saved:
        """Read an address back; see `Journal`."""
        self.barrier()
        return self.engine.load(address, older=older)

    def erase(self, address: str) -> None:
        """Forget an address; see `Journal`."""
        self.barrier()
        self.engine.erase(address)

    # Blocks count only when a `cut` refers to them: nothing that was submitted has to stand before them, and threads
    # may write them.

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        """Keep blocks of a large snapshot; see `Journal`."""
        self.engine.keep_blocks(address, number, blocks, compress)

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """Blocks of a pack; see `Journal`."""
        return self.engine.read_blocks(address, number, places)

    def packs(self, address: str) -> set[int]:
        """Return the packs of an address; see `Journal`."""
        return self.engine.packs(address)

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """Remove packs that are not needed; see `Journal`."""
        self.engine.forget_blocks(address, numbers)

    def addresses(self) -> list[str]:
        """Every address that has something stored, sorted."""
        return self.engine.addresses()

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small fact; see `Journal`."""
        if self._lanes.pending:
            self.barrier()
        self.engine.note(key, value)

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or `None`."""
        return self.engine.noted(key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """All facts whose keys begin so."""
        return self.engine.notes(prefix)

    @contextlib.contextmanager
    def together(self) -> Generator[None, None, None]:
        """Have all that is kept meanwhile be in the store completely, or not at all, if the engine can do that.

        Call `barrier` before. If the store fails at the end, nothing more is written: what is in memory is not in it,
        and a root that is started again has what was there before.

        Raises:
            HoldfastError: it has failed.
        """
        try:
            with self.engine.together():
                yield
        except HoldfastError as error:
            self._stop(error)
            raise

    def sync(self) -> None:
        """Have everything that was submitted outlive the machine; it waits for the disk."""
        self.barrier()
        self.engine.sync()

    async def safe(self) -> None:
        """Wait until what was noted so far outlives the process, in a store in which that takes a sync.

        Raises:
            HoldfastError: it never will.
        """
        if self.engine.safe_at == "sync":
            synced = self.engine.synced()
            if synced is not None:
                await synced

    async def settled(self) -> None:
        """Wait until everything that was submitted has taken effect, or never will."""
        while not self._lanes.is_empty and self.stopped is None and self.blocked is None:
            if self._syncing is not None:
                await asyncio.wait([self._syncing])
            else:
                self.flush()  # The message handler may have ended after it was woken: nobody waits for it here.
                await asyncio.sleep(0)

    def close(self) -> None:
        """Write what is left, and close the engine."""
        try:
            if self._lanes.pending and self.blocked is None:
                self._write()
        finally:
            if self._thread is not None:
                self._thread.shutdown()  # It may be syncing.
            self._run()
            if self._overdue is not None:
                self._overdue.cancel()
                self._overdue = None
            try:
                self.engine.close()
            except HoldfastError as error:  # Only now it has turned out that it is not there any more.
                self._stop(error)
                raise


class Unkept(MemoryJournal):
    """The journal of a home that keeps nothing beyond this process: what its turns give to others may be kept."""

    __slots__ = ("commits",)

    def __init__(self, commits: Commits) -> None:
        super().__init__()
        self.commits = commits
        self.epoch = commits.epoch

    def submit(self, submission: Submission, *, is_patient: bool = False) -> None:
        """Take in what concerns other homes."""
        self.commits.submit(submission, is_patient=is_patient)

    def admit(self, submission: Submission) -> None:
        """Take in what may still be refused."""
        self.commits.admit(submission)

    def barrier(self) -> None:
        """Nothing of it is written."""
