"""Task supervisors: functions as supervised jobs, awaited or not. Elixir's Task.Supervisor.

`tasks(...)` is the child spec, `Tasks(ref)` the handle: `await jobs.run(function, 1)`. Jobs are children of the task
supervisor: they are seen in `WhichChildren`, bounded by `max_children`, and stopped with it.
"""

from __future__ import annotations

import asyncio
import functools
import math
import os
from collections import deque
from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    AsyncIterator,
    Callable,
    Coroutine,
    Generator,
    Iterable,
    Iterator,
)
from typing import Any, Generic, Literal, cast, get_args, get_type_hints, overload

import msgspec
from typing_extensions import TypeVar, TypeVarTuple, Unpack

from ..actors.actor import Actor, Start
from ..actors.cell import DOWN, GONE, Cell
from ..actors.context import ActorContext
from ..actors.control.orders import pack_function
from ..actors.errors import AskFailed, AskTimeout, BadMessage, HoldfastError, SpecError
from ..actors.exits import SHUTDOWN
from ..actors.links import link
from ..actors.process.relay import OutsideHost
from ..actors.ref import ActorRef, current
from .admin import StartChild, WhichChildren
from .jobs import JobActor, TaskSupervisor, Work
from .spec import NAMELESS, ChildSpec, Flags, Isolation, Restart, Shutdown

T = TypeVar("T")
R = TypeVar("R")
Ts = TypeVarTuple("Ts")

PATIENCE: Shutdown = 5.0
FOREVER = 365 * 86_400.0
OnTimeout = Literal["exit", "kill_task"]


class Ok(msgspec.Struct, Generic[T, R], frozen=True):
    """A job that ended well: what it was given, and what it returned."""

    item: T
    value: R


class Failed(msgspec.Struct, Generic[T], frozen=True):
    """A job that did not: what it was given, and how it failed, as `run` would have raised it."""

    item: T
    error: HoldfastError


def tasks(
    name: str,
    *,
    max_children: int | None = None,
    intensity: int = 3,
    period: float = 5.0,
    restart: Restart = "permanent",
    shutdown: Shutdown = "infinity",
    isolation: Isolation = "task",
) -> ChildSpec:
    """A task supervisor, as a child spec. Use it through `Tasks(ref)`.

    Args:
        name: the last part of its address.
        max_children: how many jobs there may be at once; one more is refused with MaxChildren.
        intensity, period: of restarts, for jobs that are restarted at all (`spawn(..., restart=...)`).
        restart, shutdown, isolation: as a child of its own supervisor. When it stops, all jobs are told at once, and
            each has the time its own `shutdown` gives it.

    Raises:
        SpecError: naming the option and what it may be.
    """
    try:
        flags = Flags("one_for_one", intensity, period, "never", max_children)
    except SpecError as error:
        raise SpecError(f"tasks {name!r}", error.problem) from None
    start = Start(TaskSupervisor, (flags, None))
    return ChildSpec(name, start, restart, shutdown, isolation, is_supervisor=True)


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
        """Its address, that of its supervisor until it has one."""
        return self._where if self._cell is None else self._cell.path

    @property
    def is_done(self) -> bool:
        """Whether it is over."""
        return self._future.done()

    async def outcome(self, timeout: float | None = None) -> Ok[None, R] | Failed[None] | None:
        """How it ended; None if it is not over after `timeout` seconds, and it goes on. May be asked again."""
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
        """End it at once."""
        self._end("brutal_kill")

    async def stop(self, shutdown: Shutdown | None = None) -> Ok[None, R] | Failed[None]:
        """End it and wait for that; it may have been quicker, then its result is not lost."""
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


class Tasks:
    """A handle on a task supervisor in this process: `jobs = Tasks(ref)`.

    An `async def` function runs on the event loop, a plain one in a thread, so that it may block; with
    `isolation="process"` both in an OS process of their own: then the function has to be one of a module (or a
    `functools.partial` of one), the arguments values that can be saved, and the result is decoded as the function's
    annotation says.

    Called by an actor, `run`, `start` and `stream` make jobs that end with that life of it; how they fail is told to
    whoever awaits them and to nobody else, unless `linked=True`: then an abnormal end of the job ends the caller too.
    A `spawn`ed job belongs to nobody but the task supervisor.

    All raise MaxChildren when there are as many as there may be, and ActorStopped if there is no task supervisor.
    Journaled actors call these by `ctx.pipe_to_self`: a replay must not start a job again.
    """

    __slots__ = ("ref",)

    def __init__(self, ref: ActorRef[TaskSupervisor]) -> None:
        self.ref = ref

    def __repr__(self) -> str:
        return f"<Tasks {self.ref.path}>"

    @overload
    async def run(
        self,
        function: Callable[[Unpack[Ts]], Coroutine[Any, Any, R]],
        *args: Unpack[Ts],
        timeout: float | None = ...,
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> R: ...
    @overload
    async def run(
        self,
        function: Callable[[Unpack[Ts]], R],
        *args: Unpack[Ts],
        timeout: float | None = ...,
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> R: ...
    async def run(  # type: ignore[misc]  # mypy does not see that *Any takes any *Ts
        self,
        function: Callable[..., Any],
        *args: Any,
        timeout: float | None = None,
        linked: bool = False,
        isolation: Isolation = "task",
        shutdown: Shutdown = PATIENCE,
    ) -> Any:
        """Run a function as a job, and return what it returns.

        Cancelling the wait ends the job. (Keywords for the function: `functools.partial`.)

        Raises:
            RemoteCrash: the function raised; a Refusal or another HoldfastError comes as it is.
            AskFailed: the job was ended, or killed, or its process has died. AskTimeout: it took longer than `timeout`
            seconds, and was ended for that.
        """
        job = self._begin(function, args, linked, isolation, shutdown)
        try:
            await asyncio.wait((job._future,), timeout=timeout)
        except asyncio.CancelledError:
            job.cancel()
            raise
        if not job.is_done and timeout is not None:
            late = AskTimeout(job.path, timeout, None)
            job.cancel()
            raise late
        return job._future.result()

    @overload
    def start(
        self,
        function: Callable[[Unpack[Ts]], Coroutine[Any, Any, R]],
        *args: Unpack[Ts],
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> Job[R]: ...
    @overload
    def start(
        self,
        function: Callable[[Unpack[Ts]], R],
        *args: Unpack[Ts],
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> Job[R]: ...
    def start(  # type: ignore[misc]  # as in `run`
        self,
        function: Callable[..., Any],
        *args: Any,
        linked: bool = False,
        isolation: Isolation = "task",
        shutdown: Shutdown = PATIENCE,
    ) -> Job[Any]:
        """Start a job to be awaited later, or asked for its outcome, or ended. What `run` raises, `await job` does."""
        return self._begin(function, args, linked, isolation, shutdown)

    async def spawn(
        self,
        function: Callable[[Unpack[Ts]], object],
        *args: Unpack[Ts],
        restart: Restart = "temporary",
        isolation: Isolation = "task",
        shutdown: Shutdown = PATIENCE,
    ) -> ActorRef[Actor]:
        """Fire and forget: a job that outlives its caller, and is restarted by its spec ("transient": when it fails).

        Returns:
            Its ref, to watch, stop or kill it.
        """
        spec = self._spec(function, args, isolation, shutdown, restart=restart, is_awaited=False)
        return await self._ask_start(spec)

    @overload
    def stream(
        self,
        function: Callable[[T], Coroutine[Any, Any, R]],
        items: Iterable[T] | AsyncIterable[T],
        *,
        max_concurrency: int | None = ...,
        ordered: bool = ...,
        timeout: float | None = ...,
        on_timeout: OnTimeout = ...,
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> AsyncGenerator[Ok[T, R] | Failed[T], None]: ...
    @overload
    def stream(
        self,
        function: Callable[[T], R],
        items: Iterable[T] | AsyncIterable[T],
        *,
        max_concurrency: int | None = ...,
        ordered: bool = ...,
        timeout: float | None = ...,
        on_timeout: OnTimeout = ...,
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> AsyncGenerator[Ok[T, R] | Failed[T], None]: ...
    def stream(
        self,
        function: Callable[..., Any],
        items: Iterable[Any] | AsyncIterable[Any],
        *,
        max_concurrency: int | None = None,
        ordered: bool = True,
        timeout: float | None = None,
        on_timeout: OnTimeout = "exit",
        linked: bool = False,
        isolation: Isolation = "task",
        shutdown: Shutdown = PATIENCE,
    ) -> AsyncGenerator[Any, None]:
        """A job for each item: `async for result in jobs.stream(fetch, urls, max_concurrency=8)`.

        The source is pulled only as fast as results are taken: never more than `max_concurrency` items are between
        the two. Leaving the loop early ends the jobs that still run (at once, if the stream is closed by
        `contextlib.aclosing`; else when Python drops it).

        Args:
            function: called with one item.
            items: an iterable, or an async one.
            max_concurrency: the number of CPUs if left out.
            ordered: results come in the order of their items, else in that of their ends.
            timeout: seconds for each job.
            on_timeout: "exit" ends the stream with AskTimeout; "kill_task" kills that job, which is then a Failed.
            linked, isolation, shutdown: of each job.
        """
        most = (os.cpu_count() or 1) if max_concurrency is None else max_concurrency
        if type(most) is not int or most < 1:
            raise SpecError("stream", f"max_concurrency must be a whole number >= 1, not {max_concurrency!r}")
        if on_timeout not in get_args(OnTimeout):
            raise SpecError("stream", f"on_timeout must be one of {', '.join(get_args(OnTimeout))}, not {on_timeout!r}")
        begin = functools.partial(self._begin_with, function, linked, isolation, shutdown)
        return _stream(begin, items, most, ordered, timeout, on_timeout)

    async def outcomes(
        self,
        jobs: Iterable[Job[R]],
        timeout: float | None = None,
        *,
        on_timeout: Literal["leave", "kill_task"] = "leave",
    ) -> list[Ok[None, R] | Failed[None] | None]:
        """How several jobs ended, in their order; None for those that are not over after `timeout` seconds."""
        every = list(jobs)
        if every:
            await asyncio.wait([job._future for job in every], timeout=timeout)
        over = [job.is_done for job in every]
        if on_timeout == "kill_task":
            for job in every:
                job.kill()
        return [await job.outcome() if is_over else None for job, is_over in zip(every, over, strict=True)]

    async def children(self) -> list[ActorRef[Actor]]:
        """The jobs that there are now, oldest first."""
        node = self.ref._cell.node
        return [cast("ActorRef[Actor]", node.cell_at(info.path).ref) for info in await self.ref.ask(WhichChildren())]

    # -- how --------------------------------------------------------------------------------------------------------

    def _begin_with(
        self, function: Callable[..., Any], linked: bool, isolation: Isolation, shutdown: Shutdown, item: Any
    ) -> Job[Any]:
        return self._begin(function, (item,), linked, isolation, shutdown)

    def _begin(
        self,
        function: Callable[..., Any],
        args: tuple[Any, ...],
        linked: bool,
        isolation: Isolation,
        shutdown: Shutdown,
    ) -> Job[Any]:
        """Start a job, and a task that follows it; that task ends with the caller's life."""
        spec = self._spec(function, args, isolation, shutdown, restart="temporary", is_awaited=True)
        ctx = current.get(None)
        if linked and ctx is None:
            raise SpecError("job", "only an actor can be linked with its job")
        node = self.ref._cell.node
        kind = _returned(function) if isolation == "process" else None
        job: Job[Any] = Job(self.ref.path, shutdown, node.loop.create_future(), kind)
        started = self._ask_start(spec)
        started.add_done_callback(_seen)
        work = _follow(job, started, ctx if linked else None)
        follow = node.loop.create_task(work, name=f"job of {self.ref.path}", context=node.base_context.copy())
        keep = (self.ref._cell if ctx is None else ctx.cell).extra().tasks
        keep.add(follow)
        follow.add_done_callback(keep.discard)
        follow.add_done_callback(functools.partial(_followed, job, started))
        return job

    def _spec(
        self,
        function: Callable[..., Any],
        args: tuple[Any, ...],
        isolation: Isolation,
        shutdown: Shutdown,
        *,
        restart: Restart,
        is_awaited: bool,
    ) -> ChildSpec:
        if isinstance(self.ref._cell.host, OutsideHost):
            raise SpecError(
                "job",
                f"{self.ref.path} lives in another process, and functions are not sent there: start a task supervisor "
                "in this one, `ctx.spawn(tasks('jobs').start, 'jobs')`",
            )
        if not callable(function):
            raise SpecError("job", f"takes a function, not {function!r}")
        where = f"job {_label(function)!r}"
        is_coded = isolation == "process"
        packed = pack_function(function, where, "a job in a process of its own") if is_coded else function
        start = Start(JobActor, (_label(function), packed, args, is_awaited, is_coded))
        return ChildSpec(NAMELESS, start, restart, shutdown, isolation)

    def _ask_start(self, spec: ChildSpec) -> asyncio.Future[ActorRef[Any]]:
        """In nobody's name: neither does a journal hear of it, nor is the caller's turn in the way."""
        context = self.ref._cell.node.base_context.copy()
        return cast("asyncio.Future[ActorRef[Any]]", context.run(self.ref.ask, StartChild(spec), FOREVER))


async def _follow(job: Job[Any], started: asyncio.Future[ActorRef[Any]], linked: ActorContext | None) -> None:
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
            link(linked.cell, cell)
        value = await _result(cell)
        if job.kind is not None:
            value = _decoded(cell, job.kind, value)
        if not job.is_done:
            job._future.set_result(value)
    except HoldfastError as error:
        job._fail(error)


def _followed(job: Job[Any], started: asyncio.Future[ActorRef[Any]], follow: asyncio.Task[None]) -> None:
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


def _seen(future: asyncio.Future[Any]) -> None:
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
    reply = cell.ref.ask(Work(), FOREVER)
    reply.add_done_callback(_seen)
    if cell.state is not DOWN:  # Else its process is coming up: if that fails, so does the ask.
        gone = cell.ended()
        await asyncio.wait((reply, gone), return_when=asyncio.FIRST_COMPLETED)
        if not reply.done():
            reply.cancel()
            raise AskFailed(cell.path, str(gone.result()))
    await asyncio.wait((reply,))
    await cell.ended()  # Only then is its place free for the next one.
    return reply.result()


def _returned(function: Callable[..., Any]) -> Any:
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


def _label(function: Callable[..., Any]) -> str:
    while isinstance(function, functools.partial):
        function = function.func
    name = getattr(function, "__name__", type(function).__name__)
    return name if name.isidentifier() else "job"


class _Slot:
    """An item between its source and the taker of its result."""

    __slots__ = ("_done", "deadline", "is_refused", "item", "job", "result")

    def __init__(self, item: Any, job: Job[Any], deadline: float, done: deque[_Slot]) -> None:
        self.item, self.job, self.deadline, self._done = item, job, deadline, done
        self.result: Ok[Any, Any] | Failed[Any] | None = None
        self.is_refused = False  # there was no job at all
        job._future.add_done_callback(self._ended)

    def _ended(self, future: asyncio.Future[Any]) -> None:
        if self.result is None:
            error = cast("HoldfastError | None", future.exception())
            self.is_refused = self.job._cell is None
            self.set_result(Ok(self.item, future.result()) if error is None else Failed(self.item, error))

    def set_result(self, result: Ok[Any, Any] | Failed[Any]) -> None:
        """What is handed to the taker."""
        self.result = result
        self._done.append(self)


class _Source:
    """The items of a stream, pulled one at a time; of an async iterable in a task, while jobs run."""

    def __init__(self, items: Iterable[Any] | AsyncIterable[Any]) -> None:
        self._sync: Iterator[Any] | None = None
        self._async: AsyncIterator[Any] | None = None
        self._pulling: asyncio.Task[Any] | None = None
        self._is_over = False
        if isinstance(items, AsyncIterable):
            self._async = aiter(items)
        else:
            self._sync = iter(items)

    def take(self) -> list[Any]:
        """The next item, if it is there now. Raises what the source does."""
        if self._is_over:
            return []
        try:
            if self._sync is not None:
                return [next(self._sync)]
            if self._pulling is None or not self._pulling.done():
                return []
            pulled, self._pulling = self._pulling, None
            return [pulled.result()]
        except (StopIteration, StopAsyncIteration):
            self._is_over = True
            return []

    def pulling(self) -> asyncio.Task[Any] | None:
        """What to wait for until the next item is there; None if there will be none, or it need not be waited for."""
        if self._async is None or self._is_over:
            return None
        if self._pulling is None:
            self._pulling = asyncio.get_running_loop().create_task(_next(self._async), name="pull of a stream")
        return self._pulling

    def close(self) -> None:
        """No more of it."""
        if self._pulling is not None:
            self._pulling.cancel()


async def _next(source: AsyncIterator[Any]) -> Any:
    return await anext(source)


async def _stream(
    begin: Callable[[Any], Job[Any]],
    items: Iterable[Any] | AsyncIterable[Any],
    most: int,
    ordered: bool,
    timeout: float | None,
    on_timeout: OnTimeout,
) -> AsyncGenerator[Any, None]:
    loop = asyncio.get_running_loop()
    source = _Source(items)
    window: deque[_Slot] = deque()  # in the order of the items
    done: deque[_Slot] = deque()  # in that of their ends
    is_hurried = False
    try:
        while True:
            while len(window) < most and (found := source.take()):
                deadline = math.inf if timeout is None else loop.time() + timeout
                window.append(_Slot(found[0], begin(found[0]), deadline, done))
            for slot in done:
                if slot.is_refused and isinstance(slot.result, Failed):
                    raise slot.result.error
            ready = window if ordered else done
            if ready and (result := ready[0].result) is not None:
                slot = ready[0]
                window.remove(slot)
                done.remove(slot)
                yield result
                continue
            waited: list[asyncio.Future[Any]] = [slot.job._future for slot in window if slot.result is None]
            if len(window) < most and (pulling := source.pulling()) is not None:
                waited.append(pulling)
            if not waited:
                return
            soonest = min((slot.deadline for slot in window if slot.result is None), default=math.inf)
            left = None if soonest == math.inf else max(0.0, soonest - loop.time())
            await asyncio.wait(waited, timeout=left, return_when=asyncio.FIRST_COMPLETED)
            for slot in window:
                if slot.result is None and slot.deadline <= loop.time() and not slot.job.is_done:
                    late = AskTimeout(slot.job.path, timeout or 0.0, None)
                    if on_timeout == "exit":
                        raise late
                    slot.set_result(Failed(slot.item, late))
                    slot.job.kill()
    except asyncio.CancelledError:
        is_hurried = True  # Whoever is killed must not wait for others.
        raise
    finally:
        source.close()
        for slot in window:
            slot.job.cancel()
        if window and not is_hurried:
            await asyncio.wait([slot.job._future for slot in window])
