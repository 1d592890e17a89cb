"""Blocking handlers: a turn that runs in a worker thread, while the event loop goes on.

It is a turn like any other: one at a time, in the actor's own context. What it does through `self.ctx` or a ref is done
on the event loop, and the thread waits for it.
"""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from .errors import HoldfastError
from .ref import current

if TYPE_CHECKING:
    from .actor import Actor
    from .cell import Cell
    from .context import ActorContext
    from .mail import Handler
    from .message import Message


def in_thread(handler: Callable[[Any, Any], Any]) -> Handler:
    """A handler that has `handler` run in a worker thread.

    A thread cannot be stopped: when the turn is killed, its life ends at once, and what the thread does later is
    ignored or refused.
    """

    @functools.wraps(handler)
    async def turn(actor: Actor, message: Message[Any]) -> Any:
        from anyio import to_thread  # Not needed by most, and slow to import.

        ctx = actor.ctx
        threaded = ThreadContext(ctx)
        actor.ctx = cast("ActorContext", threaded)
        is_left_behind = False
        try:
            return await to_thread.run_sync(_run, threaded, handler, actor, message, abandon_on_cancel=True)
        except asyncio.CancelledError:
            is_left_behind = True  # The thread goes on, and has to be told no: `ctx` stays what it is.
            raise
        finally:
            threaded._is_over = True
            if not is_left_behind:
                actor.ctx = ctx

    return turn


def _run(threaded: ThreadContext, handler: Callable[[Any, Any], Any], actor: Actor, message: Message[Any]) -> Any:
    threaded._thread = threading.get_ident()
    current.set(cast("ActorContext", threaded))  # In the thread's own copy of the context.
    return handler(actor, message)


class ThreadContext:
    """Stands for the actor's `ctx` while a thread runs its turn: calls from the thread are made on the event loop."""

    def __init__(self, ctx: ActorContext) -> None:
        self._ctx = ctx
        self._thread = -1
        self._is_over = False

    def __getattr__(self, name: str) -> Any:
        if threading.get_ident() != self._thread:
            return getattr(self._ctx, name)  # The loop's own business, or a background task's.
        if name in ("create_task", "flush", "pipe_to_self", "publish"):
            raise HoldfastError(f"{self._ctx.path}: a blocking handler cannot use ctx.{name}; make it `async def`")
        value = self._on_loop(getattr, self._ctx, name)
        if not callable(value) or name == "random":
            return value
        return functools.partial(self._on_loop, value)

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            setattr(self._ctx, name, value)

    def tell(self, cell: Cell, message: Message[Any]) -> None:
        """A ref's tell."""
        self._on_loop(self._ctx.tell, cell, message)

    def send(self, cell: Cell, message: Message[Any]) -> Any:
        """A ref's send: nothing here can be awaited."""
        if threading.get_ident() != self._thread:
            return self._ctx.send(cell, message)
        raise HoldfastError(f"{self._ctx.path}: a blocking handler cannot await a send; use tell, or `async def`")

    def ask(self, cell: Cell, message: Message[Any], timeout: float) -> Any:
        """A ref's ask: nothing here can be awaited."""
        if threading.get_ident() != self._thread:
            return self._ctx.ask(cell, message, timeout)
        raise HoldfastError(f"{self._ctx.path}: a blocking handler cannot await an ask; make it `async def`")

    def _on_loop(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        if threading.get_ident() != self._thread:
            return function(*args, **kwargs)
        from anyio import from_thread

        return from_thread.run_sync(functools.partial(self._checked, function, *args, **kwargs))

    def _checked(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        if self._is_over:
            self._ctx._alive()
            raise HoldfastError(f"{self._ctx.path}: the turn of this thread is over")
        return function(*args, **kwargs)
