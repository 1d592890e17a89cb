"""Reports what an event loop makes: futures, tasks, timers, and exceptions that nobody takes.

The methods of the loop's class are exchanged, once, and stay so. To exchange those of each new loop takes longer, in
all that is done with that loop.
"""

from __future__ import annotations

import asyncio
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from ...checkpoint.life.recorded_context import OutcomeFuture
from ..swaps import Swaps

if TYPE_CHECKING:
    from ...actors.kernel.node import Node


class LoopNotes(Protocol):
    """Whoever notes what is made in a loop."""

    def timer_made(self, handle: asyncio.Handle, when: float, callback: Any) -> None:
        """A timer is new, due at a time of the loop's clock."""

    def future_made(self, made: asyncio.Future[Any]) -> None:
        """A future or task is new."""

    def exception_told(self, context: dict[str, Any]) -> None:
        """The loop's handler of exceptions is about to hear of this."""

    def actors_killed(self, node: Node) -> None:
        """The actors of a node were killed, all of them."""


class LoopMethods:
    """The methods of the loops of one class."""

    def __init__(self, kind: Any) -> None:
        self._notes: dict[asyncio.AbstractEventLoop, tuple[LoopNotes, ...]] = {}
        swaps = Swaps()
        swaps.put(kind, "call_at", self._noting_timers(kind, "call_at", lambda loop: 0.0))
        if kind.call_later is not asyncio.BaseEventLoop.call_later:  # It calls `call_at`.
            swaps.put(kind, "call_later", self._noting_timers(kind, "call_later", kind.time))
        for name in ("create_future", "create_task"):
            swaps.put(kind, name, self._noting_futures(kind, name))
        swaps.put(kind, "call_exception_handler", self._noting_exceptions(kind))
        swaps.put(OutcomeFuture, "__init__", self._noting_outcomes(OutcomeFuture.__init__))  # No loop makes these.

    @staticmethod
    def of(kind: type) -> LoopMethods:
        """Those that stand at a class, or new ones."""
        standing = getattr(vars(kind).get("call_at"), "methods", None)
        return standing if isinstance(standing, LoopMethods) else LoopMethods(kind)

    def note(self, loop: asyncio.AbstractEventLoop, notes: LoopNotes) -> None:
        """Tell this one, too, what is made in a loop."""
        self._notes[loop] = *self._notes.get(loop, ()), notes

    def stop(self, loop: asyncio.AbstractEventLoop, notes: LoopNotes) -> None:
        """Tell it no more; a second call changes nothing."""
        left = tuple(one for one in self._notes.pop(loop, ()) if one is not notes)
        if left:
            self._notes[loop] = left

    def actors_killed(self, loop: asyncio.AbstractEventLoop, node: Node) -> None:
        """Tell that the actors of a node in this loop were killed."""
        for one in self._notes.get(loop, ()):
            one.actors_killed(node)

    def _noting_timers(self, kind: Any, name: str, origin: Callable[[Any], float]) -> Any:
        notes, owner = self._notes, owner_of(kind, name)

        def noted(loop: Any, time: float, callback: Any, *args: Any, **options: Any) -> asyncio.Handle:
            handle: asyncio.Handle = getattr(owner, name)(loop, time, callback, *args, **options)
            for one in notes.get(loop, ()):
                one.timer_made(handle, origin(loop) + time, callback)
            return handle

        noted.methods = self  # type: ignore[attr-defined]  # so that the next test finds them
        return noted

    def _noting_futures(self, kind: Any, name: str) -> Any:
        notes, owner = self._notes, owner_of(kind, name)

        def noted(loop: Any, *args: Any, **options: Any) -> Any:
            made = getattr(owner, name)(loop, *args, **options)
            for one in notes.get(loop, ()):
                one.future_made(made)
            return made

        return noted

    def _noting_outcomes(self, init: Callable[..., None]) -> Any:
        notes = self._notes

        def noted(made: OutcomeFuture[Any], *, loop: asyncio.AbstractEventLoop) -> None:
            init(made, loop=loop)
            for each in notes.get(loop, ()):
                each.future_made(made)

        return noted

    def _noting_exceptions(self, kind: Any) -> Any:
        notes, owner = self._notes, owner_of(kind, "call_exception_handler")

        def noted(loop: Any, context: dict[str, Any]) -> None:
            for one in notes.get(loop, ()):
                one.exception_told(context)
            owner.call_exception_handler(loop, context)

        return noted


def owner_of(kind: Any, name: str) -> Any:
    """Whoever has the method that a class of loops has had: what keeps its own one, or the base that it comes from.

    It is looked up there at each call, for a test may exchange the method of a base.
    """
    if name in vars(kind):
        return types.SimpleNamespace(**{name: vars(kind)[name]})
    return next(base for base in kind.__mro__ if name in vars(base))
