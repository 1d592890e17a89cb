"""A watch over a running actor: what it has is read from its spec, and it is changed by transactions (A6, A15)."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import FaultClasses, Resources
from holdfast.ftm.model.mechanism import MechanismRefused
from holdfast.ftm.monitoring.adaptations import AdaptationDone, AdaptationFailed
from holdfast.ftm.monitoring.judge import Settings
from holdfast.ftm.monitoring.monitor import MonitoringEngine, Observe, Report
from holdfast.ftm.monitoring.watched import watch_of
from tests.ftm.accounts import Add, Counter
from tests.ftm.versions import is_positive

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

CRASHES = Settings(required=FaultClasses.of("crash"), interval=0.02, confirm=0.0, dwell=0.1, urgent_dwell=0.0)
TWO = Resources(units=2)


async def engine(system: hf.ActorSystem, watch: Any) -> hf.ActorRef[Any]:
    return await system.start(hf.child("monitoring", hf.start(MonitoringEngine, watch)))


async def done(events: Any) -> AdaptationDone:
    async with asyncio.timeout(30):
        async for event in events:
            assert not isinstance(event, AdaptationFailed), event
            if isinstance(event, AdaptationDone):
                return event
    raise AssertionError("the stream has ended")


def stack(ref: hf.ActorRef[Any]) -> Any:
    return ref._cell.spec.mechanism


async def test_what_is_decided_is_done_to_what_the_spec_says(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR(window=3)))
    watch = watch_of(system, ref, CRASHES, resources=TWO, probe=None)
    assert watch.judge.current == ("pbr",)
    with system.events() as events:
        monitor = await engine(system, watch)
        monitor.tell(Observe("mismatch", 3))
        assert (await done(events)).current == ("pbr", "tr")
    assert stack(ref) == (PBR(window=3), hf.ftm.TR())  # What it had keeps its settings.
    async with system.transaction(timeout=30) as change:
        change.protect(ref, (LFR(), hf.ftm.TR()))
    async with asyncio.timeout(30):
        while (await monitor.ask(Report())).current != ("lfr", "tr"):
            await asyncio.sleep(0.01)
    assert await ref.ask(Add(1)) == 1


async def test_what_has_no_mechanism_gets_one_and_loses_it_when_none_is_needed(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    watch = watch_of(system, ref, CRASHES, resources=TWO, probe=None)
    with system.events() as events:
        monitor = await engine(system, watch)
        assert (await done(events)).current == ("pbr",)
        assert stack(ref) == PBR()
        watch.judge.settings = Settings(interval=0.02, confirm=0.0, dwell=0.0, urgent_dwell=0.0, transition_cost=0.0)
        assert (await done(events)).current == ()
    assert stack(ref) is None
    assert (await monitor.ask(Report())).changes == 2
    assert await ref.ask(Add(1)) == 1


async def test_what_is_moved_to_another_supervisor_is_watched_there(system: hf.ActorSystem) -> None:
    child = hf.child("alice", hf.start(Counter), mechanism=PBR())
    await system.start(hf.supervisor("here", children=[child]))
    await system.start(hf.supervisor("there"))
    ref = system.ref("/app/here/alice", Counter)
    watch = watch_of(system, ref, CRASHES, resources=TWO, probe=None)
    with system.events() as events:
        monitor = await engine(system, watch)
        async with system.transaction(timeout=30) as change:
            change.move(ref, "/app/there")
        async with asyncio.timeout(30):
            while watch.address != ref.path:
                await asyncio.sleep(0.01)
        async with system.transaction(timeout=30) as change:
            change.add("/app/here", hf.child("alice", hf.start(Counter)))
            change.protect(ref, LFR())
        async with asyncio.timeout(30):
            while (await monitor.ask(Report())).current != ("lfr",):
                await asyncio.sleep(0.01)
        monitor.tell(Observe("mismatch", 3))
        assert (await done(events)).address == ref.path == "/app/there/alice"
    assert len(stack(ref)) == 2
    assert stack(system.ref("/app/here/alice", Counter)) is None


async def test_what_mechanisms_bring_along_counts(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    asserting = hf.ftm.AD(assertions=(is_positive,))
    watch = watch_of(system, ref, CRASHES, mechanisms=(asserting, "pbr", LFR), known={"rate": 7.0})
    assert watch.judge.application == Application.of(Counter, assertions=1, rate=7.0)
    with pytest.raises(MechanismRefused, match="no mechanism of that name"):
        watch_of(system, ref, CRASHES, mechanisms=("pbr", "nosuch"))
    with pytest.raises(hf.SpecError, match="not supervised"):
        watch_of(system, system.spawn(hf.start(Counter)), CRASHES)


async def test_the_price_decides_between_those_that_are_valid(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    quick = watch_of(system, ref, CRASHES, mechanisms=("lfr",), resources=TWO, price=hf.ftm.response_price)
    assert quick.judge.decide(0.0).target == ("lfr",)
    assert watch_of(system, ref, CRASHES, mechanisms=("lfr",), resources=TWO).judge.decide(0.0).target is None
    with pytest.raises(TypeError, match="such as response_price of holdfast"):
        watch_of(system, ref, CRASHES, price="response")  # type: ignore[arg-type]
