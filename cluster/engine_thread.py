"""Where an engine's work runs: a thread with an event loop of its own, so that a busy program keeps its lease."""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Callable, Coroutine
from typing import Any, Final, Protocol, TypeVar

T = TypeVar("T")
LAST_TICKS: Final = 10
"""How often a loop that ends comes round once more: to close a connection takes a few times."""


async def end_tasks(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks, and wait until they have ended; whoever is cancelled meanwhile waits, too.

    One that waits by `asyncio.wait_for` may miss a cancellation that comes just when it gets what it waits for (until
    Python 3.12): it is cancelled again.
    """
    cancelled: asyncio.CancelledError | None = None
    while left := [task for task in tasks if not task.done()]:
        for task in left:
            task.cancel()
        try:
            await asyncio.wait(left, timeout=0.05)
        except asyncio.CancelledError as error:
            cancelled = error
    if cancelled is not None:
        raise cancelled


class EngineLoop(Protocol):
    """The event loop on which an engine's coroutines run, as others see it."""

    def soon(self, call: Callable[[], None]) -> None:
        """Have something called on that loop, soon."""
        ...

    def wait(self, work: Coroutine[Any, Any, T], seconds: float | None = None) -> T:
        """Run a coroutine on that loop, and wait for it.

        Raises:
            TimeoutError: it has taken longer, and was cancelled.
        """
        ...

    def finish(self, work: Coroutine[Any, Any, None], seconds: float) -> None:
        """Run the last coroutine on that loop.

        Raises:
            TimeoutError: it has taken longer, and was cancelled.
        """
        ...

    def close(self) -> None:
        """End the loop; everything that still runs on it is cancelled."""
        ...


class EngineThread:
    """An event loop in a thread of its own; it ends with the process at the latest."""

    def __init__(self, name: str) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        asyncio.set_event_loop(self.loop)
        try:
            self.loop.run_forever()
        finally:
            left = asyncio.all_tasks(self.loop)
            for task in left:
                task.cancel()
            if left:
                self.loop.run_until_complete(asyncio.wait(left, timeout=1.0))
            for _ in range(LAST_TICKS):  # Transports that were closed are let go of.
                self.loop.run_until_complete(asyncio.sleep(0))
            self.loop.close()

    def soon(self, call: Callable[[], None]) -> None:
        """Have something called on that loop, soon; nothing happens if it has ended."""
        try:
            self.loop.call_soon_threadsafe(call)
        except RuntimeError:  # It has ended: nobody is left who would care.
            if not self.loop.is_closed():
                raise

    def run(self, work: Coroutine[Any, Any, T]) -> asyncio.Future[T]:
        """Run a coroutine on that loop, for somebody on the running one; to cancel the future cancels it."""
        return asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self.loop))

    def wait(self, work: Coroutine[Any, Any, T], seconds: float | None = None) -> T:
        """Run a coroutine on that loop, and wait for it; see `EngineLoop`."""
        running = asyncio.run_coroutine_threadsafe(work, self.loop)
        try:
            return running.result(seconds)
        except concurrent.futures.TimeoutError:
            running.cancel()
            raise

    def finish(self, work: Coroutine[Any, Any, None], seconds: float) -> None:
        """Run the last coroutine on that loop, and wait for it; see `EngineLoop`."""
        self.wait(work, seconds)

    def close(self) -> None:
        """End the loop and its thread; see `EngineLoop`."""
        self.soon(self.loop.stop)
        self._thread.join(5.0)
