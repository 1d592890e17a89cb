"""Streams of jobs: one for each item of a source that is pulled only as fast as results are taken."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator, Callable, Iterable, Iterator
from typing import Any, Literal, cast

from ..actors.errors import AskTimeout, HoldfastError
from .awaited import Failed, Job, Ok

OnTimeout = Literal["exit", "kill_task"]


class _Slot:
    """An item between its source and the taker of its result."""

    __slots__ = ("_done", "deadline", "is_refused", "item", "job", "result")

    def __init__(self, item: Any, job: Job[Any], deadline: float, done: deque[_Slot]) -> None:
        self.item, self.job, self.deadline, self._done = item, job, deadline, done
        self.result: Ok[Any, Any] | Failed[Any] | None = None
        self.is_refused = False  # there was no job at all
        job._future.add_done_callback(self._ended)

    def _ended(self, future: asyncio.Future[Any]) -> None:
        if self.result is None:
            error = cast("HoldfastError | None", future.exception())
            self.is_refused = self.job._cell is None
            self.set_result(Ok(self.item, future.result()) if error is None else Failed(self.item, error))

    def set_result(self, result: Ok[Any, Any] | Failed[Any]) -> None:
        """What is handed to the taker."""
        self.result = result
        self._done.append(self)


class _Source:
    """The items of a stream, pulled one at a time; of an async iterable in a task, while jobs run."""

    def __init__(self, items: Iterable[Any] | AsyncIterable[Any]) -> None:
        self._sync: Iterator[Any] | None = None
        self._async: AsyncIterator[Any] | None = None
        self._pulling: asyncio.Task[Any] | None = None
        self._is_over = False
        if isinstance(items, AsyncIterable):
            self._async = aiter(items)
        else:
            self._sync = iter(items)

    def take(self) -> list[Any]:
        """The next item, if it is there now. Raises what the source does."""
        if self._is_over:
            return []
        try:
            if self._sync is not None:
                return [next(self._sync)]
            if self._pulling is None or not self._pulling.done():
                return []
            pulled, self._pulling = self._pulling, None
            return [pulled.result()]
        except (StopIteration, StopAsyncIteration):
            self._is_over = True
            return []

    def pulling(self) -> asyncio.Task[Any] | None:
        """What to wait for until the next item is there; None if there will be none, or it need not be waited for."""
        if self._async is None or self._is_over:
            return None
        if self._pulling is None:
            self._pulling = asyncio.get_running_loop().create_task(_next(self._async), name="pull of a stream")
        return self._pulling

    def close(self) -> None:
        """No more of it."""
        if self._pulling is not None:
            self._pulling.cancel()


async def _next(source: AsyncIterator[Any]) -> Any:
    return await anext(source)


async def stream_of(
    begin: Callable[[Any], Job[Any]],
    items: Iterable[Any] | AsyncIterable[Any],
    most: int,
    ordered: bool,
    timeout: float | None,
    on_timeout: OnTimeout,
) -> AsyncGenerator[Any, None]:
    """The results of the jobs that `begin` starts; see `Tasks.stream`."""
    loop = asyncio.get_running_loop()
    source = _Source(items)
    window: deque[_Slot] = deque()  # in the order of the items
    done: deque[_Slot] = deque()  # in that of their ends
    is_hurried = False
    try:
        while True:
            while len(window) < most and (found := source.take()):
                deadline = math.inf if timeout is None else loop.time() + timeout
                window.append(_Slot(found[0], begin(found[0]), deadline, done))
            for slot in done:
                if slot.is_refused and isinstance(slot.result, Failed):
                    raise slot.result.error
            ready = window if ordered else done
            if ready and (result := ready[0].result) is not None:
                slot = ready[0]
                window.remove(slot)
                done.remove(slot)
                yield result
                continue
            waited: list[asyncio.Future[Any]] = [slot.job._future for slot in window if slot.result is None]
            if len(window) < most and (pulling := source.pulling()) is not None:
                waited.append(pulling)
            if not waited:
                return
            soonest = min((slot.deadline for slot in window if slot.result is None), default=math.inf)
            left = None if soonest == math.inf else max(0.0, soonest - loop.time())
            await asyncio.wait(waited, timeout=left, return_when=asyncio.FIRST_COMPLETED)
            for slot in window:
                if slot.result is None and slot.deadline <= loop.time() and not slot.job.is_done:
                    late = AskTimeout(slot.job.path, timeout or 0.0, None)
                    if on_timeout == "exit":
                        raise late
                    slot.set_result(Failed(slot.item, late))
                    slot.job.kill()
    except asyncio.CancelledError:
        is_hurried = True  # Whoever is killed must not wait for others.
        raise
    finally:
        source.close()
        for slot in window:
            slot.job.cancel()
        if window and not is_hurried:
            await asyncio.wait([slot.job._future for slot in window])
