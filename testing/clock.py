"""Virtual time: an event loop that never waits for a timer, so that a test of hours takes milliseconds.

The loop is the stock one. Only its selector is another: where it would wait for the next timer, it jumps there. What
takes no time in reality takes none here either, so two runs of a test see the same times.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import math
import os
import selectors
import sys
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Executor
from time import monotonic
from typing import TYPE_CHECKING, Any, TypeVar, TypeVarTuple

from ..actors.errors import HoldfastError
from .threads import NewThreads

if TYPE_CHECKING:
    from .barrier import NotIdle

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

WAKE_UP_SOCKETS = 1  # the loop's own, through which threads and signals wake it
PATIENCE = 1.0
"""Real seconds given to threads that cannot be seen at work, before it is sure that nothing can happen any more."""
LONGEST_WORK = 60.0
"""Real seconds that virtual time stands still for threads at work."""
LOOK_AGAIN = 0.002
"""Real seconds between two looks at the threads at work."""
PROCESS_POOLS = "concurrent.futures.process"
TICKS = 10_000
"""Ticks of the loop at one moment of virtual time; a run queue that is never empty makes them in about 5 s."""
COUNTED = 16
"""Ticks between two looks at how many there are."""
JUMPS = 500_000
"""Jumps of the clock in one run of the loop."""
PIDFD = "anon_inode:[pidfd]"


class NothingToWaitFor(
    HoldfastError,
    RuntimeError,
    text="nothing can happen any more at virtual time {now:g} s: every task waits for something that nobody will do "
    "(no timer is set, no callback is due, no file is watched, no thread is at work)",
):
    """The loop would wait for ever: no timer is set, no callback is due, no file is watched, no thread is at work."""

    now: float


class RealTimeNeeded(
    HoldfastError,
    text="{what} cannot run under the virtual clock: another process has a clock of its own, and this one "
    "would jump ahead of it. Use a real loop (uvloop or the stock one), or isolation='task'",
):
    """Another process was to be started or spoken to under the virtual clock."""

    what: str


class ThreadAtWork(
    HoldfastError,
    RuntimeError,
    text="the virtual clock has stood still for {seconds:g} real seconds, because a thread is at work: {names:, }. "
    "A thread that does not come to an end needs a real loop",
):
    """Virtual time has stood still for long, because a thread that may wake the loop does not end its work."""

    names: tuple[str, ...]
    seconds: float


class _JumpingSelector(selectors.DefaultSelector):
    """Looks at real files without waiting; time passes by jumping to the next timer."""

    def __init__(self, loop: VirtualClockLoop, start: float, ticks: int, jumps: int) -> None:
        super().__init__()
        self.now = start
        self.jobs = 0  # work of executors whose results will wake the loop
        self.ticks, self.jumps = 0, 0
        self.most_ticks, self._most_jumps = ticks, jumps
        self._loop = loop
        self._threads = NewThreads()
        self.end: BaseException | None = None

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if self.end is not None:
            end, self.end = self.end, None
            raise end
        is_busy = timeout is not None and timeout <= 0
        if is_busy and len(self.get_map()) == WAKE_UP_SOCKETS and not self._loop.hears_at_once():
            self._tick()
            return []
        ready = super().select(0)
        if ready or is_busy:
            self._tick()
            return ready
        ready = self._select_after_threads()
        if not ready and self._loop.at_rest():
            self._tick()
            return ready
        self._loop.forget_ticks()
        return ready or self._jump()

    def _tick(self) -> None:
        self.ticks += 1
        if self.ticks % COUNTED == 0 and self._loop.has_too_many_ticks(self.ticks):
            self._loop.forget_ticks()
            self._loop.stands_still(f"{self.most_ticks} ticks of the loop at virtual time {self.now:g} s")

    def _select_after_threads(self) -> list[tuple[selectors.SelectorKey, int]]:
        """What is ready once no thread is at work, or as soon as one of them wakes the loop."""
        began = monotonic()
        while names := self._threads.at_work() or ["an executor"] * self._has_jobs():
            ready = super().select(LOOK_AGAIN)
            if ready:
                return ready
            if monotonic() - began > LONGEST_WORK:
                raise ThreadAtWork(tuple(names), LONGEST_WORK)
        return super().select(0)  # What the last of them did came before this.

    def _has_jobs(self) -> bool:
        """Whether an executor has work that is not done, and does not wait for a future either."""
        left = self.jobs - self._loop.held_back()
        return left > 0 and left > self._threads.waiting()

    def _jump(self) -> list[tuple[selectors.SelectorKey, int]]:
        """Go to the next timer; without one, wait for files."""
        when = self._loop.next_timer()
        if when < math.inf:
            self.now = max(self.now, when)
            if late := self._loop.lateness():
                self._loop.pass_time(late)
            self.jumps += 1
            if self.jumps > self._most_jumps:
                self.jumps = 0
                raise self._loop.restless(f"{self._most_jumps} jumps of the clock, at virtual time {self.now:g} s")
            return []
        if len(self.get_map()) > WAKE_UP_SOCKETS:
            return super().select(None)
        ready = super().select(PATIENCE)
        if not ready:
            raise NothingToWaitFor(self.now)
        return ready


class VirtualClockLoop(asyncio.SelectorEventLoop):
    """An event loop with a clock of its own, which stands still while anything runs and jumps when all wait.

    `time()` begins at `start` and moves only to the times of timers, exactly: `asyncio.sleep(3600)` returns at once,
    3600 s later. Everything on the loop's clock follows (`call_later`, `asyncio.timeout`, deadlines, back-off, restart
    windows); `monotonic()` and `time.time()` do not.

    - Work in threads takes no virtual time: the loop really waits for it before it jumps, however the thread was
      started (`run_in_executor`, pools, anyio, `threading`), and raises `ThreadAtWork` when one does not come to
      an end. A thread that waits for a lock, or for a future, is not at work, nor is one that ran before the loop was
      made.
    - Files and sockets are looked at, but the clock does not wait for them while a timer is set.
    - Unix time passes with it for every system on the loop (`ctx.now()`, waits that outlive a program, histories).
    - Another process has no virtual clock: actors in processes of their own, and subprocesses, are refused
      (`RealTimeNeeded`); test them on a real loop.
    - When nothing can happen any more it raises `NothingToWaitFor` instead of hanging.
    - When it does not come to rest it raises `NotIdle`, which names who moves: after `ticks` ticks of the loop at one
      moment of virtual time, or `jumps` jumps of the clock in one run.

    >>> with asyncio.Runner(loop_factory=VirtualClockLoop) as runner:
    ...     runner.run(asyncio.sleep(3600, "an hour later")), runner.get_loop().time()
    ('an hour later', 3600.0)
    """

    _ready: deque[asyncio.Handle]  # asyncio's own
    _scheduled: list[asyncio.TimerHandle]
    _debug: bool
    _closed: bool

    def __init__(
        self, start: float = 0.0, *, epoch: float | None = None, ticks: int = TICKS, jumps: int = JUMPS
    ) -> None:
        self._virtual = _JumpingSelector(self, start, ticks, jumps)
        self._epoch = time.time() - start if epoch is None else epoch
        self._patient: list[Callable[[str], None]] = []
        super().__init__(self._virtual)
        self._clock_resolution = math.ulp(start)

    def time(self) -> float:
        """Seconds on the virtual clock."""
        return self._virtual.now

    def unix_time(self) -> float:
        """Seconds since 1970: `epoch` at 0; if that was left out, they were the machine's when the loop was made."""
        return self._epoch + self._virtual.now

    def next_timer(self) -> float:
        """Return when the next timer is due, in seconds on this clock; inf: none is set."""
        when = self._scheduled[0].when() if self._scheduled else math.inf
        # asyncio runs what is due up to one resolution from now. This much is what is due now, and no later timer.
        self._clock_resolution = math.ulp(max(self._virtual.now, when)) if when < math.inf else self._clock_resolution
        return when

    def lateness(self) -> float:
        """Say by how many seconds the loop wakes too late for the next timer."""
        return 0.0

    def pass_time(self, seconds: float) -> None:
        """Let time pass in which nothing happens here, as if a call had taken it."""
        self._virtual.now += seconds
        self._clock_resolution = math.ulp(self._virtual.now)  # Else a timer that is due right now would not be.
        self.forget_ticks()

    def run_forever(self) -> None:
        """Run as every loop does; each run may take so many ticks and jumps."""
        self._virtual.jumps = 0
        self.forget_ticks()
        super().run_forever()

    def end_by(self, error: BaseException | None) -> None:
        """Raise an error where the loop would look at its files the next time; None: raise none any more."""
        self._virtual.end = error

    async def rest(self) -> None:
        """Let everything that is due have a turn."""
        await asyncio.sleep(0)

    @property
    def most_ticks(self) -> int:
        """Return how many ticks at one moment are not too many."""
        return self._virtual.most_ticks

    def forget_ticks(self) -> None:
        """Ticks are counted from here on."""
        self._virtual.ticks = 0

    def has_too_many_ticks(self, ticks: int) -> bool:
        """Say whether so many ticks at one moment are too many."""
        return ticks > self.most_ticks

    def hears_at_once(self) -> bool:
        """Say whether a thread that wakes the loop is heard while other things are due."""
        return True

    def held_back(self) -> int:
        """Count the results of executors that are held back until nothing else can happen."""
        return 0

    def at_rest(self) -> bool:
        """Hear that nothing can happen any more without more time. Returns whether something can now."""
        return False

    @contextlib.contextmanager
    def hears_of_standstill(self, expire: Callable[[str], None]) -> Generator[None]:
        """Call `expire` with the reason when virtual time does not go on, instead of ending the run."""
        self._patient.append(expire)
        try:
            yield
        finally:
            self._patient.remove(expire)

    def stands_still(self, why: str) -> None:
        """Too much happens at one moment: tell who waits for its end.

        Raises:
            NotIdle: nobody does.
        """
        if not self._patient:
            raise self.restless(why)
        for expire in self._patient:
            expire(why)

    def restless(self, why: str) -> NotIdle:
        """Make the NotIdle that names what is to run now and what the next timers are."""
        from .barrier import NotIdle, movers

        return NotIdle(why, tuple(movers([*self._ready, *sorted(self._scheduled)])))

    def run_in_executor(self, executor: Executor | None, func: Callable[[*Ts], T], *args: *Ts) -> asyncio.Future[T]:
        """Run in a thread; the clock stands still while it is at work."""
        # Asked for by name only where there may be one: it brings all of multiprocessing.
        if PROCESS_POOLS in sys.modules and isinstance(executor, concurrent.futures.ProcessPoolExecutor):
            raise RealTimeNeeded("work in a pool of processes")
        future = super().run_in_executor(executor, func, *args)
        self._virtual.jobs += 1
        future.add_done_callback(self._job_done)
        return future

    def _job_done(self, _: object) -> None:
        self._virtual.jobs -= 1

    def add_reader(self, fd: Any, callback: Callable[[*Ts], Any], *args: *Ts) -> None:
        """Watch a file as every loop does; but the end of another process is not waited for here."""
        if isinstance(fd, int) and _is_pidfd(fd):
            raise RealTimeNeeded("what runs in another process")
        super().add_reader(fd, callback, *args)

    async def connect_accepted_socket(self, *args: Any, **options: Any) -> Any:
        """Refused: what is connected here speaks for another process."""
        raise RealTimeNeeded("a connection to another process")

    async def subprocess_exec(self, *args: Any, **options: Any) -> Any:
        """Refuse to start a process: its time would not be virtual."""
        raise RealTimeNeeded("a subprocess")

    async def subprocess_shell(self, *args: Any, **options: Any) -> Any:
        """Refuse to start a command: its time would not be virtual."""
        raise RealTimeNeeded("a subprocess")

    async def shutdown_default_executor(self, *args: Any) -> None:
        """Join the threads of `run_in_executor`; that is a thread's work too."""
        self._virtual.jobs += 1
        try:
            await super().shutdown_default_executor(*args)
        finally:
            self._virtual.jobs -= 1


def _is_pidfd(fd: int) -> bool:
    try:
        return os.readlink(f"/proc/self/fd/{fd}") == PIDFD
    except OSError:
        return False


def virtual() -> VirtualClockLoop:
    """Make a loop whose clock begins at 0: for `asyncio.Runner(loop_factory=...)` and pytest-asyncio's factories."""
    return VirtualClockLoop()


async def advance(seconds: float) -> None:
    """Let the virtual clock go on by `seconds`, and everything happen that falls due in them.

    Returns when no task could go on any more without more time. Timers fire in order, each at its own time.

    Raises:
        HoldfastError: the running loop has no virtual clock. ValueError: `seconds` is negative or infinite.
        NotIdle: something goes on at one moment without end.
    """
    from .barrier import patience, quiet

    loop = asyncio.get_running_loop()
    if not isinstance(loop, VirtualClockLoop):
        raise HoldfastError("advance() needs the virtual clock: run this under holdfast.testing.virtual")
    if not 0 <= seconds < math.inf:
        raise ValueError(f"the clock goes forward: seconds must be >= 0 and finite, not {seconds!r}")
    async with patience(None):
        await asyncio.sleep(seconds)
        await quiet()
