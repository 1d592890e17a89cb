"""Restart rules by exit reason (W6), back-off under load (W5), and what counts as a restart."""

import asyncio
import os
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.rules import Action
from tests.supervision.family import Boom, Family, Kid, Leave, Plan, kid

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


class Broken(ValueError):
    """The user's own."""


CRASH = hf.Crash("ValueError", "boom")
OWN = hf.Crash(f"{__name__}.Broken", "boom")


@pytest.mark.parametrize(
    ("about", "reason", "fits"),
    [
        (hf.KILLED, hf.KILLED, True),
        (hf.Signal(9), hf.Signal(9), True),
        (hf.Signal(9), hf.Signal(15), False),
        (hf.Signal, hf.Signal(15), True),
        (hf.Shutdown("x"), hf.Shutdown("x"), True),
        (hf.Shutdown("x"), hf.SHUTDOWN, False),
        (hf.ExitReason, hf.NORMAL, True),
        (hf.Crash, CRASH, True),
        (hf.Crash, hf.KILLED, False),
        (ValueError, CRASH, True),
        (ValueError, OWN, True),  # A class stands for those derived from it, by name too.
        (Exception, CRASH, True),
        (Broken, CRASH, False),
        (Broken, OWN, True),
        ("ValueError", CRASH, True),
        ("Broken", OWN, True),
        (f"{__name__}.Broken", OWN, True),
        ("somewhere.Broken", OWN, False),
        ("somewhere.NeverLoaded", hf.Crash("somewhere.NeverLoaded", ""), True),
        (MemoryError, hf.OutOfMemory(), True),
        ("Signal", hf.Signal(9), True),
        (KeyError, CRASH, False),
    ],
)
def test_what_a_rule_is_about(about: Any, reason: hf.ExitReason, fits: bool) -> None:
    assert hf.rule(about, "stop").fits(reason) is fits


@pytest.mark.parametrize("reason", [7, None, "", int, CRASH])
def test_a_rule_about_something_else_is_refused(reason: Any) -> None:
    with pytest.raises(hf.SpecError, match="rule: "):
        hf.rule(reason, "stop")


def test_other_actions_and_other_rules_are_refused() -> None:
    with pytest.raises(hf.SpecError, match="the action must be one of restart, stop, escalate, not 'resume'"):
        hf.rule(ValueError, "resume")  # type: ignore[arg-type]
    with pytest.raises(hf.SpecError, match=r"child 'a': rules must come from rule\(reason, action\)"):
        kid(Plan(), "a", rules=["stop"])


@pytest.mark.parametrize("restart", ["permanent", "transient", "temporary"])
@pytest.mark.parametrize(
    ("action", "told", "alive"), [("restart", "-b +b", True), ("stop", "-b", True), ("escalate", "-b -c -a", False)]
)
@pytest.mark.parametrize("message", [Boom(), Leave()], ids=["crash", "normal"])
async def test_a_rule_comes_before_the_restart_type(
    restart: Any, action: Action, told: str, alive: bool, message: hf.Message[Any]
) -> None:
    plan = Plan()
    rules = [hf.rule(ValueError, action), hf.rule(hf.NORMAL, action), hf.rule(hf.ExitReason, "restart")]
    async with hf.ActorSystem(log=False) as system:
        children = [kid(plan, "a"), kid(plan, "b", restart=restart, rules=rules), kid(plan, "c")]
        family = await Family.start(system, plan, *children, restart="temporary")
        assert await family.after("b", message) == told
        assert family.is_alive is alive


async def test_where_no_rule_fits_the_restart_type_decides() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(
            system, plan, kid(plan, "a", restart="transient", rules=[hf.rule(KeyError, "stop")])
        )
        assert await family.after("a", Boom()) == "-a +a"
        assert await family.after("a", Leave()) == "-a"


async def test_escalation_hands_the_reason_up_where_rules_can_meet_it() -> None:
    """So that a transient supervisor is restarted by it, which a reached intensity (a clean end) would not do."""
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        inner = hf.supervisor(
            "inner",
            children=[kid(plan, "leaf", rules=[hf.rule(ValueError, "escalate")])],
            restart="transient",
        )
        family = await Family.start(system, plan, inner, kid(plan, "b"), strategy="rest_for_one")
        with system.events() as events:
            system.ref("/app/top/inner/leaf", Kid).tell(Boom())
            assert await family.rest() == "-leaf -b +leaf +b"
            restarted = [event for event in events.take() if isinstance(event, hf.events.ChildRestarted)]
        assert [(event.address, str(event.reason)) for event in restarted] == [("/app/top/inner", "ValueError: boom")]


async def test_a_stop_by_rule_triggers_auto_shutdown() -> None:
    plan = Plan()
    async with hf.ActorSystem(log=False) as system:
        child = kid(plan, "a", restart="transient", significant=True, rules=[hf.rule(ValueError, "stop")])
        family = await Family.start(system, plan, child, auto_shutdown="any_significant", restart="temporary")
        await family.after("a", Boom())
        assert not family.is_alive


class Lone(hf.Actor):
    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise Broken("boom")


@pytest.mark.parametrize("how", ["crash", "signal"])
async def test_rules_know_how_a_process_ended(how: str) -> None:
    rules = [hf.rule(hf.Signal, "stop"), hf.rule(ValueError, "stop")]
    async with hf.ActorSystem(log=False) as system:
        lone = hf.child("lone", hf.start(Lone), isolation="process", rules=rules)
        top = await system.start(hf.supervisor("top", children=[lone]))
        ref = system.ref("/app/top/lone", Lone)
        gone = ref._cell.ended()
        if how == "crash":
            ref.tell(Boom())
        else:
            os.kill(system.pid_of(ref), signal.SIGTERM)
        await gone
        assert [info.state for info in await top.ask(hf.WhichChildren())] == ["stopped"]


async def test_rules_travel_with_a_subtree() -> None:
    rules = [hf.rule(hf.Signal(9), "escalate"), hf.rule(Broken, "stop")]
    async with hf.ActorSystem(log=False) as system:
        children = [hf.child("lone", hf.start(Lone), rules=rules)]
        top = await system.start(hf.supervisor("top", children=children, isolation="process"))
        with pytest.raises(hf.RemoteCrash):
            await system.ref("/app/top/lone", Lone).ask(Boom())
        assert [info.state for info in await top.ask(hf.WhichChildren())] == ["stopped"]


# -- back-off -------------------------------------------------------------------------------------------------------


@virtual
async def test_only_real_restarts_use_the_budget() -> None:
    """W6: a restart that was cancelled while it waited is none."""
    plan = Plan()
    slow = hf.Backoff(initial=1.0, maximum=1.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a", backoff=slow), intensity=1, period=1000.0)
        for _ in range(5):
            await family.after("a", Boom())
            await family.top.ask(hf.TerminateChild("a"))
            await asyncio.sleep(5.0)
            await family.top.ask(hf.RestartChild("a"))
        await family.after("a", Boom())
        await asyncio.sleep(5.0)
        assert await family.states() == {"a": "running"}


@virtual
async def test_a_stale_attempt_does_not_restart_a_child_that_was_started_by_hand() -> None:
    plan = Plan()
    slow = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)
    async with hf.ActorSystem(log=False) as system:
        family = await Family.start(system, plan, kid(plan, "a", backoff=slow))
        await family.after("a", Boom())
        await family.top.ask(hf.TerminateChild("a"))
        await family.top.ask(hf.RestartChild("a"))
        plan.take()
        await asyncio.sleep(1000.0)
        assert plan.take() == ""
