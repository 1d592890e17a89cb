"""Deadlines of asks: one queue per time-out value and one timer per queue, none per ask."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..seconds import check_seconds

if TYPE_CHECKING:
    from .envelope import Ask


class Deadlines:
    """All asks of one time-out value expire in the order they were made, so a queue is a sorted list."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._queues: dict[float, _Queue] = {}
        self.watcher: Callable[[Ask, BaseException], None] | None = None  # is told of each ask that fails

    def add(self, ask: Ask) -> None:
        """Set the deadline of an ask by its time-out, and see to it that it has an outcome then.

        Raises:
            SpecError: the time-out is no finite number of seconds > 0.
        """
        timeout = ask.timeout
        queue = self._queues.get(timeout) if type(timeout) is float else None
        if queue is None:
            timeout = check_seconds(ask.to.path, "timeout", timeout)
            queue = self._queues.get(timeout)
        if queue is None:
            queue = self._queues[timeout] = _Queue(self._loop, self._queues, timeout)
        ask.deadline = self._loop.time() + timeout
        asks = queue.asks
        while asks and asks[0].future.done():
            asks.popleft()
        asks.append(ask)
        if len(asks) > queue.limit:
            queue.tidy()
        if queue.timer is None:
            queue.arm()

    def waiting(self) -> list[Ask]:
        """The asks that have no outcome yet; looks at all that were made within their time-outs."""
        return [ask for queue in self._queues.values() for ask in queue.asks if not ask.future.done()]

    def close(self) -> list[Ask]:
        """Forget all timers. Returns the asks that have no outcome yet."""
        left = self.waiting()
        for queue in self._queues.values():
            if queue.timer is not None:
                queue.timer.cancel()
        self._queues.clear()
        return left


class _Queue:
    """The asks of one time-out value, oldest first."""

    __slots__ = ("_loop", "_queues", "_timeout", "asks", "limit", "timer")

    def __init__(self, loop: asyncio.AbstractEventLoop, queues: dict[float, _Queue], timeout: float) -> None:
        self._loop, self._queues, self._timeout = loop, queues, timeout
        self.asks: deque[Ask] = deque()
        self.limit = 1024
        self.timer: asyncio.TimerHandle | None = None

    def tidy(self) -> None:
        """Drop answered asks behind one that still waits, so that they do not stay to the deadline."""
        self.asks = deque(ask for ask in self.asks if not ask.future.done())
        self.limit = max(1024, 2 * len(self.asks))

    def arm(self) -> None:
        """Wake at the deadline of the oldest ask that waits."""
        while self.asks and self.asks[0].future.done():
            self.asks.popleft()
        if self.asks:
            self.timer = self._loop.call_at(self.asks[0].deadline, self._expire)
        else:  # Computed time-outs are nearly all different: a queue without asks goes.
            self.timer = None
            self._queues.pop(self._timeout, None)

    def _expire(self) -> None:
        now = self._loop.time()
        asks = self.asks
        while asks and asks[0].deadline <= now:
            ask = asks.popleft()
            if not ask.future.done():
                ask.expire()
        self.arm()
