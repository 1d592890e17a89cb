"""Task supervisors: functions as supervised jobs, awaited or not. Elixir's Task.Supervisor.

`tasks(...)` is the child spec, `Tasks(ref)` the handle: `await jobs.run(function, 1)`. Jobs are children of the task
supervisor: they are seen in `WhichChildren`, bounded by `max_children`, and stopped with it.
"""

from __future__ import annotations

import asyncio
import functools
import os
from collections.abc import AsyncGenerator, AsyncIterable, Callable, Coroutine, Iterable
from typing import Any, Literal, cast, get_args, overload

from typing_extensions import TypeVar, TypeVarTuple

from ...actors.control.orders import pack_function
from ...actors.errors import AskTimeout, SpecError
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.ref import ActorRef, cell_of, current
from ...actors.seconds import check_seconds
from ..admin import StartChild, WhichChildren
from ..spec import NAMELESS, ChildSpec, Flags, Isolation, Restart, Shutdown
from .awaited_jobs import FOREVER, Failed, Job, Ok, follow, followed, returned, seen
from .job_streams import OnTimeout, stream_of
from .jobs import JobActor, TaskSupervisor

T = TypeVar("T")
R = TypeVar("R")
Ts = TypeVarTuple("Ts")

PATIENCE: Shutdown = 5.0
"""Seconds that a job may take to clean up before it is killed, when nothing else is said."""


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
    """Describe a task supervisor, as a child spec. Use it through `Tasks(ref)`.

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


class Tasks:
    """A handle on a task supervisor in this process: `jobs = Tasks(ref)`.

    An `async def` function runs on the event loop, a plain one in a thread, so that it may block; with
    `isolation="process"` both in an OS process of their own: then the function has to be one of a module (or a
    `functools.partial` of one), the arguments values that can be saved, and the result is decoded as the function's
    annotation says.

    Called by an actor, `run`, `start` and `stream` make jobs that end with that life of it; how they fail is told to
    whoever awaits them and to nobody else, unless `linked=True`: then any end of the job but a normal one ends the
    caller too.
    A `spawn`ed job belongs to nobody but the task supervisor.

    All raise MaxChildren when there are as many as there may be, and ActorStopped if there is no task supervisor.
    Journaled actors call these by `ctx.pipe_to_self`: a replay must not start a job again.
    """

    __slots__ = ("ref",)

    def __init__(self, ref: ActorRef[TaskSupervisor]) -> None:
        cell_of("Tasks", ref)
        self.ref = ref

    def __repr__(self) -> str:
        return f"<Tasks {self.ref.path}>"

    @overload
    async def run(
        self,
        function: Callable[[*Ts], Coroutine[Any, Any, R]],
        *args: *Ts,
        timeout: float | None = ...,
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> R: ...
    @overload
    async def run(
        self,
        function: Callable[[*Ts], R],
        *args: *Ts,
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
        self._check(timeout)
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
        function: Callable[[*Ts], Coroutine[Any, Any, R]],
        *args: *Ts,
        linked: bool = ...,
        isolation: Isolation = ...,
        shutdown: Shutdown = ...,
    ) -> Job[R]: ...
    @overload
    def start(
        self,
        function: Callable[[*Ts], R],
        *args: *Ts,
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
        """Start a job to be awaited later, or asked for its outcome, or ended. What `run` raises, `await job` does.

        This is no coroutine, unlike `spawn`: the job is returned at once, and `await job` waits for its outcome.
        """
        return self._begin(function, args, linked, isolation, shutdown)

    async def spawn(
        self,
        function: Callable[[*Ts], object],
        *args: *Ts,
        restart: Restart = "temporary",
        isolation: Isolation = "task",
        shutdown: Shutdown = PATIENCE,
    ) -> ActorRef[Actor]:
        """Fire and forget: a job that outlives its caller, and is restarted by its spec ("transient": when it fails).

        This is a coroutine, unlike `start`: `ref = await tasks.spawn(...)` waits until the job is there.

        Returns:
            A ref to the job, to watch, stop or kill it; its outcome is not told.
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
        """Run a job for each item: `async for result in jobs.stream(fetch, urls, max_concurrency=8)`.

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
        self._check(timeout)

        def begin(item: Any) -> Job[Any]:
            return self._begin(function, (item,), linked, isolation, shutdown)

        return stream_of(begin, items, most, ordered, timeout, on_timeout)

    async def outcomes(
        self,
        jobs: Iterable[Job[R]],
        timeout: float | None = None,
        *,
        on_timeout: Literal["leave", "kill_task"] = "leave",
    ) -> list[Ok[None, R] | Failed[None] | None]:
        """Wait for the ends of several jobs, in their order; None for those not over after `timeout` seconds."""
        self._check(timeout)
        every = list(jobs)
        if every:
            await asyncio.wait([job._future for job in every], timeout=timeout)
        over = [job.is_done for job in every]
        if on_timeout == "kill_task":
            for job in every:
                job.kill()
        return [await job.outcome() if is_over else None for job, is_over in zip(every, over, strict=True)]

    async def children(self) -> list[ActorRef[Actor]]:
        """List the jobs that there are now, oldest first."""
        node = self.ref._cell.node
        return [cast("ActorRef[Actor]", node.cell_at(info.path).ref) for info in await self.ref.ask(WhichChildren())]

    # -- how --------------------------------------------------------------------------------------------------------

    def _check(self, timeout: float | None) -> None:
        """Refuse what is no time limit of jobs. Raises SpecError."""
        if timeout is not None:
            check_seconds(self.ref.path, "timeout", timeout, or_zero=True)

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
        kind = returned(function) if isolation == "process" else None
        job: Job[Any] = Job(self.ref.path, shutdown, node.loop.create_future(), kind)
        started = self._ask_start(spec)
        started.add_done_callback(seen)
        work = follow(job, started, ctx if linked else None)
        task = node.loop.create_task(work, name=f"job of {self.ref.path}", context=node.base_context.copy())
        # Who is no actor lives as long as the system.
        own = (node.root or self.ref._cell) if ctx is None else ctx._cell
        keep = own.extra().belongings.tasks
        keep.add(task)
        task.add_done_callback(keep.discard)
        task.add_done_callback(functools.partial(followed, job, started))
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
        if not self.ref._cell.living.host.place.is_here:
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


def _label(function: Callable[..., Any]) -> str:
    while isinstance(function, functools.partial):
        function = function.func
    name = getattr(function, "__name__", type(function).__name__)
    return name if name.isidentifier() else "job"
