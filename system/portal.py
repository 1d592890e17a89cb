"""Calls from other threads: the handle that `system.from_thread()` returns."""

from __future__ import annotations

import asyncio
import concurrent.futures
import math
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, TypeVar

from ..actors.errors import ActorStopped, AskTimeout, HoldfastError
from ..actors.kernel.blocking_handlers import LOOK_AGAIN, wait_on_loop
from ..actors.kernel.message import Message
from ..actors.kernel.ref import DEFAULT_TIMEOUT, ActorRef, cell_of
from ..actors.seconds import check_seconds

if TYPE_CHECKING:
    from ..actors.kernel.node import Node

R = TypeVar("R")


class ThreadPortal:
    """A handle for threads other than the system's own. Made by `ActorSystem.from_thread()`; any thread may use it.

    Each call is carried out on the system's event loop. What one thread sends to one actor arrives in the order
    in which it was sent. `tell`, `send` and `ask` block the calling thread; `ask_async` and `send_async` are for a
    thread that runs an event loop of its own.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._tasks: set[asyncio.Task[Any]] = set()  # of calls that are under way

    def tell(self, ref: ActorRef[Any], message: Message[Any]) -> None:
        """Send, and return when the message is in the mailbox.

        Raises:
            UnknownMessage, MailboxFull, BadMessage: as `ActorRef.tell`. ActorStopped: the system has ended.
        """
        cell_of("tell", ref)
        outcome: concurrent.futures.Future[None] = concurrent.futures.Future()

        def call() -> None:
            try:
                self._check(ref)
                ref.tell(message)
            except BaseException as error:
                outcome.set_exception(error)
            else:
                outcome.set_result(None)

        self._hand_over(ref, call)
        self._wait(ref, outcome)

    def send(self, ref: ActorRef[Any], message: Message[Any]) -> None:
        """Send, and return when the message is accepted: at a full mailbox that may take as long as it is full.

        Raises:
            ActorStopped, UnknownMessage, MailboxFull, BadMessage: as `ActorRef.send`.
        """
        self._wait(ref, self._begin(ref, _send, ref, message))

    def ask(self, ref: ActorRef[Any], message: Message[R], timeout: float = DEFAULT_TIMEOUT) -> R:
        """Ask, and return the reply.

        Args:
            ref: who is asked.
            message: what is asked; its class declares the reply's type.
            timeout: seconds until the deadline, > 0.

        Raises:
            SpecError, Refusal, AskTimeout, ActorStopped, AskFailed, RemoteCrash: as `ActorRef.ask`.
        """
        check_seconds(cell_of("ask", ref).path, "timeout", timeout)
        outcome: concurrent.futures.Future[R] = self._begin(ref, _ask, ref, message, timeout)
        return self._wait(ref, outcome, timeout)

    async def send_async(self, ref: ActorRef[Any], message: Message[Any]) -> None:
        """Send as `send` does, awaited on the calling thread's own event loop."""
        await self._come(ref, self._begin(ref, _send, ref, message))

    async def ask_async(self, ref: ActorRef[Any], message: Message[R], timeout: float = DEFAULT_TIMEOUT) -> R:
        """Ask as `ask` does, awaited on the calling thread's own event loop.

        Cancelling it ends the wait, never the turn.
        """
        return await self._come(ref, self._begin(ref, _ask, ref, message, timeout))

    # -- on the system's loop ---------------------------------------------------------------------------------------

    def _begin(
        self, ref: ActorRef[Any], call: Callable[..., Coroutine[Any, Any, R]], *args: Any
    ) -> concurrent.futures.Future[R]:
        """Have a coroutine function run as a task of the system's loop; the future has what comes of it."""
        cell_of("a call from a thread", ref)
        outcome: concurrent.futures.Future[R] = concurrent.futures.Future()

        def begin() -> None:
            try:
                self._check(ref)
            except ActorStopped as error:
                if outcome.set_running_or_notify_cancel():
                    outcome.set_exception(error)
                return
            task = self._node.loop.create_task(call(*args), name=f"called from a thread: {ref.path}")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
            task.add_done_callback(lambda done: _hand_back(done, outcome, ref))

        self._hand_over(ref, begin)
        return outcome

    def _wait(self, ref: ActorRef[Any], outcome: concurrent.futures.Future[R], seconds: float = math.inf) -> R:
        """Wait in the calling thread; no longer than the deadline, and not for a loop that has been closed."""
        loop = self._node.loop
        if not wait_on_loop(loop, outcome, seconds + LOOK_AGAIN):
            raise _ended(ref) if loop.is_closed() else AskTimeout(ref.path, seconds)
        return outcome.result()

    async def _come(self, ref: ActorRef[Any], outcome: concurrent.futures.Future[R]) -> R:
        """Await it on the calling thread's event loop, but not for a loop that has been closed."""
        coming = asyncio.wrap_future(outcome)
        try:
            while not coming.done():
                is_last = self._node.loop.is_closed()
                await asyncio.wait((coming,), timeout=LOOK_AGAIN)
                if is_last and not coming.done():
                    raise _ended(ref)
            return coming.result()
        finally:
            coming.cancel()

    def _check(self, ref: ActorRef[Any]) -> None:
        """Refuse what comes after the system's end, whatever its event loop does after it."""
        root = self._node.root
        if root is None or root.is_dead:
            raise _ended(ref)

    def _hand_over(self, ref: ActorRef[Any], call: Callable[[], None]) -> None:
        node = self._node
        # The thread that ran a loop which is closed now is one like any other, and another one may have its number.
        if node.is_own_thread() and not node.loop.is_closed():
            raise HoldfastError(f"{ref.path}: the system's own thread must not wait for itself; use the ref")
        try:
            node.loop.call_soon_threadsafe(call)
        except RuntimeError as error:  # The loop is closed.
            raise _ended(ref) from error


def _ended(ref: ActorRef[Any]) -> ActorStopped:
    return ActorStopped(ref.path, "its system has ended")


async def _send(ref: ActorRef[Any], message: Message[Any]) -> None:
    await ref.send(message)


async def _ask(ref: ActorRef[Any], message: Message[R], timeout: float) -> R:
    return await ref.ask(message, timeout)


def _hand_back(done: asyncio.Task[R], outcome: concurrent.futures.Future[R], ref: ActorRef[Any]) -> None:
    error = _ended(ref) if done.cancelled() else done.exception()
    if not outcome.set_running_or_notify_cancel():
        return  # Whoever waited has given up.
    if error is not None:
        outcome.set_exception(error)
    else:
        outcome.set_result(done.result())
