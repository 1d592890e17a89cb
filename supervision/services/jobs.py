"""Jobs: functions that run as children of a task supervisor. Users reach them through `Tasks` (tasks.py).

A job is an actor that works in a background task of its own, so that it hears of its stop at any time: `on_stop`
cancels the work and waits for it; the kill after its spec's `shutdown` seconds is the supervisor's, or the handle's.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import threading
from collections.abc import Callable
from typing import Any, cast

from ...actors.control.orders import unpack_function
from ...actors.errors import AskFailed, HoldfastError, remote_crash
from ...actors.exit_reasons import KILLED, ExitReason, Shutdown, crash
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.blocking_handlers import ThreadContext, is_async
from ...actors.kernel.cell import DOWN
from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, Refusal
from ...actors.kernel.ref import current
from ..admin import StartChild
from ..children import Child, StartLimit
from ..dynamic import DynamicSupervisor
from ..spec import ChildSpec


class BeginJob(Message[Any]):
    """Begin; the reply, which comes at the end, is what the function returned."""


class JobActor(Actor):
    """One call of one function. It ends with it.

    Args:
        label: what the job is called; its supervisor adds a number.
        function: what is called; packed by name if the job is to live in another process.
        args: its arguments.
        is_awaited: it begins with `BeginJob`, and answers that; else with its start.
        is_coded: it lives in another process than whoever started it.
    """

    deterministic = False
    _with_successor = "awaited"

    def __init__(self, label: str, function: Any, args: tuple[Any, ...], is_awaited: bool, is_coded: bool) -> None:
        self._function: Callable[..., Any] = unpack_function(function) if is_coded else function
        self._args, self._is_awaited, self._is_coded = args, is_awaited, is_coded
        self._handle: ReplyHandle[Any] | None = None
        self._work: asyncio.Task[None] | None = None
        self._is_ended = False  # it was told to end, and its work is cancelled for that

    def on_start(self, restored: bool) -> None:
        """Begin, unless somebody waits for the result: then it begins when the way back is known."""
        if not self._is_awaited:
            self._work = self.ctx.create_task(self._run())

    @on(BeginJob)
    def _begin(self, message: BeginJob) -> ReplyHandle[Any]:
        """Begin the job, and answer when it is over."""
        self._handle = self.ctx.reply_handle()
        self._work = self.ctx.create_task(self._run())
        return self._handle

    async def _run(self) -> None:
        try:
            value = await self._call()
            if self._is_coded and self._handle is not None:
                value = self.ctx._cell.node.codec.encode(value, self.ctx.path)
        except asyncio.CancelledError:
            if not self.ctx._closed and not self._is_ended:
                # Not by us: the function has cancelled its own task, or what it waited for was cancelled.
                task = asyncio.current_task()
                is_own = task is not None and task.cancelling()
                why = "it was cancelled from within" if is_own else "what it waited for was cancelled"
                self._fail(AskFailed(self.ctx.path, why))
                self.ctx.stop(Shutdown(why))
            raise
        except BaseException as error:
            self._fail(error if isinstance(error, HoldfastError) else remote_crash(error))
            if not isinstance(error, Refusal):
                raise  # Now the job crashes.
            self.ctx.stop()  # A "no" is an answer.
            return
        if self._handle is not None:
            self._handle.reply(value)
        self.ctx.stop()

    async def _call(self) -> Any:
        function = self._function
        if is_async(function):
            return await function(*self._args)
        threaded = ThreadContext(self.ctx)
        try:
            found = await self.ctx._cell.node.threads.run(_in_thread, threaded, function, self._args)
        finally:
            threaded._is_over = True
        return await found if inspect.isawaitable(found) else found

    def _fail(self, error: HoldfastError) -> None:
        if self._handle is not None:
            self._handle.fail(error)

    async def on_stop(self, reason: ExitReason) -> None:
        """Cancel what still runs, and wait until it has cleaned up."""
        work, self._is_ended = self._work, True
        if work is not None and not work.done():
            work.cancel()
            await asyncio.wait((work,))
        self._fail(AskFailed(self.ctx.path, str(reason)))  # No more than the first outcome counts.


def _in_thread(threaded: ThreadContext, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    threaded._thread = threading.get_ident()
    current.set(cast("Any", threaded))  # In the thread's own copy of the context.
    return function(*args)


class TaskSupervisor(DynamicSupervisor):
    """Keeps jobs: a dynamic supervisor that does not wait until they are up. Started by `tasks(...)`."""

    _leaves_for = 0  # the attempt to put another one in our place: until then no other job is begun

    @on(StartChild)
    def _start_child(self, message: StartChild) -> Any:
        """Start a job; while those that run are waited for, the next ones wait."""
        if not self._leaves_for:
            return super()._start_child(message)
        self.ctx.stash()
        return None

    def _wind_down(self, attempt: int) -> None:
        super()._wind_down(attempt)
        self._leaves_for = attempt
        if not attempt:
            self.ctx.unstash()

    def _why_occupied(self) -> str:
        running = (one.spec.id for one in self._listed().values() if issubclass(one.spec.start.kind, JobActor))
        job = next(running, None)
        return super()._why_occupied() or ("" if job is None else f"its job {job!r} is not over")

    def _beginning(self, spec: ChildSpec) -> str:
        return spec.start.args[0] if issubclass(spec.start.kind, JobActor) else super()._beginning(spec)

    async def _come_up(self, one: Child) -> None:
        """A process takes long to come up: whoever asked has the job at once, and its queue waits for it."""
        if not issubclass(one.spec.start.kind, JobActor):
            await super()._come_up(one)
            return
        before = one.cell.life if one.cell is not None else 0
        up = self._launch(one)
        if up is not None:
            up.add_done_callback(functools.partial(self._over, one, before, StartLimit(one)))

    def _over(self, one: Child, before: int, limit: StartLimit, up: asyncio.Future[None]) -> None:
        """A start that failed before there was a life: no end will be told of it, so we do."""
        limit.close()
        cell = one.cell
        if cell is not None and cell.state is DOWN and cell.life == before:
            error = None if up.cancelled() else up.exception()
            reason = KILLED if error is None else crash(error)
            cell.extra().reason = reason
            one.ignored_life = min(one.ignored_life, cell.life - 1)
            self._post(lifecycle.ChildExit(cell, cell.life, reason))
