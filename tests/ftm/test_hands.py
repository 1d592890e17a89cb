"""Failover, adaptation, repair and supervisors do not act on one actor at the same time (T63)."""

from __future__ import annotations

import asyncio
import contextvars
import os
import signal
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis.literals import Literal
from holdfast.diagnosis.planning import Plan, Step, repair_problem
from holdfast.diagnosis.repair import (
    DONE,
    LOST,
    SKIPPED,
    Act,
    RepairAction,
    Repertoire,
    action,
    protect_by,
    restart_child,
)
from holdfast.diagnosis.repair.executor import Executor, Result
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import FaultClasses, Resources
from holdfast.ftm.model.mechanism import find
from holdfast.ftm.monitoring.adaptations import AdaptationDecided, AdaptationHeld
from holdfast.ftm.monitoring.judge import Judge, Settings
from holdfast.ftm.monitoring.monitor import MechanismWatch, MonitoringEngine, Observe
from holdfast.supervision.arbiter import Hand, InOtherHands, arbiter_of
from tests.ftm.accounts import Add, Boom, Counter, Load, Tags
from tests.ftm.test_adaptation import protected, stack, transition
from tests.ftm.test_failover import group_of, other, pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

ALICE = "/app/alice"
MEND = "(:action mend :parameters (?n - node) :precondition (bad ?n) :effect (and (good ?n) (not (bad ?n))))"
SECONDS = 30.0


class Caller(hf.Actor):
    """Its context is the one of whoever repairs."""


class Repair:
    """A plan of one step, carried out by the real executor; nothing is observed."""

    def __init__(self, system: hf.ActorSystem, one: RepairAction) -> None:
        caller = system.spawn(hf.start(Caller))
        self._system, self._one, self._caller = system, one, caller
        self._domain = Repertoire([one]).domain
        self.begun = asyncio.Event()
        self.epochs: list[int] = []

    async def carry_out(self) -> Result:
        actor = self._caller._cell.actor
        assert actor is not None
        facts = [(f"may-{self._one.name}", "alice")]
        problem = repair_problem(self._domain, nodes=["alice"], bad=["alice"], running=["alice"], facts=facts)
        executor = Executor(
            self,
            arbiter_of(self._system._node),
            address=lambda step: ALICE,
            actions=lambda name: self._one,
            make=lambda step, epoch, reason, check: Act(step, epoch, reason, actor.ctx, check),
            reason="a test",
        )
        async with asyncio.timeout(SECONDS):
            (result,) = await executor.execute(problem, Plan(((Step(self._one.name, ("alice",)),),)))
        return result

    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def seen(self, atom: Literal) -> tuple[bool | None, float]:
        return None, float("-inf")

    async def changed(self) -> None:
        await asyncio.Event().wait()

    def overtaken(self, step: Step) -> str:
        return ""

    async def approve(self, step: Step) -> str:
        return ""

    async def began(self, step: Step, epoch: int) -> None:
        self.epochs.append(epoch)
        self.begun.set()

    async def ended(self, result: Result) -> None:
        pass


def restart() -> RepairAction:
    return restart_child({"alice": ALICE})


def at_step(ref: hf.ActorRef[Any], step: str, act: Callable[[], Any]) -> list[Any]:
    """Have `act()` called when this step of a failover or an adaptation is reached first; what it returned."""
    made: list[Any] = []

    def on_step(name: str) -> None:
        if name == step and not made:
            made.append(None)
            made[0] = act()

    host: Any = ref._cell.host.place
    host.on_step = on_step
    return made


def kill(
    system: hf.ActorSystem, ref: hf.ActorRef[Any], name: str | None = None, how: signal.Signals = signal.SIGKILL
) -> None:
    name = name or group_of(ref).membership.primary
    assert name is not None
    os.kill(pid_of(system, ref, name), how)


def holder(system: hf.ActorSystem) -> Hand | None:
    grant = arbiter_of(system._node).holder(ALICE)
    return None if grant is None else grant.hand


# -- failover and repair ----------------------------------------------------------------------------------------------


async def test_a_failover_does_not_wait_for_a_repair_that_is_asleep(system: hf.ActorSystem) -> None:
    """It wins: the repair ends at once, and is told why."""

    async def sleep(act: Act, name: str) -> None:
        await asyncio.Event().wait()

    ref = await protected(system)
    load, repair = Load(ref), Repair(system, action(MEND, timeout=1000.0)(sleep))
    asleep = asyncio.create_task(repair.carry_out())
    await repair.begun.wait()
    assert holder(system) is Hand.REPAIR
    leads = group_of(ref).membership.primary
    kill(system, ref)
    await load.reached(20)
    result = await asleep
    assert (result.outcome, result.why) == (LOST, f"failover has it now: {leads} does not lead any more")
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert group_of(ref).failovers == 1
    assert holder(system) is None


@pytest.mark.parametrize(("step", "how"), [("depose", signal.SIGSTOP), ("lead", signal.SIGKILL)])
async def test_a_repair_step_that_comes_in_the_middle_of_a_failover_is_left_out(
    system: hf.ActorSystem, step: str, how: signal.Signals
) -> None:
    """It would end the replica that is to lead, and all that the actor knows with it."""
    ref = await protected(system)
    load, repair = Load(ref), Repair(system, restart())
    await load.reached(10)
    made = at_step(ref, step, lambda: (holder(system), asyncio.create_task(repair.carry_out())))
    kill(system, ref, how=how)
    await load.reached(20)
    held, task = made[0]
    result = await task
    assert held is Hand.FAILOVER
    assert result.outcome == SKIPPED
    assert f"{ALICE} is in the hands of failover" in result.why
    assert not repair.begun.is_set()
    await load.stop()
    load.check(await ref.ask(Tags()))
    await two_again(ref)
    assert (await Repair(system, restart()).carry_out()).outcome == DONE  # Now it may.


async def test_a_manager_that_dies_in_the_middle_keeps_the_actor(system: hf.ActorSystem) -> None:
    """Its next life ends the failover, and gives it back."""

    def dies() -> None:
        raise RuntimeError("struck")

    ref = await protected(system)
    load = Load(ref)
    await load.reached(10)
    at_step(ref, "kill", dies)
    host: Any = ref._cell.host.place
    strike, held = host.on_step, []

    def on_step(name: str) -> None:
        held.append((name, holder(system)))
        strike(name)

    host.on_step = on_step
    kill(system, ref)
    await load.reached(20)
    assert [one for one in held if one[0] == "kill"] == [("kill", Hand.FAILOVER)] * 2
    assert {hand for name, hand in held if name in ("depose", "epoch", "lead", "bind")} == {Hand.FAILOVER}
    assert holder(system) is None
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_the_kill_of_a_silent_backup_takes_it_from_repair(system: hf.ActorSystem) -> None:
    async def sleep(act: Act, name: str) -> None:
        await asyncio.Event().wait()

    ref = await protected(system)
    backup = other(group_of(ref))
    repair = Repair(system, action(MEND, timeout=1000.0)(sleep))
    asleep = asyncio.create_task(repair.carry_out())
    await repair.begun.wait()
    os.kill(pid_of(system, ref, backup), signal.SIGSTOP)
    result = await asleep
    assert (result.outcome, result.why) == (LOST, "failover has it now: it does not count any more")
    await two_again(ref)
    assert await ref.ask(Add(0)) == 1


# -- adaptation and repair --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", ["prepare", "commit"])
async def test_a_repair_step_that_comes_in_the_middle_of_an_adaptation_is_left_out(
    system: hf.ActorSystem, step: str
) -> None:
    ref = await protected(system)
    load, repair = Load(ref), Repair(system, restart())
    await load.reached(10)
    made = at_step(ref, step, lambda: asyncio.create_task(repair.carry_out()))
    await transition(system, ref, LFR())
    result = await made[0]
    assert result.outcome == SKIPPED
    assert f"{ALICE} is in the hands of adaptation: protect {ALICE} by LFR" in result.why
    assert (stack(ref), ref._cell.life) == (("lfr",), 1)
    assert holder(system) is None
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_a_failover_in_the_middle_of_an_adaptation_does_not_let_repair_in(system: hf.ActorSystem) -> None:
    """The adaptation rests meanwhile, and goes on."""
    ref = await protected(system)
    load, repair = Load(ref), Repair(system, restart())
    await load.reached(10)
    host: Any = ref._cell.host.place
    made: list[Any] = []

    def on_step(name: str) -> None:
        if name == "rest" and not made:
            made.append(None)
            kill(system, ref)
        elif name == "commit" and made == [None]:
            made[0] = asyncio.create_task(repair.carry_out())

    host.on_step = on_step
    await transition(system, ref, LFR())
    result = await made[0]
    assert (result.outcome, group_of(ref).failovers) == (SKIPPED, 1)
    assert "in the hands of adaptation" in result.why
    assert (stack(ref), ref._cell.life) == (("lfr",), 1)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_what_repair_has_in_hand_is_not_adapted_by_others(system: hf.ActorSystem) -> None:
    ref = await protected(system)
    woken = asyncio.Event()

    async def sleep(act: Act, name: str) -> None:
        await woken.wait()

    repair = Repair(system, action(MEND)(sleep))
    asleep = asyncio.create_task(repair.carry_out())
    await repair.begun.wait()
    with pytest.raises(hf.TransactionRefused, match=f"{ALICE} is in the hands of repair: a test"):
        await transition(system, ref, LFR())
    async with system.transaction(dry_run=True) as change:
        change.add("/app", hf.child("other", hf.start(Counter)))  # What is not about it is nobody's matter.
    woken.set()
    assert (await asleep).outcome == DONE
    await transition(system, ref, LFR())
    assert stack(ref) == ("lfr",)


async def test_repair_has_a_mechanism_changed_for_it(system: hf.ActorSystem) -> None:
    """The actor is in its hands, so what is done to it in this step is done by its leave."""
    ref = await protected(system)
    load, repair = Load(ref), Repair(system, protect_by(system.transaction, ("pbr", "tr"), {"alice": ALICE}))
    await load.reached(10)
    result = await repair.carry_out()
    assert (result.outcome, result.why) == (DONE, "")
    assert stack(ref) == ("pbr", "tr")
    assert holder(system) is None
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_a_change_that_failed_gives_the_actor_back(system: hf.ActorSystem) -> None:
    class Failing(hf.Actor):
        def on_start(self, restored: bool) -> None:
            raise RuntimeError("no")

    ref = await protected(system)
    with pytest.raises(hf.TransactionFailed):  # noqa: PT012
        async with system.transaction(timeout=30) as change:
            change.protect(ref, (LFR(), "tr"))
            change.add("/app", hf.child("bad", hf.start(Failing)))
    assert stack(ref) == ("pbr",)
    assert holder(system) is None


async def test_monitoring_waits_while_somebody_else_has_the_actor(system: hf.ActorSystem) -> None:
    """And says so, instead of having a change begun that would be refused."""
    decided = asyncio.Event()
    judge = Judge(
        Settings(required=FaultClasses.of("crash"), interval=0.02, confirm=0.0),
        Application("Counter"),
        current=("pbr",),
        mechanisms=[find(name) for name in ("pbr", "lfr", "tr")],
        resources=Resources(units=2),
    )
    watch = MechanismWatch(ALICE, judge, lambda order: decided.set(), probe=None)
    grant = arbiter_of(system._node).claim(ALICE, Hand.REPAIR, "it is slow")
    with system.events() as events:
        engine = await system.start(hf.child("monitoring", hf.start(MonitoringEngine, watch)))
        engine.tell(Observe("mismatch", 3))
        seen: list[Any] = []
        async with asyncio.timeout(SECONDS):
            while not any(isinstance(one, AdaptationHeld) for one in seen):
                seen += events.take()
                await asyncio.sleep(0.005)
        assert [one.reason for one in seen if isinstance(one, AdaptationHeld)] == [
            f"{ALICE} is in the hands of repair: it is slow"
        ]
        assert not decided.is_set()
        arbiter_of(system._node).release(grant)
        async with asyncio.timeout(SECONDS):
            await decided.wait()
        seen += events.take()
    assert len([one for one in seen if isinstance(one, AdaptationDecided)]) == 1


# -- supervisors ------------------------------------------------------------------------------------------------------


async def test_a_supervisor_restart_in_the_middle_of_a_failover_comes_behind_it(system: hf.ActorSystem) -> None:
    """One of its siblings ends, and all are started again: the failover is carried to its end first."""
    children = [
        hf.child("alice", hf.start(Counter), mechanism=PBR(), recovery=hf.hybrid()),
        hf.child("bob", hf.start(Counter)),
    ]
    await system.start(hf.supervisor("s", children=children, strategy="one_for_all", intensity=100))
    alice, bob = system.ref("/app/s/alice", Counter), system.ref("/app/s/bob", Counter)
    load, steps, judge = Load(alice), list[str](), arbiter_of(system._node)
    await load.reached(10)
    host: Any = alice._cell.host.place

    def on_step(name: str) -> None:
        if name == "lead" and "lead" not in steps:
            bob.tell(Boom())
        steps.append(name)

    host.on_step = on_step
    kill(system, alice)
    async with asyncio.timeout(SECONDS):
        while alice._cell.life == 1:
            await asyncio.sleep(0.005)
    assert "bind" in steps
    await load.reached(20)
    await load.stop()
    load.check(await alice.ask(Tags()))
    assert judge.holder("/app/s/alice") is None


@pytest.mark.parametrize("how", ["stop", "detach"])
async def test_what_the_new_primary_knows_and_its_home_does_not_is_not_done_twice(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """The primary dies when the backup has its state, and nobody its outcomes; then a state is saved or moved."""
    ref = await protected(system, recovery=hf.hybrid())
    group, dropped = group_of(ref), list[Any]()
    real, above = group.take_done, system.ref("/app", hf.Supervisor)

    def take_done(done: Any) -> None:
        if dropped or not any(end.status == "ok" for end in done.ends):
            real(done)
            return
        dropped.append(done)  # As if it were still in the pipe when its sender dies.
        kill(system, ref)

    async def leave() -> None:
        if how == "stop":
            await above.ask(hf.TerminateChild("alice"), SECONDS)
            await above.ask(hf.RestartChild("alice"), SECONDS)
        else:
            async with system.transaction(timeout=SECONDS) as change:
                change.protect(ref, None)

    made = at_step(ref, "lead", lambda: asyncio.create_task(leave(), context=contextvars.Context()))
    monkeypatch.setattr(group, "take_done", take_done)
    asked = [ref.ask(Add(tag), timeout=SECONDS) for tag in range(5)]
    replies = await asyncio.gather(*asked, return_exceptions=True)
    await made[0]
    assert dropped
    there = system.ref(ALICE, Counter)
    tags = await there.ask(Tags())
    assert len(tags) == len(set(tags))
    answered = [tag for tag, reply in enumerate(replies) if isinstance(reply, int)]
    assert set(answered) <= set(tags)
    assert answered, replies
    if how == "detach":
        assert (answered, tags) == (list(range(5)), list(range(5)))


async def test_a_life_that_ends_in_the_middle_of_a_failover_is_its_supervisors(system: hf.ActorSystem) -> None:
    """The last replica dies too: repair has to wait until the supervisor is done, and may act then."""
    ref = await protected(system, recovery=hf.hybrid(), backoff=hf.Backoff(initial=0.3, maximum=0.3, jitter=0.0))
    load, judge = Load(ref), arbiter_of(system._node)
    await load.reached(10)
    backup = other(group_of(ref))
    at_step(ref, "lead", lambda: kill(system, ref, backup))
    kill(system, ref)
    hands = set[str]()
    async with asyncio.timeout(SECONDS):
        while ref._cell.life == 1:
            try:
                judge.release(judge.claim(ALICE, Hand.REPAIR, "me too"))
            except InOtherHands as busy:
                hands.add(busy.hand)
            await asyncio.sleep(0.005)
    assert "its supervisor" in hands
    await load.reached(20)
    await two_again(ref)
    judge.release(judge.claim(ALICE, Hand.REPAIR, "me too"))
    await load.stop()
    load.check(await ref.ask(Tags()))
