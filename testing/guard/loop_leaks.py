"""Leaks in a loop: tasks and timers that a test leaves behind, and exceptions that nobody has seen."""

from __future__ import annotations

import asyncio
import gc
import weakref
from collections.abc import Collection, Iterable, Mapping
from types import AsyncGeneratorType
from typing import TYPE_CHECKING, Any

from ...actors.kernel.ref import current
from ..library_code import is_module_of_library
from .loop_methods import LoopMethods
from .thread_leaks import is_installed

if TYPE_CHECKING:
    from ...actors.kernel.node import Node

TASK_GRACE = 10
"""Turns of the loop that a cancelled task may take to end."""
MANY = 1000
"""Timers, and futures, that are noted before those that are over are forgotten."""


class LoopLeaks:
    """What there was in the running loop at the beginning, so that what is more at the end is a leak.

    Made before the code under test begins, in the same loop. It notes futures, tasks and timers as they are made, up to
    `told`: to look through all objects at the end would take longer than the test. Where no loop runs there is nothing
    to note.

    Args:
        allowed: kinds of leaks that are not told.
    """

    def __init__(self, allowed: Collection[str] = ()) -> None:
        self._allowed = frozenset(allowed)
        self._timers: list[tuple[asyncio.Handle, float, Any]] = []  # with when they are due, and what they call
        self._futures: list[tuple[weakref.ref[asyncio.Future[Any]], Node | None]] = []  # with whose actors made them
        self._most_timers = self._most_futures = MANY
        self._lost: list[tuple[str, BaseException]] = []
        self._loop: Any = None
        try:
            self._loop = asyncio.get_running_loop()
        except RuntimeError:
            self._tasks, self._handler = set[asyncio.Task[object]](), None
            self._generators = set()
            return
        self._tasks = asyncio.all_tasks()
        self._generators = self._open_generators()
        self._handler = self._loop.get_exception_handler()
        self._methods = LoopMethods.of(type(self._loop))
        self._methods.note(self._loop, self)

    def timer_made(self, handle: asyncio.Handle, when: float, callback: Any) -> None:
        """A timer is new, due at a time of the loop's clock."""
        self._timers.append((handle, when, callback))
        if len(self._timers) > self._most_timers:
            self._timers = self._waiting()
            self._most_timers = max(MANY, 2 * len(self._timers))

    def future_made(self, made: asyncio.Future[Any]) -> None:
        """A future or task is new."""
        maker = current.get(None)  # A WeakSet takes ten times as long.
        self._futures.append((weakref.ref(made), None if maker is None else maker._cell.node))
        if len(self._futures) > self._most_futures:
            self._futures = [one for one in self._futures if one[0]() is not None]
            self._most_futures = max(MANY, 2 * len(self._futures))

    def exception_told(self, context: dict[str, Any]) -> None:
        """The loop's handler of exceptions is about to hear of this."""
        error = context.get("exception")
        if isinstance(error, BaseException) and self._loop.get_exception_handler() is self._handler:
            self._lost.append((str(context.get("message", "")), error))

    def _waiting(self) -> list[tuple[asyncio.Handle, float, Any]]:
        now = self._loop.time()
        return [timer for timer in self._timers if timer[1] > now and not timer[0].cancelled()]

    async def told(self) -> list[str]:
        """What is left in this loop, as problems. Nothing is noted any more."""
        self._stop()
        tasks = await self.tasks()
        timers = [] if "timers" in self._allowed else self.timers(of_tasks=not tasks)
        return [
            *(f"a task was left running: {text}" for text in tasks if "tasks" not in self._allowed),
            *(f"a timer was left: {text}; cancel its handle" for text in timers),
            *(f"an async generator was left open: {text}; close it (aclose)" for text in self.generators()),
        ]

    def generators(self) -> list[str]:
        """Async generators of the test that were begun, and neither ended nor closed."""
        if "generators" in self._allowed or not self._new_generators():
            return []
        gc.collect()  # What only a reference cycle holds is closed by the loop.
        return [f"{one.__qualname__} at {one.ag_code.co_filename}" for one in self._new_generators()]

    def _new_generators(self) -> list[AsyncGeneratorType[Any, Any]]:
        left = self._open_generators() - self._generators
        return [one for one in left if one.ag_frame is not None and not is_installed(one.ag_code.co_filename)]

    def _open_generators(self) -> set[AsyncGeneratorType[Any, Any]]:
        """Those that the loop knows of; uvloop does not show them."""
        if not isinstance(self._loop, asyncio.BaseEventLoop):
            return set()
        known: Any = self._loop
        return {*known._asyncgens}

    async def tasks(self) -> list[str]:
        """Tasks that are not ours and still run after a few turns of the loop."""
        left = self._new_tasks()
        for _ in range(TASK_GRACE):
            if not left:
                break
            await asyncio.sleep(0)
            left = self._new_tasks()
        return [repr(task) for task in left]

    def _new_tasks(self) -> set[asyncio.Task[object]]:
        return asyncio.all_tasks() - self._tasks - {asyncio.current_task()}

    def timers(self, *, of_tasks: bool = True) -> list[str]:
        """Timers that still wait; with those that tasks sleep by, if these are not told of themselves."""
        found: dict[int, str] = {}
        for handle, when, callback in self._waiting():
            name = getattr(callback, "__qualname__", repr(callback))
            if not of_tasks and name == "_set_result_unless_cancelled":
                continue
            module = getattr(callback, "__module__", None) or ""
            if not is_module_of_library(module):  # What our own systems have yet to do is no fault of the test's.
                found[id(handle)] = f"{module}.{name}".removeprefix(".") + f", due in {when - self._loop.time():.3g} s"
        return list(found.values())

    def unseen(self, asks: Mapping[asyncio.Future[Any], tuple[str, object]] | None = None) -> list[str]:
        """Exceptions of tasks, futures and callbacks that nobody has seen, as problems.

        Args:
            asks: by their futures, whom they have asked and what.
        """
        found: dict[int, str] = {}
        for message, error in self._lost:
            found[id(error)] = f"{_text(error)} ({message})"
        for noted, _ in self._futures:
            future = noted()
            failure = None if future is None else _unseen(future)
            if future is None or failure is None or id(failure) in found:
                continue
            asked = (asks or {}).get(future)
            what = repr(future) if asked is None else f"the ask of {asked[1]!r} to {asked[0]}"
            found[id(failure)] = f"{_text(failure)} (nobody has awaited {what})"
        hint = "await it, or if it is meant to be: actor_system.expect_exceptions()"
        return [f"an exception was never seen: {text}; {hint}" for text in found.values()]

    def forget(self, futures: Iterable[asyncio.Future[Any]]) -> None:
        """Nobody need see how these have ended."""
        for future in futures:
            _unseen(future)

    def actors_killed(self, node: Node) -> None:
        """The actors of a node were killed, all of them: what has come for them they could not see any more."""
        made = (noted() for noted, maker in self._futures if maker is node)
        self.forget(future for future in made if future is not None)

    def close(self) -> None:
        """Note nothing any more."""
        self._stop()
        self._timers.clear()

    def _stop(self) -> None:
        if self._loop is not None:
            self._methods.stop(self._loop, self)


def _unseen(future: asyncio.Future[Any]) -> BaseException | None:
    """The exception of a future that nobody has retrieved yet; asyncio does not tell of it any more."""
    if not future.done() or future.cancelled() or not getattr(future, "_log_traceback", False):
        return None
    error = future.exception()
    future._log_traceback = False  # It is told here; asyncio would log it again
    return error


def _text(error: BaseException) -> str:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    place = "" if trace is None else f", raised at {trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}"
    return f"{type(error).__name__}: {error}{place}"
