"""A child that fails to start while its group is restarted (otp.md 1.5), and groups whose members start slowly."""

import asyncio

import pytest

import holdfast as hf
from tests.supervision.family import Boom, Family, Life, Plan, kid, refused

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

SLOW = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)
LATE = pytest.mark.parametrize("late", [False, True], ids=["__init__", "on_start"])


async def family_of(system: hf.ActorSystem, plan: Plan, strategy: str, late: bool = False, **options: object) -> Family:
    children = [kid(plan, name, late=late) for name in "abcd"]
    return await Family.start(system, plan, *children, strategy=strategy, **options)


@LATE
async def test_one_for_all_tries_again_from_the_first(late: bool) -> None:
    """Those that were started before the failed one stay up until the retry, which stops them in reverse."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await family_of(system, plan, "one_for_all", late)
        plan.todo["c"] = ["fail"]
        told = await family.after("a", Boom())
        assert told == "-a -d -c -b +a +b !c -b -a +a +b +c +d"
        assert set((await family.states()).values()) == {"running"}


@LATE
async def test_rest_for_one_tries_again_from_the_failed_child(late: bool) -> None:
    """Those that were restarted before it are kept."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await family_of(system, plan, "rest_for_one", late)
        plan.todo["c"] = ["fail"]
        told = await family.after("b", Boom())
        assert told == "-b -d -c +b !c +c +d"
        assert [await family.ref(name).ask(Life()) for name in "abcd"] == [1, 2, 3, 2]


@pytest.mark.parametrize(
    ("strategy", "first"), [("one_for_all", "-a -d -c -b +a +b"), ("rest_for_one", "-a -d -c -b +a +b")]
)
async def test_between_the_attempts_the_earlier_run_and_the_later_do_not(strategy: str, first: str) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        children = [kid(plan, name, backoff=SLOW if name == "c" else None) for name in "abcd"]
        family = await Family.start(system, plan, *children, strategy=strategy)
        plan.todo["c"] = ["fail"]
        assert await family.after("a", Boom()) == f"{first} !c"
        assert await family.states() == {"a": "running", "b": "running", "c": "restarting", "d": "stopped"}
        counts = await family.top.ask(hf.supervision.CountChildren())
        assert (counts.specs, counts.active, counts.workers) == (4, 2, 4)
        assert asyncio.get_running_loop().time() == 0.0
        await asyncio.sleep(100.0)
        assert plan.take() == ("-b -a +a +b +c +d" if strategy == "one_for_all" else "+c +d")


@pytest.mark.parametrize("strategy", ["one_for_all", "rest_for_one"])
@pytest.mark.parametrize("intensity", [1, 2, 3])
async def test_every_attempt_of_a_group_counts(strategy: str, intensity: int) -> None:
    """The first restart and its retries together: with intensity N the attempt N + 1 is not made."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            family = await family_of(system, plan, strategy, intensity=intensity, restart="temporary")
            plan.todo["b"] = ["fail"] * 100
            told = await family.after("a", Boom())
            gave_up = [event.child for event in events.take() if isinstance(event, hf.events.SupervisorGaveUp)]
        assert told.count("!b") == intensity
        assert gave_up == ["b"]
        assert not family.is_alive


async def test_terminating_the_child_voids_the_retry() -> None:
    """otp.md 1.5, 1.9: a pending retry is void when the child is not restarting any more."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        children = [kid(plan, name, backoff=SLOW if name == "b" else None) for name in "abc"]
        family = await Family.start(system, plan, *children, strategy="rest_for_one")
        plan.todo["b"] = ["fail"]
        await family.after("a", Boom())
        await family.top.ask(hf.TerminateChild("b"))
        assert await family.states() == {"a": "running", "b": "stopped", "c": "stopped"}
        await asyncio.sleep(1000.0)
        assert await family.states() == {"a": "running", "b": "stopped", "c": "stopped"}
        await family.top.ask(hf.RestartChild("c"))
        assert (await family.states())["c"] == "running"


# -- slow starts ----------------------------------------------------------------------------------------------------


async def slow_family(system: hf.ActorSystem, plan: Plan, strategy: str = "one_for_all") -> Family:
    """b takes ten seconds to start, and is starting now, after a crash of a."""
    family = await family_of(system, plan, strategy, late=True)
    plan.todo["b"] = [10.0]
    family.ref("a").tell(Boom())
    await asyncio.sleep(1.0)
    assert plan.take() == "-a -d -c -b +a"
    return family


async def test_the_supervisor_answers_while_a_member_starts_and_later_ones_wait() -> None:
    """DESIGN 5: a restart runs outside the supervisor's turn; later siblings start after it."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await slow_family(system, plan)
        assert await family.states() == {"a": "running", "b": "restarting", "c": "restarting", "d": "restarting"}
        for call in (hf.RestartChild("c"), hf.DeleteChild("b")):
            assert await refused(family.top.ask(call)) == hf.errors.ChildBusy(call.id, "restarting")
        assert asyncio.get_running_loop().time() == 1.0
        await asyncio.sleep(20.0)
        assert plan.take() == "+b +c +d"
        assert set((await family.states()).values()) == {"running"}


async def test_terminating_the_one_that_starts_lets_the_later_ones_begin() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await slow_family(system, plan)
        await family.top.ask(hf.TerminateChild("b"), timeout=60.0)
        await family.rest()
        assert await family.states() == {"a": "running", "b": "stopped", "c": "running", "d": "running"}


async def test_terminating_one_that_waits_takes_it_out_of_the_row() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await slow_family(system, plan)
        await family.top.ask(hf.TerminateChild("c"))
        await asyncio.sleep(20.0)
        assert await family.states() == {"a": "running", "b": "running", "c": "stopped", "d": "running"}
        assert plan.take() == "+b +d"


async def test_a_crash_of_an_earlier_member_begins_the_group_anew() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await slow_family(system, plan)
        family.ref("a").tell(Boom())
        await asyncio.sleep(20.0)
        assert plan.take().endswith("+a +b +c +d")
        assert set((await family.states()).values()) == {"running"}
        assert [await family.ref(name).ask(Life()) for name in "acd"] == [3, 2, 2]


async def test_stopping_the_supervisor_in_the_middle_of_a_row_ends_all() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await slow_family(system, plan)
        await system.stop(family.top)
        assert system.tree() == ["/app"]
        await asyncio.sleep(100.0)
        assert "+c" not in plan.take()
