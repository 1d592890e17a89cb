"""A replica that is gone, one that catches up for long, and a group that nobody leads are named."""

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.literals import caught_up, led, whole
from holdfast.diagnosis.model import ModelError, System
from holdfast.diagnosis.model_follower import Reach
from holdfast.diagnosis.planning import Step
from holdfast.diagnosis.repair import Act, ActionFailed, restart_replica
from holdfast.testing import advance
from tests.ftm.test_failover import pid_of

LONG = pytest.mark.skipif(
    "HOLDFAST_REPAIRS" not in os.environ, reason="a campaign: HOLDFAST_REPAIRS=25 has all of them"
)
MECHANISMS = {"PBR": hf.ftm.PBR, "LFR": hf.ftm.LFR, "TMR": hf.ftm.TMR}


class Add(hf.Message[int]): ...


class Counter(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.count += 1
        return self.count


async def until(watching: diagnosis.Watch, *certain: str) -> None:
    """Wait until just these are faulty for certain; none: until nobody is suspected."""
    async with asyncio.timeout(60.0):
        while True:
            found = await watching.diagnosis()
            if found.certain == certain and (found.state is State.FAULTY) == bool(certain):
                return
            await asyncio.sleep(0.05)


async def strike(system: hf.ActorSystem, alice: hf.ActorRef[Counter], name: str) -> None:
    """Kill a replica whenever it has come up."""
    while True:
        with contextlib.suppress(KeyError, ProcessLookupError):  # It is not there at the moment.
            os.kill(pid_of(system, alice, name), signal.SIGKILL)
        await asyncio.sleep(0.02)


async def told(watching: diagnosis.Watch) -> list[str]:
    """What repair has told of its cases."""
    return [entry.text for story in await watching.stories() for entry in story.entries]


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("mechanism", ["PBR", *(pytest.param(other, marks=LONG) for other in ("LFR", "TMR"))])
async def test_a_replica_that_does_not_come_back_is_named_and_the_actor_is_not(mechanism: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        alice = await system.start(hf.child("alice", hf.start(Counter), mechanism=MECHANISMS[mechanism]()))
        watching = await diagnosis.watch(system, seconds=0.1, repair="on")
        await until(watching)
        last = sorted((await system.protection(alice)).replicas)[-1]
        striking = asyncio.create_task(strike(system, alice, last))
        await until(watching, "alice.replicas")
        observed = await watching.observed()
        assert whole("alice") in observed.negative
        assert led("alice") in observed.positive
        assert await alice.ask(Add(), timeout=20.0) == 1
        async with asyncio.timeout(60.0):
            while not any("restart_replica(alice.replicas)" in text for text in await told(watching)):
                await asyncio.sleep(0.05)
        striking.cancel()
        await asyncio.wait((striking,))
        await until(watching)
        assert (await system.get_status(alice)).life == 1


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_an_actor_called_like_the_replicas_of_another_one_is_told_apart() -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        alice = await system.start(hf.child("alice", hf.start(Counter), mechanism=hf.ftm.PBR()))
        other = await system.start(hf.child("alice.replicas", hf.start(Counter)))
        watching = await diagnosis.watch(system, seconds=0.1)
        assert watching.addresses == {"alice": alice.path, "alice%2Ereplicas": other.path}
        await until(watching)
        assert set((await watching.diagnosis()).components) == {"alice", "alice.replicas", "alice%2Ereplicas"}
        await system.ref("/app", hf.Supervisor).ask(hf.TerminateChild("alice.replicas"))
        await until(watching, "alice%2Ereplicas")
        observed = await watching.observed()
        assert whole("alice") not in observed.negative


class Repairing(hf.Actor):
    """Has a context, as those who repair have."""


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_only_replicas_that_neither_lead_nor_follow_are_begun_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        alice = await system.start(hf.child("alice", hf.start(Counter), mechanism=hf.ftm.PBR()))
        await system.ref("/app/alice/ftm", hf.Supervisor).ask(hf.WhichChildren())
        actor = (await system.start(hf.child("repairing", hf.start(Repairing))))._cell.actor
        assert actor is not None
        act = Act(Step("restart_replica", ("alice.replicas",)), 1, "a test", actor.ctx, lambda: None)
        begin_anew = restart_replica({"alice.replicas": alice.path})
        async with asyncio.timeout(60.0):
            while not (await system.protection(alice)).is_whole:
                await asyncio.sleep(0.02)
            with pytest.raises(ActionFailed, match="no replica that neither leads nor follows"):
                await begin_anew(act, "alice.replicas")
            before = {name: pid_of(system, alice, name) for name in ("r1", "r2")}
            with monkeypatch.context() as patched:
                patched.setattr(alice._cell.host.place, "replica_states", lambda: {"r1": "leads", "r2": "joining"})
                await begin_anew(act, "alice.replicas")
            while not (await system.protection(alice)).is_whole:
                await asyncio.sleep(0.02)
        assert pid_of(system, alice, "r1") == before["r1"]
        assert pid_of(system, alice, "r2") != before["r2"]


@pytest.fixture
async def pretended(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[tuple[diagnosis.Watch, dict[str, str]]]:
    """An actor that says to have replicas, how they do, and diagnosis of it; nothing else could hold them so long."""
    async with hf.ActorSystem("app", log=False, seed=1) as system:
        alice = await system.start(hf.child("alice", hf.start(Counter)))
        states = {"r1": "leads", "r2": "follows", "r3": "follows"}
        monkeypatch.setattr(type(alice._cell.host.place), "replica_states", lambda place: states)
        yield await diagnosis.watch(system, seconds=0.1), states


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_catching_up_may_take_its_time_and_four_times_as_long_as_ever(
    pretended: tuple[diagnosis.Watch, dict[str, str]],
) -> None:
    watching, states = pretended
    states["r2"] = "joining"
    await advance(25.0)
    assert (await watching.diagnosis()).state is State.HEALTHY
    states["r2"] = "follows"
    await advance(5.0)
    states["r3"] = "joining"
    await advance(80.0)
    assert (await watching.diagnosis()).state is State.HEALTHY
    await advance(30.0)
    assert (await watching.diagnosis()).certain == ("alice.replicas",)
    assert caught_up("alice") in (await watching.observed()).negative


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_replica_that_loses_life_after_life_is_missed_before_long(
    pretended: tuple[diagnosis.Watch, dict[str, str]],
) -> None:
    watching, states = pretended
    await advance(5.0)
    for _ in range(4):
        states["r2"] = "down"
        await advance(0.5)
        states["r2"] = "joining"
        await advance(0.5)
    await advance(1.0)
    assert (await watching.diagnosis()).certain == ("alice.replicas",)
    assert whole("alice") in (await watching.observed()).negative


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_nobody_leads_and_nobody_takes_over(pretended: tuple[diagnosis.Watch, dict[str, str]]) -> None:
    watching, states = pretended
    await advance(5.0)
    states["r1"] = "silent"
    await advance(3.0)
    states["r2"] = "leads"  # A failover that takes its time.
    await advance(2.0)
    assert led("alice") in (await watching.observed()).positive
    states |= {"r1": "follows", "r2": "silent", "r3": "silent"}
    await advance(8.0)
    assert set((await watching.diagnosis()).certain) == {"alice"}
    assert led("alice") in (await watching.observed()).negative
    states.clear()  # All of it is gone, and nobody begins it anew.
    await advance(4.0)
    assert (await watching.diagnosis()).certain == ("alice",)
    states["r1"] = "leads"
    await advance(8.0)
    assert (await watching.diagnosis()).state is State.HEALTHY


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_component_of_ones_own_called_like_the_replicas_of_a_protected_actor_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = System()
    model.node("alice")
    model.node("alice.replicas")
    async with hf.ActorSystem("app", log=False, seed=1) as system:
        alice = await system.start(hf.child("alice", hf.start(Counter)))
        await diagnosis.watch(system, model, addresses={"alice": alice.path}, name="unprotected")
        monkeypatch.setattr(type(alice._cell.host.place), "replica_states", lambda place: {"r1": "leads"})
        with pytest.raises(ModelError, match=r"alice\.replicas: this name stands for the replicas of a protected"):
            await diagnosis.watch(system, model, addresses={"alice": alice.path})


def test_repair_takes_nobody_for_replicas_who_is_an_actor_itself() -> None:
    reach = Reach("/app", {})
    reach.use({"alice": "/app/alice", "alice.replicas": "/app/double"})
    assert reach.groups == {"alice.replicas.replicas": "/app/double"}
