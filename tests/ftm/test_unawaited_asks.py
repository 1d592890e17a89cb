"""An ask for whose answer its turn does not wait leaves once, whoever dies, and is no difference between two runs."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.nvp import NVP
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tmr import TMR
from tests.ftm.replicated import Add, Fetch, Say, Total, pair
from tests.ftm.test_lfr import settled


class Walk(hf.Message[int]):
    """Ask somebody without waiting for the answer, then ask `n` times and wait for that, then wait for the loop."""

    n: int


class Trip(hf.Message[int]):
    """Ask somebody without waiting for the answer, and fail."""


class Stumble(hf.Message[int]):
    """Ask for this, wait for the answer, and fail."""

    n: int


class Walker(Total):
    @hf.on(Say)
    def say(self, message: Say) -> int:
        self.other.ask(Add(message.n))
        self.seen.append(message.n)
        return sum(self.seen)

    @hf.on(Walk)
    async def walk(self, message: Walk) -> int:
        self.other.ask(Add(-1))
        for n in range(message.n):
            self.seen.append(await self.other.ask(Add(n)))
        for _ in range(10):
            await asyncio.sleep(0)
        return len(self.seen)

    @hf.on(Trip)
    def trip(self, message: Trip) -> int:
        self.other.ask(Add(-1))
        raise RuntimeError("over a root")

    @hf.on(Stumble)
    async def stumble(self, message: Stumble) -> int:
        await self.other.ask(Add(message.n))
        raise RuntimeError(f"no {message.n}")


class WalkerSecond(Walker):
    """Another version of it."""


class Curious(Walker):
    """A version that asks what the others do not ask."""

    @hf.on(Walk)
    async def walk(self, message: Walk) -> int:
        return await self.other.ask(Add(1000 + message.n))


NVP_OF_WALKERS = NVP(versions=(WalkerSecond, Walker))


def only_waited_for(driver: Any) -> None:
    """Nobody answers what nobody waits for."""
    answer = driver.outside
    driver.outside = lambda out: None if driver.system._node.codec.decode(Add, out.body).n < 0 else answer(out)


@pytest.mark.parametrize("mechanism", [PBR(), LFR(), TMR()], ids=["pbr", "lfr", "tmr"])
async def test_it_leaves_though_all_that_the_dead_leader_has_said_of_its_turn_is_lost(
    system: hf.ActorSystem, mechanism: Any
) -> None:
    others = ("r2", "r3") if isinstance(mechanism, TMR) else ("r2",)
    driver = await pair(system, Walker, mechanism, others=others)
    async with asyncio.timeout(10):
        while driver.out_now is not None:
            await asyncio.sleep(0.001)
    take, driver.take = driver.take, lambda done: None  # type: ignore[method-assign]
    driver.out = lambda outward: None  # type: ignore[method-assign]
    (key,) = driver.send(Say(7))
    turn = driver.order[-1].turn + 1
    async with asyncio.timeout(10):
        while driver.standing("r2").log.find(key) is None:
            await asyncio.sleep(0.001)
    await driver.stop_replica("r1")
    driver.take = take  # type: ignore[method-assign]
    del driver.out
    await driver.fail_over("r2")
    assert await driver.reply(key) == 7
    assert [out.verb for at, out in driver.released.items() if at[0] == turn] == ["ask"]


@pytest.mark.parametrize("count", [0, 2])
@pytest.mark.parametrize("others", [(), ("r2",), ("r2", "r3")], ids=["nvp", "tmr, one gone", "tmr"])
async def test_its_turn_comes_to_the_same_in_each_run(
    system: hf.ActorSystem, others: tuple[str, ...], count: int
) -> None:
    """Also where it waits for something else: for another ask, or for the loop."""
    driver = await pair(system, Walker, TMR() if others else NVP_OF_WALKERS, others=others)
    only_waited_for(driver)
    with system.events() as events:
        assert await driver.ask(Say(1)) == 1
        assert await driver.ask(Walk(count)) == 1 + count
        assert await driver.ask(Add(1)) >= 2
        masked = [one for one in events.take() if isinstance(one, (hf.events.Masked, hf.events.ReplicaLost))]
    assert masked == []
    assert len(driver.released) == 2 + count


async def test_a_version_that_asks_something_else_is_outvoted_at_once(system: hf.ActorSystem) -> None:
    driver = await pair(system, Walker, NVP(versions=(Curious, Walker), within=3600.0), others=())
    only_waited_for(driver)
    with system.events() as events:
        assert await driver.ask(Walk(0)) == 0
        assert [one for one in events.take() if isinstance(one, hf.events.Masked)] != []


async def test_a_turn_that_fails_behind_it_fails_alike_in_each_run(system: hf.ActorSystem) -> None:
    driver = await pair(system, Walker, NVP_OF_WALKERS, others=())
    only_waited_for(driver)
    with pytest.raises(hf.RemoteCrash):
        await driver.ask(Trip())
    assert await driver.ask(Add(1)) == 1


async def test_where_a_turn_stood_when_it_raised_is_no_difference(system: hf.ActorSystem) -> None:
    """The follower has the outcome of the ask before it has the request: its turn does not wait for it."""
    driver = await pair(system, Walker, LFR())
    before = system._node.cell_at(driver.path("r2") + "/before").ref
    with system.events() as events:
        await system.suspend(before)
        (key,) = driver.send(Stumble(3))
        async with asyncio.timeout(10):
            while not driver.standing("r2").server.traces.heard:
                await asyncio.sleep(0.001)
        await system.resume(before)
        with pytest.raises(hf.RemoteCrash):
            await driver.reply(key)
        assert await driver.ask(Fetch(1)) == 1
        await settled(driver, "r2", driver.order[-1].turn)
        assert [one for one in events.take() if isinstance(one, Diverged)] == []
