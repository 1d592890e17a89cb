"""Significant children and auto_shutdown (otp.md 1.1, 1.8)."""

from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.spec import AutoShutdown, Restart
from tests.supervision.family import Boom, Family, Leave, Plan, kid, refused

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

ANY: AutoShutdown = "any_significant"
ALL: AutoShutdown = "all_significant"


def significant(plan: Plan, id: str, restart: Restart = "transient", **options: Any) -> hf.ChildSpec:
    return kid(plan, id, restart=restart, significant=True, **options)


# -- what goes together ---------------------------------------------------------------------------------------------


async def test_a_permanent_child_cannot_be_significant() -> None:
    with pytest.raises(hf.SpecError, match="child 'a': a permanent child cannot be significant"):
        kid(Plan(), "a", significant=True)


async def test_significant_children_need_a_supervisor_that_ends_with_them() -> None:
    child = significant(Plan(), "a")
    with pytest.raises(hf.SpecError, match="supervisor 'top': child 'a' is significant, but auto_shutdown is 'never'"):
        hf.supervisor("top", children=[child])
    hf.supervisor("top", children=[child], auto_shutdown="any_significant")


async def test_the_same_holds_for_children_that_are_added() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan)
        error = await refused(family.top.ask(hf.StartChild(significant(plan, "a"))))
        assert isinstance(error, hf.SpecError)
        assert (await family.states(), plan.log) == ({}, [])
        with pytest.raises(hf.SpecError, match="auto_shutdown is 'never'"):  # The root never ends with a child.
            await system.start(hf.supervisor("other", restart="transient", significant=True))


async def test_check_children_checks_what_it_is_told() -> None:
    child = significant(Plan(), "a")
    hf.supervision.check_children([child])
    hf.supervision.check_children([child], "all_significant")
    with pytest.raises(hf.SpecError, match="significant, but"):
        hf.supervision.check_children([child], "never")
    with pytest.raises(hf.SpecError, match="two children have the id 'a'"):
        hf.supervision.check_children([child, child])
    with pytest.raises(hf.SpecError, match="children must be a list"):
        hf.supervision.check_children(7)  # type: ignore[arg-type]
    with pytest.raises(hf.SpecError, match="auto_shutdown must be one of"):
        hf.supervision.check_children([], "sometimes")  # type: ignore[arg-type]


@pytest.mark.parametrize("value", ["sometimes", None, True])
async def test_a_wrong_auto_shutdown_is_refused(value: Any) -> None:
    with pytest.raises(hf.SpecError, match="supervisor 'top': auto_shutdown must be one of never"):
        hf.supervisor("top", auto_shutdown=value)


# -- what is a trigger ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("auto", [ANY, ALL])
@pytest.mark.parametrize(
    ("restart", "message", "ends"),
    [
        ("transient", Leave(), True),
        ("transient", Leave(hf.SHUTDOWN), True),
        ("transient", Leave(hf.Shutdown("done")), True),
        ("transient", Boom(), False),  # It is restarted.
        ("temporary", Leave(), True),
        ("temporary", Boom(), True),
    ],
)
async def test_an_end_by_itself_without_a_restart_is_a_trigger(
    auto: AutoShutdown, restart: Restart, message: hf.Message[Any], ends: bool
) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        with system.events() as events:
            family = await Family.start(
                system,
                plan,
                kid(plan, "a"),
                significant(plan, "b", restart),
                kid(plan, "c"),
                auto_shutdown=auto,
                restart="temporary",
            )
            told = await family.after("b", message)
            auto_shutdowns = [event.child for event in events.take() if isinstance(event, hf.events.AutoShutdown)]
        assert family.is_alive is not ends
        assert told == ("-b -c -a" if ends else "-b +b")
        assert auto_shutdowns == (["b"] if ends else [])


async def test_any_ends_with_the_first_all_with_the_last() -> None:
    for auto, ends_with in ((ANY, "a"), (ALL, "b")):
        plan = Plan()
        async with hf.ActorSystem(log=False) as system:
            children = [significant(plan, "a"), significant(plan, "b", "temporary"), kid(plan, "c")]
            family = await Family.start(system, plan, *children, auto_shutdown=auto, restart="temporary")
            await family.after("a", Leave())
            assert family.is_alive is (ends_with == "b")
            if family.is_alive:
                await family.after("b", Boom())
            assert not family.is_alive


async def test_children_that_are_not_significant_are_no_trigger() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(
            system,
            plan,
            kid(plan, "a", restart="transient"),
            kid(plan, "b", restart="temporary"),
            significant(plan, "c"),
            auto_shutdown=ANY,
        )
        assert await family.after("a", Leave()) == "-a"
        assert await family.after("b", Boom()) == "-b"
        assert await family.states() == {"a": "stopped", "c": "running"}


async def test_terminating_a_significant_child_is_no_trigger_but_it_counts_as_gone() -> None:
    """otp.md 1.8: when the last other one ends by itself, all_significant is reached."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        children = [significant(plan, "a"), significant(plan, "b")]
        family = await Family.start(system, plan, *children, auto_shutdown=ALL, restart="temporary")
        await family.top.ask(hf.TerminateChild("a"))
        assert await family.states() == {"a": "stopped", "b": "running"}
        await family.after("b", Leave())
        assert not family.is_alive


async def test_terminating_every_significant_child_is_no_trigger() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, significant(plan, "a"), significant(plan, "b"), auto_shutdown=ANY)
        for name in "ab":
            await family.top.ask(hf.TerminateChild(name))
        assert await family.states() == {"a": "stopped", "b": "stopped"}


@pytest.mark.parametrize("restart", ["transient", "temporary"])
async def test_being_stopped_with_a_group_is_no_trigger(restart: Restart) -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(
            system,
            plan,
            kid(plan, "a"),
            significant(plan, "b", restart),
            strategy="one_for_all",
            auto_shutdown=ANY,
        )
        await family.after("a", Boom())
        assert set(await family.states()) == ({"a", "b"} if restart == "transient" else {"a"})


async def test_a_significant_child_that_is_being_restarted_is_not_gone() -> None:
    plan = Plan()
    slow = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        children = [significant(plan, "a", backoff=slow), significant(plan, "b")]
        family = await Family.start(system, plan, *children, auto_shutdown=ALL)
        await family.after("a", Boom())
        await family.after("b", Leave())
        assert await family.states() == {"a": "restarting", "b": "stopped"}


async def test_the_end_is_clean_and_cascades_through_significant_supervisors() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        inner = hf.supervisor(
            "inner",
            children=[significant(plan, "leaf")],
            auto_shutdown=ANY,
            restart="transient",
            significant=True,
        )
        family = await Family.start(system, plan, inner, kid(plan, "b"), auto_shutdown=ANY, restart="temporary")
        system.ref("/app/top/inner/leaf", hf.Actor).tell(Leave())
        assert await family.rest() == "-leaf -b"
        assert not family.is_alive


async def test_a_transient_parent_does_not_restart_it_a_permanent_one_does() -> None:
    for restart, lives in (("transient", False), ("permanent", True)):
        plan = Plan()
        async with hf.ActorSystem(log=False) as system:
            family = await Family.start(system, plan, significant(plan, "a"), auto_shutdown=ANY, restart=restart)
            assert await family.after("a", Leave()) == ("-a +a" if lives else "-a")
            assert family.is_alive is lives


async def test_changing_auto_shutdown_holds_for_the_children_there_are() -> None:
    """otp.md 1.10."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(
            system, plan, significant(plan, "a"), significant(plan, "b"), auto_shutdown=ALL, restart="temporary"
        )
        await family.top.ask(hf.supervision.ChangeSupervisor(hf.supervision.Flags(auto_shutdown="any_significant")))
        await family.after("a", Leave())
        assert not family.is_alive
