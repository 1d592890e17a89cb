"""Task supervisors: jobs that are awaited, started or spawned (otp.md 1.14; Elixir's supervisor_test.exs re-told)."""

import asyncio
import functools
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, assert_type

import pytest

import holdfast as hf
from holdfast.testing import idle
from tests.supervision.family import refused

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


class Do(hf.Message[Any]):
    work: Any


class Caller(hf.Actor):
    """Runs a function in its turn."""

    @hf.on(Do)
    async def do(self, message: Do) -> Any:
        return await message.work()

    @hf.on(hf.supervision.KeyFreed)
    def unused(self, message: hf.supervision.KeyFreed) -> None: ...


class Short(hf.Refusal):
    by: int


class Gate:
    """A job's function that waits to be let through, and notes how it ends."""

    def __init__(self) -> None:
        self.begun, self.open, self.log = asyncio.Event(), asyncio.Event(), list[str]()

    async def __call__(self, value: Any = None, cleanup: float = 0.0) -> Any:
        self.begun.set()
        try:
            await self.open.wait()
        except asyncio.CancelledError:
            self.log.append("cancelled")
            await asyncio.sleep(cleanup)
            self.log.append("cleaned up")
            raise
        return value


@asynccontextmanager
async def opened(**options: Any) -> AsyncGenerator[tuple[hf.ActorSystem, hf.supervision.Tasks], None]:
    async with hf.ActorSystem(log=False, intensity=9) as system:
        yield system, hf.supervision.Tasks(await system.start(hf.supervision.tasks("jobs", **options)))


async def add(a: int, b: int = 1) -> int:
    return a + b


def add_slowly(a: int, b: int = 1) -> int:
    return a + b


async def fail(text: str) -> int:
    raise ValueError(text)


def fail_in_thread(text: str) -> int:
    raise ValueError(text)


async def refuse() -> int:
    raise Short(by=3)


# -- run ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("function", [add, add_slowly, functools.partial(add, b=1), lambda a: a + 1, lambda a: add(a)])
async def test_run_returns_what_the_function_returns(function: Callable[[int], Any]) -> None:
    async with opened() as (_, jobs):
        assert await jobs.run(function, 2) == 3
        assert await jobs.children() == []


async def test_a_plain_function_may_block_and_sees_its_own_actor() -> None:
    async with opened() as (system, jobs):
        caller = system.spawn(hf.start(Caller), "caller")

        def block() -> int:
            caller.tell(hf.supervision.KeyFreed(caller, "k", caller, False))
            return threading.get_ident()

        assert await jobs.run(block) != threading.get_ident()
        assert system.dead_letters == 0


@pytest.mark.parametrize("function", [fail, fail_in_thread])
async def test_a_failure_is_raised_at_the_awaiter_only(function: Callable[[str], Awaitable[int] | int]) -> None:
    async with opened() as (system, jobs):
        caller = system.spawn(hf.start(Caller), "caller")
        seen: list[hf.HoldfastError] = []

        async def work() -> str:
            try:
                await jobs.run(function, "no")
            except hf.RemoteCrash as crash:
                seen.append(crash)
            return "went on"

        assert await caller.ask(Do(work)) == "went on"
        assert [(crash.type_name, crash.text) for crash in seen if isinstance(crash, hf.RemoteCrash)] == [
            ("ValueError", "no")
        ]
        assert await jobs.run(add, 1) == 2, "and the task supervisor restarts nothing"


async def test_a_refusal_comes_as_it_is() -> None:
    async with opened() as (_, jobs):
        assert await refused(jobs.run(refuse)) == Short(by=3)


@virtual
async def test_a_job_that_takes_too_long_is_ended() -> None:
    async with opened() as (system, jobs):
        gate = Gate()
        error = await refused(jobs.run(gate, timeout=2.0))
        assert isinstance(error, hf.AskTimeout)
        assert error.actor.startswith("/app/jobs/Gate-")
        assert error.seconds == 2.0
        await idle(system)
        assert (gate.log, await jobs.children()) == (["cancelled", "cleaned up"], [])


async def test_cancelling_run_ends_the_job() -> None:
    async with opened() as (system, jobs):
        gate = Gate()
        waiting = asyncio.ensure_future(jobs.run(gate))
        await gate.begun.wait()
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        await idle(system)
        assert (gate.log, await jobs.children()) == (["cancelled", "cleaned up"], [])


async def test_run_cancelled_before_the_job_began_never_begins_it() -> None:
    async with opened() as (system, jobs):
        gate = Gate()
        await system.suspend(jobs.ref)
        waiting = asyncio.ensure_future(jobs.run(gate))
        await idle(system)
        waiting.cancel()
        await idle(system)
        await system.resume(jobs.ref)
        await idle(system)
        assert (gate.begun.is_set(), await jobs.children()) == (False, [])


async def test_a_function_that_cancels_itself_fails_and_leaves_nothing() -> None:
    async def cancels() -> int:
        raise asyncio.CancelledError

    async def cancels_its_task() -> int:
        task = asyncio.current_task()
        assert task is not None
        task.cancel()
        await asyncio.sleep(0)
        return 1

    async with opened() as (_, jobs):
        for function, why in (
            (cancels, "what it waited for was cancelled"),
            (cancels_its_task, "cancelled from within"),
        ):
            error = await refused(asyncio.wait_for(jobs.run(function), 30))
            assert isinstance(error, hf.AskFailed)
            assert why in str(error)
            assert await jobs.children() == []


# -- children of the supervisor -------------------------------------------------------------------------------------


async def test_jobs_are_children_named_by_their_function() -> None:
    async with opened() as (_, jobs):
        gate = Gate()

        async def wait() -> None:
            await gate()

        started = [jobs.start(wait), jobs.start(wait)]
        spawned = await jobs.spawn(gate)
        await gate.begun.wait()
        infos = await jobs.ref.ask(hf.WhichChildren())
        assert [(info.id.partition("-")[0], info.state) for info in infos] == [
            ("wait", "running"),
            ("wait", "running"),
            ("Gate", "running"),
        ]
        assert [ref.path for ref in await jobs.children()] == [*(job.path for job in started), spawned.path]
        assert await jobs.ref.ask(hf.supervision.CountChildren()) == hf.supervision.ChildCounts(3, 3, 0, 3)
        gate.open.set()
        assert [await job.outcome() for job in started] == [hf.supervision.Ok(None, None)] * 2


async def test_no_more_than_max_children_and_a_place_is_free_when_run_returns() -> None:
    async with opened(max_children=1) as (_, jobs):
        gate = Gate()
        job = jobs.start(gate)
        await gate.begun.wait()
        refusals = [jobs.run(add, 1), jobs.spawn(add, 1), jobs.stream(add, [1]).__anext__()]
        for call in refusals:
            assert await refused(call) == hf.errors.MaxChildren(1)
        gate.open.set()
        await job
        for n in range(20):
            assert await jobs.run(add, n) == n + 1
            with pytest.raises(hf.RemoteCrash):
                await jobs.run(fail, "no")


@virtual
async def test_stopping_the_task_supervisor_stops_its_jobs_each_in_its_time() -> None:
    async with opened() as (system, jobs):
        gates = [Gate() for _ in range(3)]
        started = [
            jobs.start(gates[0], None, 1.0),
            jobs.start(gates[1], None, 100.0, shutdown=3.0),
            jobs.start(gates[2], None, 1.0, shutdown="brutal_kill"),
        ]
        for gate in gates:
            await gate.begun.wait()
        await system.stop(jobs.ref)
        assert asyncio.get_running_loop().time() == 3.0
        assert [gate.log[-1] for gate in gates[:2]] == ["cleaned up", "cancelled"]
        reasons = [
            str(error.reason) for error in [await refused(job) for job in started] if isinstance(error, hf.AskFailed)
        ]
        assert reasons == ["shutdown", "killed", "killed"]
        assert isinstance(await refused(jobs.run(add, 1)), hf.ActorStopped)


async def test_a_killed_task_supervisor_fails_its_jobs() -> None:
    async with opened() as (_, jobs):
        gate = Gate()
        job = jobs.start(gate)
        await gate.begun.wait()
        jobs.ref.kill()
        error = await refused(job)
        assert isinstance(error, hf.AskFailed)
        assert error.reason == "killed"
        assert await jobs.run(add, 1) == 2, "the next life of it takes new ones"


# -- start ----------------------------------------------------------------------------------------------------------


async def test_a_started_job_is_awaited_as_often_as_one_likes() -> None:
    async with opened() as (_, jobs):
        gate = Gate()
        job, failing = jobs.start(gate, 7), jobs.start(fail, "no")
        assert (await job.outcome(0.0), job.is_done) == (None, False)
        waiting = asyncio.ensure_future(_await(job))
        await gate.begun.wait()
        waiting.cancel()
        gate.open.set()
        assert [await job, await job, await job.outcome()] == [7, 7, hf.supervision.Ok(None, 7)]
        assert (job.is_done, gate.log) == (True, []), "the cancelled wait did not end it"
        outcome = await failing.outcome()
        assert isinstance(outcome, hf.supervision.Failed)
        assert str(outcome.error) == "ValueError: no"


async def _await(job: hf.supervision.Job[Any]) -> Any:
    return await job


@virtual
async def test_shutdown_is_a_ladder() -> None:
    async with opened() as (_, jobs):
        loop = asyncio.get_running_loop()
        polite, stubborn, brutal = Gate(), Gate(), Gate()
        handles = [jobs.start(polite, None, 2.0), jobs.start(stubborn, None, 100.0), jobs.start(brutal)]
        for gate in (polite, stubborn, brutal):
            await gate.begun.wait()
        times: list[float] = []
        reasons: list[str] = []
        for job, shutdown in zip(handles, (5.0, 3.0, "brutal_kill"), strict=True):
            begun = loop.time()
            outcome = await job.stop(shutdown)  # type: ignore[arg-type]
            assert isinstance(outcome, hf.supervision.Failed)
            assert isinstance(outcome.error, hf.AskFailed)
            times.append(loop.time() - begun)
            reasons.append(outcome.error.reason)
        assert (times, reasons) == ([2.0, 3.0, 0.0], ["shutdown", "killed", "killed"])
        assert await jobs.run(add, 1) == 2


async def test_stopping_a_job_that_is_over_gives_its_result() -> None:
    async with opened() as (_, jobs):
        job = jobs.start(add, 1)
        await job
        assert await job.stop() == hf.supervision.Ok(None, 2)
        job.cancel()
        job.kill()
        assert await job == 2


async def test_a_job_that_is_killed_before_it_began_never_begins() -> None:
    async with opened() as (system, jobs):
        gate = Gate()
        job = jobs.start(gate)
        job.kill()
        assert isinstance(await refused(job), hf.AskFailed)
        await idle(system)
        assert (gate.begun.is_set(), await jobs.children()) == (False, [])


@virtual
async def test_outcomes_of_many() -> None:
    """Elixir: Task.yield_many."""
    async with opened() as (_, jobs):
        gate = Gate()
        many = [jobs.start(add, 1), jobs.start(fail, "no"), jobs.start(gate)]
        first, second, third = await jobs.outcomes(many, 2.0)
        assert (first, third) == (hf.supervision.Ok(None, 2), None)
        assert isinstance(second, hf.supervision.Failed)
        assert (await jobs.outcomes([]), not many[2].is_done) == ([], True)
        assert (await jobs.outcomes(many, 1.0, on_timeout="kill_task"))[2] is None
        assert isinstance(await refused(many[2]), hf.AskFailed)
        assert asyncio.get_running_loop().time() == 3.0


# -- callers --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["kill", "stop"])
@pytest.mark.parametrize("call", ["run", "start", "stream"])
async def test_an_actors_jobs_end_with_it(how: str, call: str) -> None:
    async with opened() as (system, jobs):
        caller = system.spawn(hf.start(Caller), "caller")
        gate, kept = Gate(), list[Any]()

        async def work() -> None:
            if call == "run":
                await jobs.run(gate)
            elif call == "start":
                kept.append(jobs.start(gate))
            else:
                async for _ in jobs.stream(gate, [1]):
                    raise AssertionError

        asked = caller.ask(Do(work))
        await gate.begun.wait()
        if how == "kill" or call != "start":
            caller.kill()
        else:
            caller.stop()
        await idle(system)
        assert (gate.log, await jobs.children()) == (["cancelled", "cleaned up"], [])
        if call == "start":
            assert await asked is None
            assert isinstance(await refused(kept[0]), hf.AskFailed)
        else:
            assert isinstance(await refused(asked), hf.AskFailed)


async def test_a_spawned_job_outlives_its_caller() -> None:
    async with opened() as (system, jobs):
        caller = system.spawn(hf.start(Caller), "caller")
        gate = Gate()

        async def work() -> None:
            await jobs.spawn(gate)

        await caller.ask(Do(work))
        caller.kill()
        await idle(system)
        assert len(await jobs.children()) == 1
        gate.open.set()
        await idle(system)
        assert await jobs.children() == []


@pytest.mark.parametrize("linked", [True, False])
async def test_a_linked_job_takes_its_caller_with_it(linked: bool) -> None:
    async with opened() as (system, jobs):
        caller = system.spawn(hf.start(Caller), "caller")
        gate = Gate()

        async def work() -> None:
            async def fails_later() -> None:
                await gate()
                raise ValueError("no")

            jobs.start(fails_later, linked=linked)

        await caller.ask(Do(work))
        await gate.begun.wait()
        gate.open.set()
        await idle(system)
        assert ("/app/caller" in system.tree()) is not linked
        assert await jobs.children() == []


async def test_a_linked_job_that_ends_well_harms_nobody() -> None:
    async with opened() as (system, jobs):
        caller = system.spawn(hf.start(Caller), "caller")
        assert await caller.ask(Do(lambda: jobs.run(add, 1, linked=True))) == 2
        assert await caller.ask(Do(lambda: jobs.run(add, 2))) == 3
        assert isinstance(await refused(jobs.run(add, 1, linked=True)), hf.SpecError)


# -- spawn ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("restart", "runs"), [("temporary", 1), ("transient", 3)])
async def test_a_spawned_job_is_restarted_as_it_says(restart: Any, runs: int) -> None:
    count = 0

    async def flaky() -> None:
        nonlocal count
        count += 1
        if count < 3:
            raise ValueError("not yet")

    async with opened() as (system, jobs):
        await jobs.spawn(flaky, restart=restart)
        await idle(system)
        assert (count, await jobs.children()) == (runs, [])


# -- mistakes -------------------------------------------------------------------------------------------------------


async def test_what_cannot_be_a_job_is_refused_by_name() -> None:
    async with opened() as (_, jobs):
        here = 1
        calls: list[Any] = [
            (lambda: jobs.run(7), "takes a function, not 7"),  # type: ignore[call-overload]
            (lambda: jobs.run(lambda: here, isolation="process"), "needs a function of a module"),
            (lambda: jobs.run(add, object(), isolation="process"), "object cannot be sent to another process"),  # type: ignore[call-overload]
            (lambda: jobs.run(add, 1, shutdown=-1), "shutdown must be seconds"),
        ]
        for call, problem in calls:
            error = await refused(call())
            assert isinstance(error, hf.SpecError)
            assert problem in str(error)
        with pytest.raises(hf.SpecError, match="max_concurrency must be"):
            jobs.stream(add, [1], max_concurrency=0)
    with pytest.raises(hf.SpecError, match="tasks 'jobs': max_children"):
        hf.supervision.tasks("jobs", max_children=-1)


async def test_results_have_the_functions_type() -> None:
    """Checked by mypy and pyright, which read the tests too."""
    async with opened() as (_, jobs):
        assert_type(await jobs.run(add, 1), int)
        assert_type(await jobs.run(add_slowly, 1, 2, timeout=9.0), int)
        assert_type(jobs.start(refuse), hf.supervision.Job[int])
        async for result in jobs.stream(str, [1]):
            assert_type(result, hf.supervision.Ok[int, str] | hf.supervision.Failed[int])
            assert result == hf.supervision.Ok(1, "1")


# -- what would end the program -------------------------------------------------------------------------------------


async def leave_the_program(how: str) -> None:
    await asyncio.sleep(0)
    raise SystemExit(3) if how == "SystemExit" else KeyboardInterrupt


def leave_it_from_a_thread(how: str) -> None:
    raise SystemExit(3) if how == "SystemExit" else KeyboardInterrupt


@pytest.mark.parametrize("how", ["SystemExit", "KeyboardInterrupt"])
@pytest.mark.parametrize("job", [leave_the_program, leave_it_from_a_thread])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_job_that_would_end_the_program_ends_itself(how: str, job: Any, isolation: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        jobs = hf.supervision.Tasks(await system.start(hf.supervision.tasks("jobs")))
        with pytest.raises(hf.RemoteCrash, match=how):
            await jobs.run(job, how, isolation=isolation)
        task = asyncio.current_task()
        assert task is not None
        assert not task.cancelling()
        assert await jobs.run(asyncio.sleep, 0, "still here") == "still here"


@pytest.mark.parametrize("how", ["SystemExit", "KeyboardInterrupt"])
async def test_so_does_background_work_of_an_actor(how: str) -> None:
    class Works(Caller):
        @hf.on(Begin)
        def begin(self, message: Begin) -> None:
            self.ctx.create_task(leave_the_program(how))

    async with hf.ActorSystem(log=False) as system:
        ref = await system.start(hf.child("works", hf.start(Works)))
        with system.events() as events:
            ref.tell(Begin())
            while not (told := [event for event in events.take() if isinstance(event, hf.events.ActorCrashed)]):
                await asyncio.sleep(0)
        assert [how in str(event.reason) for event in told] == [True]
        assert await ref.ask(Do(functools.partial(asyncio.sleep, 0, "again"))) == "again"


class Begin(hf.Message): ...
