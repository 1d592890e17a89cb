"""Leader-follower replication: both compute, one answers, and what differs is found."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged
from holdfast.ftm.bricks.brick_messages import CannotJoin, CannotLead
from holdfast.ftm.bricks.replica_orders import SetPeer
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.model.mechanism import MechanismRefused
from tests.ftm.replicated import Add, Back, Closed, Fail, Fetch, Guess, Put, Read, Say, Total, kills_of_two, pair
from tests.ftm.versions import FAULTY


async def settled(driver: Any, name: str, turn: int) -> None:
    async with asyncio.timeout(5):
        while driver.standing(name).server.turn < turn:
            await asyncio.sleep(0.001)


@pytest.mark.parametrize("kind", [Total, Closed])
async def test_the_follower_computes_the_same_and_can_lead(system: hf.ActorSystem, kind: Any) -> None:
    """A37."""
    driver = await pair(system, kind, LFR())
    keys = driver.send(Add(1), Fetch(2), Add(3), Say(4))
    assert [await driver.reply(key) for key in keys] == [1, 3, 6, 10]
    assert sorted(out.verb for out in driver.released.values()) == ["ask", "tell"]
    await settled(driver, "r2", 4)
    assert driver.server("r2").seen == driver.server("r1").seen
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Fetch(5)) == 15
    assert await driver.ask(Read()) == [1, -2, 4, 3, 4, -5, 10]


async def test_a_turn_that_fails_fails_on_both(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, LFR())
    with system.events() as events:
        keys = driver.send(Add(1), Fail(2), Add(3), Put(4), Back())
        assert await driver.reply(keys[3]) == 8
        await settled(driver, "r2", driver.ends[keys[3]].turn)
        assert [one for one in events.take() if isinstance(one, Diverged)] == []
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 3, 4]


async def test_an_ask_that_is_out_is_joined_by_the_next_leader(system: hf.ActorSystem) -> None:
    driver = await pair(system, Closed, LFR())
    answer, driver.outside = driver.outside, lambda out: None
    (first, second) = driver.send(Add(1), Fetch(2))
    async with asyncio.timeout(5):
        while not driver.released:
            await asyncio.sleep(0.001)
    await settled(driver, "r2", 2)
    await driver.stop_replica("r1")
    driver.outside = answer
    await driver.fail_over("r2")
    assert await driver.reply(second) == 3
    assert first in driver.ends
    assert await driver.ask(Read()) == [1, -2, 4]


async def test_a_reply_leaves_only_when_the_follower_has_the_request(system: hf.ActorSystem) -> None:
    """A36."""
    driver = await pair(system, Total, LFR())
    before = system._node.cell_at(driver.path("r2") + "/lfr.before").ref
    before = system._node.cell_at(driver.path("r2") + "/before").ref
    await system.suspend(before)
    (key,) = driver.send(Add(1))
    await asyncio.sleep(0.05)
    assert key not in driver.ends
    await system.resume(before)
    assert await driver.reply(key) == 1


class Slow(Total):
    """Takes longer than whoever asks waits."""

    @hf.on(Add)
    async def add(self, message: Add) -> int:  # type: ignore[override]
        await asyncio.sleep(1.0)
        self.seen.append(message.n)
        return sum(self.seen)


async def test_what_waits_behind_a_turn_of_its_batch_is_handled_when_its_time_is_over(system: hf.ActorSystem) -> None:
    """Whether the time is over is decided for both replicas, when the batch leaves for the follower."""
    driver = await pair(system, Slow, LFR())
    first, second = driver.send(Add(1), Add(2), deadline=system._node.loop.time() + 1.0)
    assert [await driver.reply(first), await driver.reply(second)] == [1, 3]
    assert await driver.ask(Read()) == [1, 2]


async def test_hidden_nondeterminism_is_told_and_the_follower_takes_the_state(system: hf.ActorSystem) -> None:
    """T8: the first request that came out differently is named."""
    driver = await pair(system, Total, LFR())
    with system.events() as events:
        await driver.ask(Add(1))
        (key,) = driver.send(Guess())
        seen = await driver.reply(key)
        async with asyncio.timeout(5):
            told: list[Diverged] = []
            while not told:
                await asyncio.sleep(0.001)
                told += [one for one in events.take() if isinstance(one, Diverged)]
        assert told[0].request == key
        assert told[0].name.endswith(":Guess")
        async with asyncio.timeout(5):
            while driver.server("r2") is None or driver.server("r2").seen != driver.server("r1").seen:
                await asyncio.sleep(0.001)
        assert await driver.ask(Add(2)) == seen + 2
        await settled(driver, "r2", 3)
        assert [one for one in events.take() if isinstance(one, Diverged)] == []
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Add(3)) == seen + 5


async def test_a_follower_that_cannot_take_the_state_ends(system: hf.ActorSystem) -> None:
    driver = await pair(system, Closed, LFR())
    gone = system._node.cell_at(driver.path("r2")).ended()
    (key,) = driver.send(Guess())
    await driver.reply(key)
    async with asyncio.timeout(5):
        await gone
    await driver.protocol("r1").ask(SetPeer(driver.epoch, None))
    await driver.ask(Add(1))
    await driver.add("r2")
    with pytest.raises(CannotJoin):
        await driver.join("r2")


async def test_time_redundancy_on_both(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, LFR(), TR())
    keys = driver.send(Add(1), Fetch(2), Fail(3), Add(4))
    assert await driver.reply(keys[3]) == 7
    await settled(driver, "r2", 4)
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, -2, 4, 4]


def test_it_is_refused_for_what_says_that_it_is_not_deterministic() -> None:
    class Random(Total):
        deterministic = False

    with pytest.raises(MechanismRefused, match="deterministic = False"):
        LFR().check(Random)
    LFR().check(Closed)


@pytest.mark.parametrize("seed", range(6))
async def test_kills_at_any_moment_lose_and_double_nothing(system: hf.ActorSystem, seed: int) -> None:
    await kills_of_two(await pair(system, Total, LFR()), system, random.Random(seed))


@pytest.mark.parametrize("what", ["answer", "state"])
async def test_a_follower_that_is_wrong_each_time_holds_nobody_up(system: hf.ActorSystem, what: str) -> None:
    """It joins again each time, and diverges again; no reply waits for it."""
    driver = await pair(system, Total, LFR(), FAULTY(what=what, always=True, replica="r2"))
    expected = 0
    with system.events() as events:
        for n in range(60):
            expected += n
            assert await driver.ask(Add(n)) == expected
        assert sum(isinstance(one, Diverged) for one in events.take()) > 1
    assert await driver.ask(Read()) == list(range(60))


async def test_a_follower_that_has_diverged_does_not_lead(system: hf.ActorSystem) -> None:
    """Its state is not the leader's: better nobody leads than it."""
    driver = await pair(system, Total, LFR(), FAULTY(what="answer", replica="r2"))
    driver.holds_strays = True
    with system.events() as events:
        assert await driver.ask(Add(1)) == 1
        async with asyncio.timeout(10):
            while not any(isinstance(one, Diverged) for one in events.take()):
                await asyncio.sleep(0.001)
    async with asyncio.timeout(10):
        while driver.standing("r1").other.path is not None:
            await asyncio.sleep(0.001)
    assert await driver.ask(Add(2)) == 3, "no reply counts on it any more"
    await driver.stop_replica("r1")
    with pytest.raises(CannotLead):
        await driver.lead("r2")


async def test_what_was_on_its_way_when_a_state_was_taken_is_not_run_on_top_of_it(system: hf.ActorSystem) -> None:
    """Inner layers take a batch a few steps to Proceed; a state that comes meanwhile has its requests in it."""
    driver = await pair(system, Total, LFR(), TR())
    before = system._node.cell_at(driver.path("r2") + "/tr.before").ref
    await system.suspend(before)
    assert await driver.ask(Add(1)) == 1, "the follower has it, though it has not come to its Proceed"
    await driver.join("r2")
    await system.resume(before)
    assert await driver.ask(Add(2)) == 3
    await settled(driver, "r2", 2)
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 2]
