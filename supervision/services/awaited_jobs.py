"""Awaited jobs: the handle, and the task that follows a job to its end on behalf of its caller."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Generator
from typing import Any, Generic, cast, get_type_hints

import msgspec
from typing_extensions import TypeVar

from ...actors.errors import AskFailed, BadMessage, HoldfastError
from ...actors.exit_reasons import SHUTDOWN
from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.context import ActorContext
from ...actors.kernel.links import link
from ...actors.kernel.ref import ActorRef
from ...actors.seconds import check_seconds
from ..spec import Shutdown, check_shutdown
from .jobs import BeginJob

T = TypeVar("T")
R = TypeVar("R")

FOREVER = 365 * 86_400.0
"""Seconds that a job may take as far as asks are concerned: its own limits are another matter."""


class Ok(msgspec.Struct, Generic[T, R], frozen=True):
    """A job that ended well: what it was given, and what it returned."""

    item: T
    value: R


class Failed(msgspec.Struct, Generic[T], frozen=True):
    """A job that did not: what it was given, and how it failed, as `run` would have raised it."""

    item: T
    error: HoldfastError


class Job(Generic[R]):
    """A job that was started: `await job` gives what its function returns, or raises how it failed.

    Cancelling that wait does not end the job; `cancel`, `stop` and `kill` do.
    """

    __slots__ = ("_cell", "_future", "_is_unwanted", "_shutdown", "_timer", "_where", "kind")

    def __init__(self, where: str, shutdown: Shutdown, future: asyncio.Future[R], kind: Any) -> None:
        self._where, self._future, self.kind = where, future, kind
        self._shutdown: Shutdown = shutdown
        self._cell: Cell | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._is_unwanted = False  # it is to be ended as soon as it is there

    def __await__(self) -> Generator[Any, Any, R]:
        return asyncio.shield(self._future).__await__()

    def __repr__(self) -> str:
        return f"<Job {self.path}>"

    @property
    def path(self) -> str:
        """The address of the job; that of its supervisor until it has one."""
        return self._where if self._cell is None else self._cell.path

    @property
    def is_done(self) -> bool:
        """Say whether the job is over."""
        return self._future.done()

    async def outcome(self, timeout: float | None = None) -> Ok[None, R] | Failed[None] | None:
        """Wait for the end of the job, as often as you like; None after `timeout` seconds, and the job goes on.

        Raises:
            SpecError: `timeout` is neither a finite number >= 0 nor left out.
        """
        if timeout is not None:
            check_seconds(self.path, "timeout", timeout, or_zero=True)
        await asyncio.wait((self._future,), timeout=timeout)
        if not self._future.done():
            return None
        error = self._future.exception()
        return Ok(None, self._future.result()) if error is None else Failed(None, cast("HoldfastError", error))

    def cancel(self) -> None:
        """Tell it to end: its function is cancelled, and the job killed if that takes longer than its `shutdown`.

        (A thread cannot be cancelled: the job ends at once, and the thread goes on for nobody.)
        """
        self._end(self._shutdown)

    def kill(self) -> None:
        """End the job at once, in whatever state it is."""
        self._end("brutal_kill")

    async def stop(self, shutdown: Shutdown | None = None) -> Ok[None, R] | Failed[None]:
        """End it and wait for that; it may have been quicker, then its result is not lost.

        Raises:
            SpecError: `shutdown` is neither seconds >= 0 nor "brutal_kill" nor "infinity".
        """
        if shutdown is not None:
            check_shutdown(self.path, shutdown)
        self._end(self._shutdown if shutdown is None else shutdown)
        outcome = await self.outcome()
        assert outcome is not None
        return outcome

    def _end(self, shutdown: Shutdown) -> None:
        cell = self._cell
        if cell is None:
            self._is_unwanted = True
        if self._future.done() or cell is None:
            return
        if shutdown == "brutal_kill":
            cell.kill()
        else:
            cell.request_stop(SHUTDOWN)
            if not isinstance(shutdown, str):
                if self._timer is not None:
                    self._timer.cancel()
                self._timer = cell.node.loop.call_later(shutdown, _kill_if_alive, cell)

    def _fail(self, error: BaseException) -> None:
        if not self._future.done():
            self._future.set_exception(error)
            self._future.exception()  # Seen: whoever does not ask does not want to know.


def _kill_if_alive(cell: Cell) -> None:
    """Kill what has not ended in time; a process may still be coming up."""
    if cell.state is not GONE:
        cell.kill()


async def follow(job: Job[Any], started: asyncio.Future[ActorRef[Any]], linked: ActorContext | None) -> None:
    """See a job to its end. This task ends with the caller's life."""
    try:
        await asyncio.wait((started,))
        cell: Cell = started.result()._cell
        job._cell = cell
        if job._is_unwanted:
            cell.kill()
            await cell.ended()
            raise AskFailed(job.path, "it was ended before it began")
        if linked is not None:
            link(linked._cell, cell)
        value = await _result(cell)
        if job.kind is not None:
            value = _decoded(cell, job.kind, value)
        if not job.is_done:
            job._future.set_result(value)
    except HoldfastError as error:
        job._fail(error)


def followed(job: Job[Any], started: asyncio.Future[ActorRef[Any]], follow: asyncio.Task[None]) -> None:
    """Nobody follows it any more; if that is because the caller has ended, so does the job."""
    cell = job._cell
    if follow.cancelled():
        why = "its caller has ended"
        if cell is None:
            started.add_done_callback(_end_started)
        elif cell.state in (DOWN, GONE):
            why = str(cell.extra().reason)
        job.cancel()
        job._fail(AskFailed(job.path, why))
    elif job._timer is not None:
        job._timer.cancel()
    if not job.is_done:  # A bug of ours must not leave anybody waiting.
        job._fail(AskFailed(job.path, str(follow.exception())))


def seen(future: asyncio.Future[Any]) -> None:
    """If nobody waits for it any more, asyncio need not complain of a failure."""
    if not future.cancelled():
        future.exception()


def _end_started(started: asyncio.Future[ActorRef[Any]]) -> None:
    """Nobody wants the job any more that has been asked for."""
    if not started.cancelled() and started.exception() is None:
        started.result().kill()


async def _result(cell: Cell) -> Any:
    """What the job's function returns, when the job has ended.

    Raises whatever it failed with; AskFailed if it was ended.
    """
    reply = cell.ref.ask(BeginJob(), FOREVER)
    reply.add_done_callback(seen)
    if cell.state is not DOWN:  # Else its process is coming up: if that fails, so does the ask.
        gone = cell.ended()
        await asyncio.wait((reply, gone), return_when=asyncio.FIRST_COMPLETED)
        if not reply.done():
            reply.cancel()
            raise AskFailed(cell.path, str(gone.result()))
    await asyncio.wait((reply,))
    await cell.ended()  # Only then is its place free for the next one.
    return reply.result()


def returned(function: Callable[..., Any]) -> Any:
    """The type that a function says it returns."""
    while isinstance(function, functools.partial):
        function = function.func
    try:
        return get_type_hints(function).get("return", Any)
    except (NameError, TypeError):  # A name that is only imported for checking, or a builtin.
        return Any


def _decoded(cell: Cell, kind: Any, body: Any) -> Any:
    try:
        return cell.node.codec.decode(kind, body)
    except msgspec.DecodeError as error:
        raise BadMessage(cell.path, "the result", str(error)) from error
