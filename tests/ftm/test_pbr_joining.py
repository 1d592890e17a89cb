"""Passive replication: how a backup comes to its state, and what must be there before it counts."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.protocol import Outcome, came
from holdfast.ftm.bricks.brick_messages import CannotJoin
from holdfast.ftm.bricks.replica_orders import Export, Install, SetPeer
from tests.ftm.replicated import Add, Fetch, Read, Total, pair


class Unwilling(Total):
    """Comes back from nothing."""

    def on_start(self, restored: bool) -> None:
        if restored:
            raise RuntimeError("not again")


async def test_a_backup_whose_life_cannot_begin_says_so_when_it_is_to_lead(system: hf.ActorSystem) -> None:
    driver = await pair(system, Unwilling)
    await driver.ask(Add(1))
    gone = system._node.cell_at(driver.path("r2")).ended()
    await driver.stop_replica("r1")
    with pytest.raises((hf.RemoteCrash, hf.ActorStopped, hf.AskFailed)):
        await driver.lead("r2")
    async with asyncio.timeout(5):
        await gone


async def test_a_first_state_that_cannot_be_taken_up_ends_the_replica(system: hf.ActorSystem) -> None:
    first = await pair(system, Unwilling)
    await first.ask(Add(1))
    exported = await first.protocol("r1").ask(Export(first.epoch))
    await first.add("r3")
    gone = system._node.cell_at(first.path("r3")).ended()
    await first.protocol("r3").ask(Install(first.epoch + 1, exported.turn, exported.data, [], True, []))
    with pytest.raises((hf.RemoteCrash, hf.ActorStopped, hf.AskFailed)):
        await first.lead("r3")
    async with asyncio.timeout(5):
        await gone


async def test_a_backup_that_follows_anew_gets_the_state_anew(system: hf.ActorSystem) -> None:
    """Whoever has it join may die before it hears of that; the next one begins from the beginning."""
    driver = await pair(system)
    assert await driver.ask(Add(1)) == 1
    await driver.join("r2")
    assert await driver.ask(Add(2)) == 3, "the primary waits for a backup that waits for its state"
    assert driver.standing("r2").following.is_ready
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 2]


async def test_a_backup_that_lives_anew_at_its_address_gets_the_state(system: hf.ActorSystem) -> None:
    """The primary has not heard of its death: to it, the address counts."""
    driver = await pair(system)
    assert await driver.ask(Add(1)) == 1
    await driver.stop_replica("r2")
    await driver.add("r2")
    (key,) = driver.send(Add(2))
    await driver.join("r2")
    assert await driver.reply(key) == 3
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 2]


async def test_a_join_that_was_given_up_before_it_began_is_not_begun(system: hf.ActorSystem) -> None:
    """The one that was to join has died meanwhile, and its next life has not been told yet that it follows."""
    driver = await pair(system, others=())
    await driver.add("r2")
    answer, driver.outside = driver.outside, lambda out: None
    (key,) = driver.send(Fetch(5))
    async with asyncio.timeout(5):
        while driver.partial != key:
            await asyncio.sleep(0.001)
    joining = asyncio.ensure_future(driver.join("r2"))
    async with asyncio.timeout(5):
        while not driver.brick("r1", "protocol")._holds:  # It waits for the end of that turn.
            await asyncio.sleep(0.001)
    await driver.stop_replica("r2")
    await driver.protocol("r1").ask(SetPeer(driver.epoch, None))
    await driver.add("r2")
    driver.outside = answer
    for (turn, k), out in driver.released.items():
        driver.inward(Outcome(turn, k, came(answer(out))))
    async with asyncio.timeout(5):
        with pytest.raises(CannotJoin, match="it was given up meanwhile"):
            await joining
    assert await driver.reply(key)
    await driver.join("r2")
    assert driver.standing("r2").server.turn == driver.order[-1].turn


async def test_a_backup_counts_only_when_it_has_all_that_has_left(system: hf.ActorSystem) -> None:
    """T8c: outcomes that left while it joined wait for nobody; that it has joined waits for them."""
    driver = await pair(system, others=())
    await driver.add("r2")
    stuck = _Stuck(driver, "r1")
    joining = asyncio.ensure_future(driver.join("r2"))
    async with asyncio.timeout(5):
        while driver.standing("r1").other.state == "none":
            await asyncio.sleep(0)
    assert await driver.ask(Add(1)) == 1, "it left without its state"
    async with asyncio.timeout(5):
        while driver.standing("r1").other.state != "live":
            await asyncio.sleep(0.001)
    await asyncio.sleep(0.02)
    assert not joining.done(), "what has left is not there yet"
    stuck.go_on()
    await joining
    assert driver.standing("r2").server.turn == driver.order[-1].turn


async def test_an_outcome_whose_checkpoint_is_overtaken_is_known_to_the_backup(system: hf.ActorSystem) -> None:
    """T5: a state says that a turn was; the log that comes with it must say what came of the turn.

    The reply of a turn that left while the backup joined is lost with the primary.
    """
    driver = await pair(system, others=())
    await driver.add("r2")
    stuck = _Stuck(driver, "r1")
    joining = asyncio.ensure_future(driver.join("r2"))
    async with asyncio.timeout(5):
        while driver.standing("r1").other.state == "none":
            await asyncio.sleep(0)
    real, lost = driver.take, list[Any]()
    driver.take = lost.append  # type: ignore[method-assign,assignment]  # the replies are lost on their way
    (first,) = driver.send(Add(1))
    async with asyncio.timeout(5):
        while not lost:
            await asyncio.sleep(0.001)
    while driver.standing("r1").other.state != "live":
        await asyncio.sleep(0.001)
    stuck.only_first = True
    driver.out_now = None
    (second,) = driver.send(Add(2))
    async with asyncio.timeout(5):
        while driver.standing("r2").server.turn < 2:
            await asyncio.sleep(0.001)
    await driver.stop_replica("r1")
    joining.cancel()
    driver.take = real  # type: ignore[method-assign]
    await driver.fail_over("r2")
    assert [await driver.reply(first), await driver.reply(second)] == [1, 3]
    assert await driver.ask(Read()) == [1, 2]


class _Stuck:
    """Checkpoints of a primary that take their time."""

    def __init__(self, driver: Any, name: str) -> None:
        self._after = driver.brick(name, "after")
        self._real = self._after.ask_peer
        self._open = asyncio.get_running_loop().create_future()
        self.only_first = False
        self._after.ask_peer = self._ask

    async def _ask(self, message: Any) -> Any:
        if not self.only_first:
            await self._open
        return await self._real(message)

    def go_on(self) -> None:
        self._open.set_result(None)
