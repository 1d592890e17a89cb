"""The run loop: turns are tasks to whoever looks, and no handler can hurt another actor (DESIGN 11; T31, T32)."""

import asyncio
import contextvars
import sys
import time
from collections.abc import Callable
from typing import Any

import anyio
import pytest

import holdfast as hf
from holdfast.actors.kernel.loop import MOST, RUNNERS
from tests.actors.doers import Do, Doer, Doers, DoNow, pause


@pytest.fixture
def doer(system: hf.ActorSystem) -> Doers:
    return lambda: system.spawn(hf.start(Doer))


# -- a turn is a task ------------------------------------------------------------------------------------------------


async def test_a_turn_has_one_current_task_from_first_to_last_step(doer: Doers) -> None:
    async def work(_: Any) -> bool:
        first = asyncio.current_task()
        await pause()
        second = asyncio.current_task()
        await asyncio.sleep(0.001)
        return first is not None and first is second is asyncio.current_task()

    assert await doer().ask(Do(work))


async def test_asyncio_timeout_works_in_a_handler(doer: Doers) -> None:
    async def work(_: Any) -> str:
        try:
            async with asyncio.timeout(0.001):
                await asyncio.Event().wait()
        except TimeoutError:
            await pause(3)
            return "timed out"
        return "never"

    one = doer()
    for _ in range(3):
        assert await one.ask(Do(work)) == "timed out"


@pytest.mark.parametrize("delay", [0, -1])
async def test_a_timeout_that_is_over_in_the_first_step_of_a_fresh_runner(system: hf.ActorSystem, delay: float) -> None:
    """The cancel reaches the turn between its first wait and the runner's first step."""

    async def work(_: Any) -> str:
        try:
            async with asyncio.timeout(delay):
                await asyncio.Event().wait()
        except TimeoutError:
            return "timed out"
        return "never"

    system._node._idle.clear()  # so that the turn gets a runner whose task has not begun
    asks = [system.spawn(hf.start(Doer)).ask(Do(work)) for _ in range(2 * RUNNERS)]
    assert set(await asyncio.gather(*asks)) == {"timed out"}


async def test_anyio_scopes_work_in_a_handler(doer: Doers) -> None:
    async def work(_: Any) -> list[str]:
        told = []
        with anyio.move_on_after(0.001) as scope:
            await anyio.sleep_forever()
        told.append(f"cancelled {scope.cancelled_caught}")
        try:
            with anyio.fail_after(0):
                await anyio.sleep_forever()
        except TimeoutError:
            told.append("failed")
        async with anyio.create_task_group() as group:
            group.start_soon(anyio.sleep, 0.001)
            group.start_soon(anyio.sleep_forever)
            await pause()
            group.cancel_scope.cancel()
        with anyio.CancelScope() as own:
            own.cancel()
            await anyio.sleep_forever()
        told.append("group")
        return told

    one, other = doer(), doer()
    expected = ["cancelled True", "failed", "group"]
    assert await asyncio.gather(*(actor.ask(Do(work)) for actor in (one, other))) == [expected, expected]


async def test_a_task_group_of_the_standard_library_works_in_a_handler(doer: Doers) -> None:
    async def work(_: Any) -> int:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(asyncio.sleep(0, n)) for n in range(4)]
        return sum(task.result() for task in tasks)

    assert await doer().ask(Do(work)) == 6


async def test_context_variables_stay_with_their_actor(doer: Doers) -> None:
    var: contextvars.ContextVar[str] = contextvars.ContextVar("var", default="unset")

    async def put(value: str) -> str:
        before = var.get()
        var.set(value)
        await pause(2)
        return f"{before} {var.get()}"

    one, other = doer(), doer()
    first, second = await asyncio.gather(one.ask(Do(lambda _: put("one"))), other.ask(Do(lambda _: put("other"))))
    assert (first, second) == ("unset one", "unset other")
    assert await one.ask(DoNow(lambda _: var.get())) == "one"
    assert await other.ask(Do(lambda _: put("x"))) == "other x"
    assert var.get() == "unset"


# -- handlers that misbehave -----------------------------------------------------------------------------------------


class Odd(BaseException): ...


@pytest.mark.parametrize("suspended", [False, True])
@pytest.mark.parametrize(
    "error",
    [
        ValueError("v"),
        SystemExit(3),
        Odd(),
        asyncio.CancelledError(),
        GeneratorExit(),
        StopAsyncIteration(),
        TimeoutError(),
    ],
    ids=lambda error: type(error).__name__,
)
async def test_whatever_a_handler_raises_ends_its_own_life_only(
    doer: Doers, error: BaseException, suspended: bool
) -> None:
    async def work(_: Any) -> None:
        if suspended:
            await pause(2)
        raise error

    victim, bystander = doer(), doer()
    with pytest.raises(hf.RemoteCrash) as crash:
        await victim.ask(Do(work))
    assert crash.value.type_name.rpartition(".")[2] == type(error).__name__
    with pytest.raises(hf.ActorStopped):
        await victim.ask(Do(work))
    assert await bystander.ask(DoNow(lambda _: "well")) == "well"


@pytest.mark.parametrize("error", [SystemExit(1), Odd(), StopIteration(5), GeneratorExit(), asyncio.CancelledError()])
async def test_whatever_a_plain_handler_raises_ends_its_own_life_only(doer: Doers, error: BaseException) -> None:
    def work(_: Any) -> None:
        raise error

    victim, bystander = doer(), doer()
    with pytest.raises(hf.RemoteCrash):
        await victim.ask(DoNow(work))
    assert await bystander.ask(DoNow(lambda _: "well")) == "well"


async def test_sys_exit_in_a_tell_does_not_end_the_program(doer: Doers, system: hf.ActorSystem) -> None:
    victim = doer()
    victim.tell(DoNow(lambda _: sys.exit("bye")))
    await system._node.settled()
    assert victim._cell.is_dead


async def test_an_exception_that_cannot_be_shown_is_reported_all_the_same(doer: Doers) -> None:
    class Unshown(Exception):
        def __str__(self) -> str:
            raise RuntimeError("no text")

    def work(_: Any) -> None:
        raise Unshown

    with pytest.raises(hf.RemoteCrash, match="Unshown"):
        await doer().ask(DoNow(work))


@pytest.mark.parametrize("error", [asyncio.CancelledError(), SystemExit(), ValueError()])
async def test_whatever_on_stop_raises_the_end_goes_on(system: hf.ActorSystem, error: BaseException) -> None:
    class Grumpy(Doer):
        def on_stop(self, reason: hf.ExitReason) -> None:
            raise error

    grumpy, bystander = system.spawn(hf.start(Grumpy)), system.spawn(hf.start(Doer))
    async with asyncio.timeout(30):
        await system.stop(grumpy)
        assert await bystander.ask(DoNow(lambda _: "well")) == "well"


async def test_a_blocking_handler_delays_the_others_and_no_more(doer: Doers) -> None:
    blocker, others = doer(), [doer() for _ in range(5)]
    blocker.tell(DoNow(lambda _: time.sleep(0.02)))
    assert await asyncio.gather(*(other.ask(DoNow(lambda _: 1)) for other in others)) == [1] * 5


async def test_a_handler_that_never_returns_holds_up_nobody_else(doer: Doers) -> None:
    stuck = [doer() for _ in range(3 * RUNNERS)]
    for actor in stuck:
        actor.tell(Do(lambda _: asyncio.Event().wait()))
    assert await doer().ask(Do(lambda _: pause(3))) is None
    for actor in stuck:
        actor.kill()


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_system_ends_even_if_a_handler_never_returns() -> None:
    async with asyncio.timeout(60), hf.ActorSystem("t", log=False) as system:
        system.spawn(hf.start(Doer)).tell(Do(lambda _: asyncio.Event().wait()))
        await pause(2)


async def test_a_handler_that_cancels_itself_is_its_own_crash(doer: Doers) -> None:
    async def work(_: Any) -> None:
        task = asyncio.current_task()
        assert task is not None
        task.cancel()
        await asyncio.Event().wait()

    with pytest.raises(hf.RemoteCrash, match="CancelledError"):
        await doer().ask(Do(work))
    assert await doer().ask(Do(lambda _: pause(3))) is None


async def test_a_cancel_that_its_handler_does_not_wait_for_hits_nobody_else(doer: Doers) -> None:
    async def work(_: Any) -> str:
        task = asyncio.current_task()
        assert task is not None
        task.cancel()
        return "done"

    async def innocent(_: Any) -> str:
        await pause(3)
        async with asyncio.timeout(30):
            await asyncio.sleep(0.001)
        return "well"

    one = doer()
    assert await one.ask(Do(work)) == "done"
    asks = [one.ask(Do(work)), one.ask(Do(innocent)), doer().ask(Do(innocent)), doer().ask(DoNow(lambda _: "now"))]
    assert await asyncio.gather(*asks) == ["done", "well", "well", "now"]


async def test_a_runner_that_is_cancelled_while_idle_is_not_used_again(doer: Doers) -> None:
    """Somebody kept `current_task()` of a turn that is long over."""
    kept: list[asyncio.Task[Any]] = []

    async def keep(_: Any) -> None:
        await pause()
        task = asyncio.current_task()
        assert task is not None
        kept.append(task)

    async def innocent(_: Any) -> str:
        await pause(3)
        return "well"

    one = doer()
    for _ in range(3):
        await one.ask(Do(keep))
        await pause(3)
        asked = one.ask(Do(innocent))  # the run loop is called after this, before the cancelled task is
        kept.pop().cancel()
        assert await asked == "well"


async def test_a_cancel_before_the_runner_s_task_has_begun_reaches_the_turn_in_its_own_task(
    system: hf.ActorSystem, doer: Doers
) -> None:
    """Under uvloop a timer does this whenever it is due in the tick of the turn's first step."""
    tasks: list[asyncio.Task[Any]] = []

    async def work(_: Any) -> tuple[Any, bool]:
        task = asyncio.current_task()
        assert task is not None
        tasks.append(task)
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError as error:
            await pause()
            return error.args, asyncio.current_task() is task
        return None, False

    system._node._idle.clear()
    asked, other = doer().ask(Do(work)), doer().ask(DoNow(lambda _: tasks[0].cancel("why")))  # in one slice
    assert await asked == (("why",), True)
    assert await other


async def test_a_cancel_between_first_wait_and_takeover_keeps_its_text(doer: Doers) -> None:
    """anyio knows its own cancels by it."""

    async def work(_: Any) -> Any:
        task = asyncio.current_task()
        assert task is not None
        asyncio.get_running_loop().call_soon(lambda: task.cancel("why"))
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError as error:
            return error.args

    one = doer()
    for _ in range(3):  # with a fresh runner, and with one that was idle
        assert await one.ask(Do(work)) == ("why",)
        await pause(3)


# -- order and fairness ----------------------------------------------------------------------------------------------


async def test_order_is_kept_over_suspension(doer: Doers) -> None:
    order: list[int] = []

    def job(number: int) -> Callable[[Any], Any]:
        async def work(_: Any) -> None:
            await pause(3 if number % 2 else 0)
            order.append(number)

        return work

    one = doer()
    for number in range(20):
        one.tell((Do if number % 3 else DoNow)(job(number) if number % 3 else lambda _, n=number: order.append(n)))
    await one.ask(DoNow(lambda _: None))
    assert order == list(range(20))


async def test_one_turn_at_a_time(doer: Doers) -> None:
    inside = [0]

    async def work(_: Any) -> int:
        inside[0] += 1
        await pause(3)
        now = inside[0]
        inside[0] -= 1
        return now

    one = doer()
    assert await asyncio.gather(*(one.ask(Do(work)) for _ in range(20))) == [1] * 20


async def test_an_actor_that_always_has_work_does_not_starve_others(doer: Doers) -> None:
    """Nor the host program: its own callbacks run in between."""
    running, ticks = [True], [0]

    def again(actor: Doer) -> None:
        if running[0]:
            actor.ctx.ref.tell(DoNow(again))

    def tick() -> None:
        ticks[0] += 1
        if running[0]:
            asyncio.get_running_loop().call_soon(tick)

    greedy = doer()
    for _ in range(2 * MOST):
        greedy.tell(DoNow(again))
    tick()
    for _ in range(20):
        assert await doer().ask(DoNow(lambda _: 1)) == 1
    running[0] = False
    assert ticks[0] > 20


async def test_no_runner_is_lost_or_kept_beyond_the_few_idle_ones(doer: Doers, system: hf.ActorSystem) -> None:
    gate = asyncio.Event()
    asks = [doer().ask(Do(lambda _: gate.wait())) for _ in range(5 * RUNNERS)]
    await pause(3)
    gate.set()
    await asyncio.gather(*asks)
    await pause(5)
    assert len(system._node._runners) <= RUNNERS
    assert system._node.turns_held == 0


async def test_settled_waits_for_suspended_turns(doer: Doers, system: hf.ActorSystem) -> None:
    done: list[int] = []

    async def work(_: Any) -> None:
        await asyncio.sleep(0.01)
        done.append(1)

    for _ in range(3):
        doer().tell(Do(work))
    await system._node.settled()
    assert len(done) == 3
