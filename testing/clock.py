"""Virtual time: an event loop that never waits for a timer, so that a test of hours takes milliseconds.

The loop is the stock one. Only its selector is another: where it would wait for the next timer, it jumps there. What
takes no time in reality takes none here either, so two runs of a test see the same times.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, TypeVar, TypeVarTuple

from ..actors.errors import HoldfastError

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

WAKE_UP_SOCKETS = 1  # the loop's own, through which threads and signals wake it
PATIENCE = 1.0
"""Real seconds given to threads that the loop does not know of, before it is sure that nothing can happen any more."""


class NothingToWaitFor(RuntimeError):
    """The loop would wait for ever: no timer is set, no callback is due, no file is watched, no thread is at work."""

    def __init__(self, now: float) -> None:
        super().__init__(now)
        self.now = now

    def __str__(self) -> str:
        return (
            f"nothing can happen any more at virtual time {self.now:g} s: every task waits for something that nobody "
            "will do (no timer is set, no callback is due, no file is watched, no thread is at work)"
        )


class RealTimeNeeded(HoldfastError):
    """Another process was to be started or spoken to under the virtual clock."""

    def __init__(self, what: str) -> None:
        super().__init__(what)
        self.what = what

    def __str__(self) -> str:
        return (
            f"{self.what} cannot run under the virtual clock: another process has a clock of its own, and this one "
            "would jump ahead of it. Use a real loop (uvloop or the stock one), or isolation='task'"
        )


class _JumpingSelector(selectors.DefaultSelector):
    """Looks at real files without waiting; time passes by jumping to the next timer."""

    def __init__(self, start: float) -> None:
        super().__init__()
        self.now = start
        self.jobs = 0  # threads at work whose results will wake the loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        if self.jobs:
            return super().select(None)
        if timeout is not None:
            self.now += timeout
            return ready
        if len(self.get_map()) > WAKE_UP_SOCKETS:
            return super().select(None)
        ready = super().select(PATIENCE)
        if not ready:
            raise NothingToWaitFor(self.now)
        return ready


class VirtualClockLoop(asyncio.SelectorEventLoop):
    """An event loop with a clock of its own, which stands still while anything runs and jumps when all wait.

    `time()` begins at `start` and moves only to the times of timers: `asyncio.sleep(3600)` returns at once, 3600 s
    later. Everything on the loop's clock follows (`call_later`, `asyncio.timeout`, deadlines, back-off, restart
    windows); `time.monotonic()` and `time.time()` do not.

    - Work in `run_in_executor` takes no virtual time: the loop really waits for it before it jumps.
    - Files and sockets are looked at, but the clock does not wait for them while a timer is set.
    - Another process has no virtual clock: actors in processes of their own, and subprocesses, are refused
      (`RealTimeNeeded`); test them on a real loop.
    - When nothing can happen any more it raises `NothingToWaitFor` instead of hanging.

    >>> with asyncio.Runner(loop_factory=VirtualClockLoop) as runner:
    ...     runner.run(asyncio.sleep(3600, "an hour later")), runner.get_loop().time()
    ('an hour later', 3600.0)
    """

    def __init__(self, start: float = 0.0) -> None:
        self._virtual = _JumpingSelector(start)
        super().__init__(self._virtual)

    def time(self) -> float:
        """Seconds on the virtual clock."""
        return self._virtual.now

    def run_in_executor(self, executor: Executor | None, func: Callable[[*Ts], T], *args: *Ts) -> asyncio.Future[T]:
        """Run in a thread; the clock stands still until it is done."""
        future = super().run_in_executor(executor, func, *args)
        self._virtual.jobs += 1
        future.add_done_callback(self._job_done)
        return future

    def _job_done(self, _: object) -> None:
        self._virtual.jobs -= 1

    async def connect_accepted_socket(self, *args: Any, **options: Any) -> Any:
        """Refused: what is connected here speaks for another process."""
        raise RealTimeNeeded("a connection to another process")

    async def subprocess_exec(self, *args: Any, **options: Any) -> Any:
        """Refused."""
        raise RealTimeNeeded("a subprocess")

    async def subprocess_shell(self, *args: Any, **options: Any) -> Any:
        """Refused."""
        raise RealTimeNeeded("a subprocess")

    async def shutdown_default_executor(self, *args: Any) -> None:
        """Join the threads of `run_in_executor`; that is a thread's work too."""
        self._virtual.jobs += 1
        try:
            await super().shutdown_default_executor(*args)
        finally:
            self._virtual.jobs -= 1


def virtual() -> VirtualClockLoop:
    """A new loop whose clock begins at 0: for `asyncio.Runner(loop_factory=...)` and pytest-asyncio's factories."""
    return VirtualClockLoop()


async def advance(seconds: float) -> None:
    """Let the virtual clock go on by `seconds`, and everything happen that falls due in them.

    Returns when no task could go on any more without more time. Timers fire in order, each at its own time.

    Raises:
        HoldfastError: the running loop has no virtual clock. ValueError: `seconds` is negative.
    """
    from .barrier import quiet

    loop = asyncio.get_running_loop()
    if not isinstance(loop, VirtualClockLoop):
        raise HoldfastError("advance() needs the virtual clock: run this under holdfast.testing.virtual")
    if not seconds >= 0:
        raise ValueError(f"the clock goes forward: seconds must be >= 0, not {seconds!r}")
    await asyncio.sleep(seconds)
    await quiet()
