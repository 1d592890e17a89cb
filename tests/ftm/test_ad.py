"""Assertion and duplex: what an assertion refuses is computed by the other replica."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged, Objected
from holdfast.ftm.bricks.replica_orders import SetPeer
from holdfast.ftm.mechanisms.ad import AD
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.model.mechanism import MechanismRefused, find, load, revive
from holdfast.ftm.votes.assertions import AssertionFailed
from tests.ftm import versions
from tests.ftm.accounts import Account, Bank, Counter, Load, Put, Tags, Transfer
from tests.ftm.replicated import Add, Closed, Fail, Fetch, Read, Say, Total, pair
from tests.ftm.test_failover import group_of, pid_of, two_again
from tests.ftm.versions import FAULTY

AUDIT = Path(__file__).parents[2] / "examples" / "mechanisms" / "audit_trail.py"

CHECKS: Any = (versions.is_positive, versions.has_no_holes, versions.keeps_its_word)


async def settled(driver: Any, name: str, turn: int) -> None:
    async with asyncio.timeout(5):
        while driver.standing(name).server.turn < turn:
            await asyncio.sleep(0.001)


@pytest.mark.pairs
@pytest.mark.parametrize("below", [PBR(), LFR()])
@pytest.mark.parametrize("always", [False, True])
@pytest.mark.parametrize("what", ["answer", "state", "message"])
async def test_value_faults_of_the_one_that_leads_are_masked(
    system: hf.ActorSystem, below: Any, always: bool, what: str
) -> None:
    """Transient and permanent ones; what is right is in the state of both afterwards (A39)."""
    driver = await pair(system, Total, AD(CHECKS), below, FAULTY(what=what, always=always, skip=1))
    with system.events() as events:
        keys = driver.send(Add(1), Add(2), Fetch(3), Add(4), Say(5))
        keys += driver.send(Add(6), Add(7))
        assert [await driver.reply(key) for key in keys] == [1, 3, 6, 10, 15, 21, 28]
        told = events.take()
    objected = [one for one in told if isinstance(one, Objected)]
    assert objected
    assert {one.by for one in objected} == {driver.path("r2")}
    assert [one for one in told if isinstance(one, Diverged)] == []
    expected = [1, 2, -3, 6, 4, 5, 6, 7]
    await settled(driver, "r2", driver.ends[keys[-1]].turn)
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == expected
    assert await driver.ask(Add(1)) == 29
    assert sorted(out.verb for out in driver.released.values()) == ["ask", "tell"]


@pytest.mark.parametrize("always", [False, True])
async def test_value_faults_of_the_follower_do_not_take_it_off_course(system: hf.ActorSystem, always: bool) -> None:
    faulty = FAULTY(what="state", always=always, replica="r2")
    driver = await pair(system, Total, AD(CHECKS), LFR(), faulty)
    keys = driver.send(Add(1), Add(2))
    assert await driver.reply(keys[1]) == 3
    keys = driver.send(Add(3))
    assert await driver.reply(keys[0]) == 6
    await settled(driver, "r2", driver.ends[keys[0]].turn)
    async with asyncio.timeout(5):
        while (follower := driver.server("r2")) is None or follower.seen != [1, 2, 3]:  # It may be between two lives.
            await asyncio.sleep(0.001)
    assert driver.server("r1").seen == [1, 2, 3]


@pytest.mark.parametrize("below", [PBR(), LFR()])
async def test_what_is_wrong_on_both_fails_and_changes_nothing(system: hf.ActorSystem, below: Any) -> None:
    """A development fault: it is not claimed, and it is seen."""
    driver = await pair(system, versions.BadAtThirteen, AD(versions.is_positive), below)
    keys = driver.send(Add(1), Add(13), Add(2), Add(13), Add(3))
    for key in (keys[1], keys[3]):
        with pytest.raises(AssertionFailed, match=r"here: .*is_positive does not hold; there: .*does not hold"):
            await driver.reply(key)
    assert [await driver.reply(keys[at]) for at in (0, 2, 4)] == [1, 3, 6]
    await settled(driver, "r2", driver.ends[keys[4]].turn)
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 2, 3]


@pytest.mark.parametrize("below", [PBR(), LFR()])
async def test_a_crash_that_is_alike_on_both_is_the_outcome(system: hf.ActorSystem, below: Any) -> None:
    driver = await pair(system, Total, AD(versions.is_positive), below)
    keys = driver.send(Add(1), Fail(2), Add(3))
    with pytest.raises(hf.RemoteCrash, match="no 2"):
        await driver.reply(keys[1])
    assert await driver.reply(keys[2]) == 4
    assert await driver.ask(Read()) == [1, 3]


async def test_alone_it_fails_what_it_cannot_mask(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, AD(CHECKS), PBR(), FAULTY(always=True, skip=1))
    assert await driver.ask(Add(1)) == 1
    await driver.stop_replica("r2")
    await driver.protocol("r1").ask(SetPeer(driver.epoch, None))
    with pytest.raises(AssertionFailed, match="there is no other replica"):
        await driver.ask(Add(2))
    assert await driver.ask(Read()) == [1]


async def test_over_time_redundancy_too(system: hf.ActorSystem) -> None:
    """TR masks what is transient, A&D what is not, PBR the crash."""
    faulty = FAULTY(what="state", always=True, skip=3)
    driver = await pair(system, Total, AD(CHECKS), PBR(), TR(), faulty)
    keys = driver.send(Add(1), Add(2), Add(3), Add(4))
    assert [await driver.reply(key) for key in keys] == [1, 3, 6, 10]
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Add(5)) == 15
    assert await driver.ask(Read()) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("below", [PBR(), LFR()])
async def test_in_processes_of_their_own_with_kills_meanwhile(system: hf.ActorSystem, below: Any) -> None:
    """A permanent value fault in r1, whose process is killed while it leads and while it follows."""
    layers = AD(versions.tags_are_known), below, FAULTY(what="state", always=True, skip=5)
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=layers))
    await two_again(ref)
    load = Load(ref, clients=3)
    try:
        with system.events() as events:
            await load.reached(20)
            for _ in range(2):
                os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
                await load.reached(20)
                await two_again(ref)
                await load.reached(20)
            assert any(one.by for one in events.take() if isinstance(one, Objected))
    finally:
        await load.stop()
    assert group_of(ref).failovers == 1
    load.check(await ref.ask(Tags()))


def test_what_cannot_work_is_refused_with_the_reason() -> None:
    AD(CHECKS).check(Total)
    with pytest.raises(MechanismRefused, match="state_access = False"):
        AD(CHECKS).check(Closed)
    with pytest.raises(MechanismRefused, match="it may take reply, message and state"):
        AD(versions.odd_name).check(Total)
    with pytest.raises(ValueError, match="at least one"):
        AD()
    with pytest.raises(ValueError, match="write stands in a file that replicas cannot import"):
        AD(sys.modules[load(AUDIT).__module__].write)
    assert revive(AD(CHECKS).describe()) == AD(CHECKS)
    assert find("ad") is AD


async def test_an_ask_in_a_turn_does_not_overtake_the_outcome_that_the_other_replica_computes(
    system: hf.ActorSystem,
) -> None:
    """The turn behind it waits until the home has it, also when the actor went on from the other one's state."""
    accounts = [await system.start(hf.child(name, hf.start(Account, 1000))) for name in ("one", "two")]
    layers = hf.ftm.compose(AD((versions.is_positive,)), PBR(), FAULTY(what="answer", always=True, skip=5))
    bindings: dict[str, str] = dict(zip(("one", "other"), (one.path for one in accounts), strict=True))
    with system.events() as events:
        bank = await system.start(hf.child("bank", hf.start(Bank), mechanism=layers, bindings=bindings))
        load = Load(bank, clients=6, make=Transfer)
        await load.reached(30)
        await load.stop()
        seen = events.take()
    tags = await bank.ask(Tags())
    load.check(tags)
    assert [await one.ask(Put(0)) for one in accounts] == [1000 - len(tags), 1000 + len(tags)]
    assert len([one for one in seen if isinstance(one, Objected)]) >= 10
    assert not [one for one in seen if type(one).__name__ == "RecoveryFailed"]
