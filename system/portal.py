"""Calls from other threads: `system.from_thread()` makes the handle through which they reach the system's actors."""

from __future__ import annotations

import asyncio
import concurrent.futures
import math
import time
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, TypeVar

from ..actors.errors import ActorStopped, AskTimeout, HoldfastError
from ..actors.message import Message
from ..actors.ref import DEFAULT_TIMEOUT, ActorRef

if TYPE_CHECKING:
    from ..actors.node import Node

R = TypeVar("R")

LOOK_AGAIN = 0.5
"""Seconds between two looks of a waiting thread at whether the system's event loop is still there."""


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
        outcome: concurrent.futures.Future[None] = concurrent.futures.Future()

        def call() -> None:
            try:
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
        self._wait(ref, self._begin(ref, ref.send, message))

    def ask(self, ref: ActorRef[Any], message: Message[R], timeout: float = DEFAULT_TIMEOUT) -> R:
        """Ask, and return the reply.

        Args:
            ref: who is asked.
            message: what is asked; its class declares the reply's type.
            timeout: seconds until the deadline, > 0.

        Raises:
            Refusal, AskTimeout, ActorStopped, AskFailed, RemoteCrash: as `ActorRef.ask`.
        """
        outcome: concurrent.futures.Future[R] = self._begin(ref, _ask, ref, message, timeout)
        return self._wait(ref, outcome, timeout)

    async def send_async(self, ref: ActorRef[Any], message: Message[Any]) -> None:
        """As `send`, awaited on the calling thread's own event loop."""
        await asyncio.wrap_future(self._begin(ref, ref.send, message))

    async def ask_async(self, ref: ActorRef[Any], message: Message[R], timeout: float = DEFAULT_TIMEOUT) -> R:
        """As `ask`, awaited on the calling thread's own event loop. Cancelling it ends the wait, never the turn."""
        return await asyncio.wrap_future(self._begin(ref, _ask, ref, message, timeout))

    # -- on the system's loop ---------------------------------------------------------------------------------------

    def _begin(
        self, ref: ActorRef[Any], call: Callable[..., Coroutine[Any, Any, R]], *args: Any
    ) -> concurrent.futures.Future[R]:
        """Have a coroutine function run as a task of the system's loop; the future has what comes of it."""
        outcome: concurrent.futures.Future[R] = concurrent.futures.Future()

        def begin() -> None:
            task = self._node.loop.create_task(call(*args), name=f"called from a thread: {ref.path}")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
            task.add_done_callback(lambda done: _hand_back(done, outcome, ref))

        self._hand_over(ref, begin)
        return outcome

    def _wait(self, ref: ActorRef[Any], outcome: concurrent.futures.Future[R], seconds: float = math.inf) -> R:
        """Wait in the calling thread; no longer than the deadline, and not for a loop that has been closed."""
        end = time.monotonic() + seconds + LOOK_AGAIN
        while True:
            done, _ = concurrent.futures.wait((outcome,), LOOK_AGAIN)
            if done:
                return outcome.result()
            if self._node.loop.is_closed():
                raise ActorStopped(ref.path, "its system has ended")
            if time.monotonic() > end:
                raise AskTimeout(ref.path, seconds)

    def _hand_over(self, ref: ActorRef[Any], call: Callable[[], None]) -> None:
        node = self._node
        if node.is_own_thread():
            raise HoldfastError(f"{ref.path}: the system's own thread must not wait for itself; use the ref")
        try:
            node.loop.call_soon_threadsafe(call)
        except RuntimeError as error:  # The loop is closed.
            raise ActorStopped(ref.path, "its system has ended") from error


async def _ask(ref: ActorRef[Any], message: Message[R], timeout: float) -> R:
    return await ref.ask(message, timeout)


def _hand_back(done: asyncio.Task[R], outcome: concurrent.futures.Future[R], ref: ActorRef[Any]) -> None:
    error = ActorStopped(ref.path, "its system has ended") if done.cancelled() else done.exception()
    if not outcome.set_running_or_notify_cancel():
        return  # Whoever waited has given up.
    if error is not None:
        outcome.set_exception(error)
    else:
        outcome.set_result(done.result())
