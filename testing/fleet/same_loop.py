"""The engine's work on the loop of the program itself, for simulations: see `cluster.engine_thread.EngineLoop`."""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from ...actors.errors import HoldfastError

T = TypeVar("T")


class WouldWait(
    HoldfastError,
    text="{work} has to wait for the loop on which it was called: await it there, or call it in a thread",
):
    """Something was to be waited for on the very loop that has to do it."""

    work: str


class SameLoop:
    """The running loop, as an `EngineLoop`: nothing has a thread of its own, so that a seed decides everything."""

    def __init__(self) -> None:
        self._loop, self._thread = asyncio.get_running_loop(), threading.get_ident()
        self._last: set[asyncio.Task[None]] = set()

    def soon(self, call: Callable[[], None]) -> None:
        """Have something called soon; nothing happens if the loop has ended."""
        if threading.get_ident() == self._thread:
            self._loop.call_soon(call)
        else:
            self._loop.call_soon_threadsafe(call)

    def wait(self, work: Coroutine[Any, Any, T], seconds: float | None = None) -> T:
        """Run a coroutine: at once if called on the loop, where it must not wait for anything.

        Raises:
            WouldWait: it has to wait, for as long as it takes; what it has done until then stays done.
            TimeoutError: it has taken longer, and was cancelled; on the loop each wait takes longer than any time.
        """
        if threading.get_ident() != self._thread:
            running = asyncio.run_coroutine_threadsafe(work, self._loop)
            try:
                return running.result(seconds)
            except concurrent.futures.TimeoutError:
                running.cancel()
                raise
        try:
            work.send(None)
        except StopIteration as done:
            result: T = done.value
            return result
        work.close()
        if seconds is not None:
            raise TimeoutError
        raise WouldWait(repr(work))

    def run(self, work: Coroutine[Any, Any, T]) -> asyncio.Future[T]:
        """Run a coroutine, for somebody who awaits it."""
        return asyncio.ensure_future(work, loop=self._loop)

    def finish(self, work: Coroutine[Any, Any, None], seconds: float) -> None:
        """Run the last coroutine; whoever ends a program does not wait for it. What has not ended in time is cancelled.

        Its errors are of what may be lost, which the next leader does not miss.
        """
        last = self._loop.create_task(asyncio.wait_for(work, seconds), name="the end of a journal")
        self._last.add(last)
        last.add_done_callback(self._ended)

    def _ended(self, last: asyncio.Task[None]) -> None:
        self._last.discard(last)
        if not last.cancelled():
            last.exception()

    def close(self) -> None:
        """Do nothing: the loop is the program's."""
