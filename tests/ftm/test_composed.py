"""Compositions, with value faults struck into one replica and processes killed: no counter is wrong or doubled."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged, Masked
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.nvp import NVP
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.rb import RB
from holdfast.ftm.mechanisms.tr import TR
from tests.ftm import versions
from tests.ftm.accounts import Add as Count
from tests.ftm.accounts import Counter, Load, Tags
from tests.ftm.replicated import Add, Read, Total, pair
from tests.ftm.test_failover import pid_of, two_again
from tests.ftm.versions import FAULTY

REPEATED: Any = [
    TR(),
    NVP((versions.SameCounter, versions.OtherCounter)),
    RB(alternates=versions.OtherCounter, test=versions.tags_are_known),
]


@pytest.mark.parametrize("outer", [PBR(), LFR()])
@pytest.mark.parametrize("inner", REPEATED, ids=lambda one: one.name)
async def test_a_transient_fault_and_crashes_are_both_masked(system: hf.ActorSystem, outer: Any, inner: Any) -> None:
    """A65: with a fault in r1's 12th turn, and kills of the one that leads and of the other."""
    layers = outer, inner, FAULTY(what="state", skip=11)
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=layers))
    await two_again(ref)
    load = Load(ref, clients=3)
    try:
        await load.reached(30)
        for name in ("r1", "r2"):
            os.kill(pid_of(system, ref, name), signal.SIGKILL)
            await load.reached(20)
            await two_again(ref)
            await load.reached(20)
    finally:
        await load.stop()
    load.check(await ref.ask(Tags()))


async def test_one_that_begins_afresh_is_computed_twice_from_its_first_turn(system: hf.ActorSystem) -> None:
    """Its turns are counted on, and there is no state to go with that number: neither behind a stop nor a crash."""
    spec = hf.child("alice", hf.start(Counter), mechanism=(PBR(), TR()))
    ref = await system.start(spec)
    assert await ref.ask(Count(0)) == 1
    await system.stop(ref)
    ref = await system.start(spec)
    assert await ref.ask(Count(0)) == 1
    await system.terminate(ref, hf.Crash("ValueError", "boom"))
    assert await ref.ask(Count(0), timeout=60) == 1


@pytest.mark.parametrize("what", ["answer", "state"])
async def test_leader_follower_alone_sees_a_value_fault_and_cannot_mask_it(system: hf.ActorSystem, what: str) -> None:
    """It is not claimed, and told."""
    driver = await pair(system, Total, LFR(), FAULTY(what=what, skip=1, replica="r2"))
    with system.events() as events:
        assert await driver.ask(Add(1)) == 1
        assert await driver.ask(Add(2)) == 3
        assert await driver.ask(Add(3)) == 6
        await system._node.settled()
        told = events.take()
    assert [one.turn for one in told if isinstance(one, Diverged)][:1] == [2 if what == "answer" else 3]


@pytest.mark.parametrize("what", ["answer", "state"])
async def test_time_redundancy_within_leader_follower_masks_it_on_the_follower(
    system: hf.ActorSystem, what: str
) -> None:
    driver = await pair(system, Total, LFR(), TR(), FAULTY(what=what, skip=1, replica="r2"))
    with system.events() as events:
        assert await driver.ask(Add(1)) == 1
        assert await driver.ask(Add(2)) == 3
        assert await driver.ask(Add(3)) == 6
        await driver.stop_replica("r1")
        await driver.fail_over("r2")
        assert await driver.ask(Read()) == [1, 2, 3]
        told = events.take()
    assert [one for one in told if isinstance(one, Diverged)] == []
    assert any(isinstance(one, Masked) for one in told)
