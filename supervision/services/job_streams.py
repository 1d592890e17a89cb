"""Streams of jobs: one for each item of a source that is pulled only as fast as results are taken."""

from __future__ import annotations

import asyncio
import math
from collections import OrderedDict, deque
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator, Callable, Iterable, Iterator
from typing import Any, Literal, cast

from ...actors.errors import AskTimeout, HoldfastError, RemoteCrash
from ...actors.kernel.context import contained, uncontained
from .awaited_jobs import Failed, Job, Ok

OnTimeout = Literal["exit", "kill_task"]


class _Slot:
    """An item between its source and the taker of its result."""

    __slots__ = ("deadline", "item", "job", "result")

    def __init__(self, item: Any, job: Job[Any], deadline: float) -> None:
        self.item, self.job, self.deadline = item, job, deadline
        self.result: Ok[Any, Any] | Failed[Any] | None = None


class _Window:
    """What is between the source and the taker: whatever happens there costs the same, however much it is."""

    def __init__(self, ordered: bool) -> None:
        self._is_ordered = ordered
        self.slots: OrderedDict[_Slot, None] = OrderedDict()  # in the order of the items
        self._done: deque[_Slot] = deque()  # in that of their ends, if that is how they are taken
        self._due: OrderedDict[_Slot, None] = OrderedDict()  # in that of their deadlines, which is that of the items
        self._woken: asyncio.Future[None] | None = None
        self.refused: HoldfastError | None = None  # why there was no job at all for one

    def add(self, slot: _Slot) -> None:
        """A job has been started."""
        self.slots[slot] = None
        if slot.deadline != math.inf:
            self._due[slot] = None
        slot.job._future.add_done_callback(lambda future: self._ended(slot, future))

    def _ended(self, slot: _Slot, future: asyncio.Future[Any]) -> None:
        if slot.result is not None:
            return
        error = cast("HoldfastError | None", future.exception())
        if error is not None and slot.job._cell is None:
            self.refused = error
        self.set_result(slot, Ok(slot.item, future.result()) if error is None else Failed(slot.item, error))

    def set_result(self, slot: _Slot, result: Ok[Any, Any] | Failed[Any]) -> None:
        """What is handed to the taker."""
        slot.result = result
        self._due.pop(slot, None)
        if not self._is_ordered:
            self._done.append(slot)
        self.wake()

    def wake(self, _: object = None) -> None:
        """Wake whoever waits for the next outcome."""
        if self._woken is not None and not self._woken.done():
            self._woken.set_result(None)

    def take(self) -> Ok[Any, Any] | Failed[Any] | None:
        """The next result for the taker, if it is there."""
        ready = next(iter(self.slots), None) if self._is_ordered else self._done[0] if self._done else None
        if ready is None or ready.result is None:
            return None
        del self.slots[ready]
        if not self._is_ordered:
            self._done.popleft()
        return ready.result

    async def wait(self, loop: asyncio.AbstractEventLoop) -> None:
        """Wait until something has happened, or the next deadline is there."""
        soonest = next(iter(self._due), None)
        left = None if soonest is None else max(0.0, soonest.deadline - loop.time())
        self._woken = loop.create_future()
        await asyncio.wait((self._woken,), timeout=left)

    def late(self, now: float) -> _Slot | None:
        """A job that has not ended in its time."""
        while (soonest := next(iter(self._due), None)) is not None and soonest.deadline <= now:
            del self._due[soonest]
            if not soonest.job.is_done:
                return soonest
        return None


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
        except RemoteCrash as error:
            raise uncontained(error) from error.__cause__

    def pulling(self, there: Callable[[object], None]) -> asyncio.Task[Any] | None:
        """Pull the next item, and call `there` when it is there; None if there will be none, or it is there."""
        if self._async is None or self._is_over:
            return None
        if self._pulling is None:
            pull = contained(_next(self._async))
            self._pulling = asyncio.get_running_loop().create_task(pull, name="pull of a stream")
            self._pulling.add_done_callback(there)
        return self._pulling

    def close(self) -> None:
        """Take nothing more from the source."""
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
    source, window = _Source(items), _Window(ordered)
    is_hurried = False
    try:
        while True:
            while len(window.slots) < most and (found := source.take()):
                deadline = math.inf if timeout is None else loop.time() + timeout
                window.add(_Slot(found[0], begin(found[0]), deadline))
            if window.refused is not None:
                raise window.refused
            if (result := window.take()) is not None:
                yield result
                continue
            pulling = source.pulling(window.wake) if len(window.slots) < most else None
            if pulling is None and not window.slots:
                return
            await window.wait(loop)
            while (slot := window.late(loop.time())) is not None:
                late = AskTimeout(slot.job.path, timeout or 0.0, None)
                if on_timeout == "exit":
                    raise late
                window.set_result(slot, Failed(slot.item, late))
                slot.job.kill()
    except asyncio.CancelledError:
        is_hurried = True  # Whoever is killed must not wait for others.
        raise
    finally:
        source.close()
        for slot in window.slots:
            slot.job.cancel()
        if window.slots and not is_hurried:
            await asyncio.wait([slot.job._future for slot in window.slots])
