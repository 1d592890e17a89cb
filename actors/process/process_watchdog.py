"""The watch over one process: beats of its loop, memory and CPU through psutil."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from ..exit_reasons import ExitReason, OutOfMemory, Signal
from ..observer_clock import OwnClock
from .resource_limits import Limits

if TYPE_CHECKING:
    from ..kernel.node import Node


LOOKS = 4
"""How often within `hung_after` the watch looks; so often the process beats, too."""


class WatchedProcess(Protocol):
    """A process as the watch knows it."""

    @property
    def node(self) -> Node: ...
    @property
    def pid(self) -> int: ...
    def kill(self, reason: ExitReason, /) -> None: ...
    def hung(self, seconds: float, /) -> None: ...


class ProcessWatch:
    """Ends a process that hangs or takes more than its limits allow."""

    def __init__(self, worker: WatchedProcess, limits: Limits) -> None:
        import psutil  # only where something is watched

        self.limits = limits
        self._worker = worker
        self._ended = psutil.Error
        self._loop = worker.node.loop
        now = self._loop.time()
        self._process = psutil.Process(worker.pid)
        self._timers: list[asyncio.TimerHandle] = []
        if limits.memory_bytes is not None or limits.cpu_share is not None:
            self._cpu_before, self._looked_at = self._cpu(), now
            self._timers.append(self._loop.call_later(limits.watch_interval, self._look))
        if limits.hung_after is not None:
            self._period = limits.hung_after / LOOKS
            self._clock, self._last_beat = OwnClock(now, self._period), 0.0
            self._waited = waited_for_processor(worker.pid)  # as of the last beat
            self._timers.append(self._loop.call_later(self._period, self._listen))

    def beat(self) -> None:
        """The loop in the process turns."""
        if self.limits.hung_after is not None:
            self._last_beat = self._clock.at(self._loop.time())
            self._waited = waited_for_processor(self._worker.pid)

    def _listen(self) -> None:
        hung_after = self.limits.hung_after
        assert hung_after is not None
        silent = self._clock.tick(self._loop.time()) - self._last_beat
        if silent >= hung_after:  # What it waited for a processor meanwhile is no silence of its own.
            silent -= waited_for_processor(self._worker.pid) - self._waited
        if silent >= hung_after:
            self._worker.hung(silent)
            return
        self._timers.append(self._loop.call_later(self._period, self._listen))
        del self._timers[:-2]

    def _cpu(self) -> float:
        times = self._process.cpu_times()
        return float(times.user + times.system)

    def _look(self) -> None:
        limits = self.limits
        try:
            resident = self._process.memory_info().rss
            cpu = self._cpu()
        except self._ended:
            return  # It has ended: its socket tells.
        now = self._loop.time()
        share = (cpu - self._cpu_before) / max(now - self._looked_at, limits.watch_interval)  # We may be late.
        self._cpu_before, self._looked_at = cpu, now
        if limits.memory_bytes is not None and resident > limits.memory_bytes:
            self._worker.kill(OutOfMemory(f"{resident} bytes resident, the limit is {limits.memory_bytes}"))
        elif limits.cpu_share is not None and share > limits.cpu_share:
            self._worker.kill(Signal(signal.SIGXCPU))  # The system's own name for it.
        else:
            self._timers.append(self._loop.call_later(limits.watch_interval, self._look))
            del self._timers[:-2]

    def close(self) -> None:
        """Stop watching the process from now on."""
        for timer in self._timers:
            timer.cancel()


def waited_for_processor(pid: int) -> float:
    """Seconds for which the main thread of a process was ready and got no processor, so far; 0.0 if nobody knows."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError):  # It has ended, or the kernel does not count that.
        return 0.0


def oom_kills() -> int:
    """How often the kernel's out-of-memory killer struck in our cgroup; 0 where that cannot be read."""
    try:
        group = Path("/proc/self/cgroup").read_text().splitlines()[-1].rpartition(":")[2]
        events = Path(f"/sys/fs/cgroup{group}/memory.events").read_text()
    except (OSError, IndexError):
        return 0
    for line in events.splitlines():
        name, _, count = line.partition(" ")
        if name == "oom_kill":
            return int(count)
    return 0
