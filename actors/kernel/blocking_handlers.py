"""Blocking handlers: a turn that runs in a worker thread, while the event loop goes on.

It is a turn like any other: one at a time, in the actor's own context. What it does through `self.ctx` or a ref is done
on the event loop, and the thread waits for it.

The threads are a node's own, for a thread cannot be stopped: one that hangs keeps its place among the few there may be,
whoever has given up on it, and does not keep the program alive.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import contextvars
import functools
import inspect
import math
import queue
import threading
from collections.abc import Callable
from time import monotonic
from types import FunctionType
from typing import TYPE_CHECKING, Any, TypeVar, cast

from ..errors import HoldfastError
from .ref import current

if TYPE_CHECKING:
    from .actor import Actor
    from .cell import Cell, Order
    from .context import ActorContext
    from .envelope import Handler
    from .message import Message


T = TypeVar("T")

MOST = 40
"""Threads of one node; what comes when all are busy waits for one."""

LOOK_AGAIN = 0.5
"""Seconds between two looks of a waiting thread at whether the event loop it waits for is still there."""


def wait_on_loop(
    loop: asyncio.AbstractEventLoop, outcome: concurrent.futures.Future[Any], seconds: float = math.inf
) -> bool:
    """Have a thread wait for what was handed to an event loop. False: it will not come.

    What is handed over while a loop takes its last steps is neither refused nor ever done: so the wait is for the loop,
    too, and ends when that has been closed, or after `seconds`.
    """
    end = monotonic() + seconds
    while True:
        is_last = loop.is_closed() or monotonic() > end  # Asked first: what was done until then has come.
        concurrent.futures.wait((outcome,), 0.0 if is_last else LOOK_AGAIN)
        if outcome.done() or is_last:
            return outcome.done()


class HandlerThreads(concurrent.futures.Executor):
    """The worker threads of a node: started when first needed, reused, never more than `MOST`."""

    def __init__(self) -> None:
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._idle = threading.Semaphore(0)
        self._count = 0
        self.alone = asyncio.Lock()  # held by one that is not to run beside others of its kind

    def run(self, function: Callable[..., T], *args: Any) -> asyncio.Future[T]:
        """Run a function in a thread, with the caller's context variables. Cancelling leaves a begun one behind."""
        # By way of the loop, for one with a virtual clock must know that a thread is at work.
        context = contextvars.copy_context()
        return asyncio.get_running_loop().run_in_executor(self, lambda: context.run(function, *args))

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> concurrent.futures.Future[T]:
        """As `Executor` has it; called on the event loop."""
        done: concurrent.futures.Future[T] = concurrent.futures.Future()
        work = functools.partial(fn, *args, **kwargs)

        def answer() -> None:
            if done.set_running_or_notify_cancel():
                _answer(done, work)

        self._work.put(answer)
        if not self._idle.acquire(blocking=False) and self._count < MOST:
            self._count += 1
            threading.Thread(target=self._serve, name="holdfast worker", daemon=True).start()
        return done

    def _serve(self) -> None:
        while (work := self._work.get()) is not None:
            work()
            del work  # Or what it holds would live until there is more to do.
            self._idle.release()

    def close(self) -> None:
        """End the threads that have nothing to do; those that hang are left behind."""
        for _ in range(self._count):
            self._work.put(None)


def _answer(done: concurrent.futures.Future[Any], work: Callable[[], Any]) -> None:
    try:
        value = work()
    except StopIteration as error:  # No future takes it; a coroutine that raises it is told the same.
        stopped = RuntimeError("a function in a thread has raised StopIteration")
        stopped.__cause__ = error
        done.set_exception(stopped)
    except BaseException as error:  # Whoever waits for it gets it.
        done.set_exception(error)
    else:
        done.set_result(value)


def in_thread(handler: Callable[[Any, Any], Any]) -> Handler:
    """A handler that has `handler` run in a worker thread.

    A thread cannot be stopped: when the turn is killed, its life ends at once, and what the thread does later is
    ignored or refused.
    """

    @functools.wraps(handler)
    async def turn(actor: Actor, message: Message[Any]) -> Any:
        ctx = actor.ctx
        threaded = ThreadContext(ctx)
        actor.ctx = cast("ActorContext", threaded)
        is_left_behind = False
        try:
            return await ctx._cell.node.threads.run(_run, threaded, handler, actor, message)
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
        if name in ("create_task", "effect", "flush", "pipe_to_self", "publish", "sleep", "sleep_until", "wait_for"):
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

    def _tell(self, cell: Cell, message: Message[Any]) -> None:
        """Send a tell from the worker thread, through the event loop."""
        self._on_loop(self._ctx._tell, cell, message)

    def _order(self, cell: Cell, order: Order) -> None:
        """Give an order from the worker thread, through the event loop."""
        self._on_loop(self._ctx._order, cell, order)

    def _send(self, cell: Cell, message: Message[Any]) -> Any:
        """A ref's send: nothing here can be awaited."""
        if threading.get_ident() != self._thread:
            return self._ctx._send(cell, message)
        raise HoldfastError(f"{self._ctx.path}: a blocking handler cannot await a send; use tell, or `async def`")

    def _ask(self, cell: Cell, message: Message[Any], timeout: float) -> Any:
        """A ref's ask: nothing here can be awaited."""
        if threading.get_ident() != self._thread:
            return self._ctx._ask(cell, message, timeout)
        raise HoldfastError(f"{self._ctx.path}: a blocking handler cannot await an ask; make it `async def`")

    def _on_loop(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        if threading.get_ident() != self._thread:
            return function(*args, **kwargs)
        done: concurrent.futures.Future[Any] = concurrent.futures.Future()
        work = functools.partial(_answer, done, functools.partial(self._checked, function, *args, **kwargs))
        loop = self._ctx._cell.node.loop
        with contextlib.suppress(RuntimeError):  # The loop is closed: nobody is left to do it.
            loop.call_soon_threadsafe(work, context=contextvars.copy_context())
        if not wait_on_loop(loop, done):
            raise HoldfastError(f"{self._ctx.path}: the system has ended, and with it the turn of this thread")
        return done.result()

    def _checked(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        if self._is_over:
            self._ctx._alive()
            raise HoldfastError(f"{self._ctx.path}: the turn of this thread is over")
        return function(*args, **kwargs)


def is_async(function: Callable[..., Any]) -> bool:
    """Whether calling it gives a coroutine; anything else may block."""
    while isinstance(function, functools.partial):
        function = function.func
    if isinstance(function, FunctionType) and function.__code__.co_flags & inspect.CO_COROUTINE:
        return True  # As `inspect` would find out, in a tenth of the time: there is one for each effect.
    return inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(getattr(function, "__call__", None))  # noqa: B004
