"""Two leaders of three die shortly one after the other: the third one has all that was acknowledged, and leads."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import TurnsLost
from holdfast.ftm.alarms import Outvoted
from holdfast.ftm.bricks.brick_messages import Strayed
from holdfast.ftm.events import FailedOver, ReplicaJoined
from holdfast.ftm.mechanisms.tmr import TMR
from tests.ftm.accounts import Counter, Load, Tags
from tests.ftm.replicated import Add, Fetch, Read, Total, pair
from tests.ftm.versions import FAULTY


class Trio:
    """A protected counter whose three replicas are up, and what has happened to them since."""

    def __init__(self, system: hf.ActorSystem) -> None:
        self.system = system
        self._events = system.events()
        self.seen: list[Any] = []

    async def start(self) -> hf.ActorRef[Counter]:
        ref = await self.system.start(hf.child("alice", hf.start(Counter), mechanism=TMR()))
        while sum(isinstance(one, ReplicaJoined) for one in self.seen) < 2:
            await self.happened(ReplicaJoined)
        return ref

    async def happened(self, kind: type[Any]) -> Any:
        """The next event of this kind."""
        async with asyncio.timeout(60):
            async for event in self._events:
                self.seen.append(event)
                if isinstance(event, kind):
                    return event
        raise AssertionError("the stream has ended")

    def pid(self, name: str) -> int:
        return self.system.pid_of(self.system.ref(f"/app/alice/ftm/{name}", hf.Actor))

    def kill(self, name: str) -> None:
        os.kill(self.pid(name), signal.SIGKILL)


@pytest.mark.parametrize("seed", [None, *range(4)])
async def test_the_third_replica_leads_when_the_second_leader_dies_too(
    system: hf.ActorSystem, seed: int | None
) -> None:
    """The second kill comes in the very moment in which the failover is told, or some requests later."""
    trio = Trio(system)
    ref = await trio.start()
    load = Load(ref, clients=3)
    await load.reached(20)
    trio.kill("r1")
    second = (await trio.happened(FailedOver)).replica
    (third,) = {"r2", "r3"} - {second}
    pid = trio.pid(third)
    if seed is not None:
        await load.reached(random.Random(seed).randint(1, 40))
    trio.kill(second)
    assert (await trio.happened(FailedOver)).replica in ({third} if seed is None else {"r1", third})
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert trio.pid(third) == pid
    assert not any(isinstance(one, TurnsLost) for one in trio.seen)


async def trio_of(system: hf.ActorSystem, kind: Any = Total) -> Any:
    return await pair(system, kind, TMR(), others=("r2", "r3"))


async def test_what_only_the_next_leader_knows_leaves_when_the_third_one_has_it_too(system: hf.ActorSystem) -> None:
    driver = await trio_of(system)
    before = system._node.cell_at(driver.path("r3") + "/before").ref
    await system.suspend(before)
    turn = driver.standing("r2").server.turn
    (key,) = driver.send(Add(1))
    async with asyncio.timeout(30):
        while driver.standing("r2").server.turn == turn:
            await asyncio.sleep(0)
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    for _ in range(200):
        await asyncio.sleep(0)
    assert key not in driver.ends
    await system.resume(before)
    assert await driver.reply(key) == 1
    await driver.stop_replica("r2")
    await driver.fail_over("r3")
    assert await driver.ask(Add(2)) == 3
    assert await driver.ask(Read()) == [1, 2]


@pytest.mark.parametrize("handled", [0, 1])
async def test_what_a_joiner_computes_while_it_takes_a_state_is_not_overwritten_by_that(
    system: hf.ActorSystem, handled: int
) -> None:
    driver = await trio_of(system)
    for n in range(handled):
        await driver.ask(Add(n))
    proceed = system._node.cell_at(driver.path("r3") + "/proceed").ref
    await system.suspend(proceed)
    joining = asyncio.create_task(driver.join("r3"))
    async with asyncio.timeout(30):
        while driver.standing("r3").other.path != driver.path("r1") or driver.standing("r3").following.is_ready:
            await asyncio.sleep(0)
    for _ in range(50):  # It waits for its Proceed to drop what that has.
        await asyncio.sleep(0)
    assert await driver.ask(Add(7)) == 7
    await system.resume(proceed)
    await joining
    for name in ("r1", "r2"):
        await driver.stop_replica(name)
    await driver.fail_over("r3")
    assert await driver.ask(Read()) == [*range(handled), 7]


class Curious(Total):
    """On the third replica it asks what it has not asked elsewhere, and so comes to no outcome there."""

    @hf.on(Fetch)
    async def fetch(self, message: Fetch) -> Any:
        if "/r3/" in self.ctx._cell.path:
            await self.other.ask(Add(0))
        return await super().fetch(message)


async def test_a_replica_that_has_no_outcome_ceases_to_count_with_what_leaves_without_it(
    system: hf.ActorSystem,
) -> None:
    driver = await trio_of(system, Curious)
    driver.holds_strays = True
    assert await driver.ask(Add(1)) == 1
    assert not any(isinstance(one, Strayed) for one in driver.more)
    assert await driver.ask(Fetch(2)) == 3
    assert [one.path for one in driver.more if isinstance(one, Strayed)] == [driver.path("r3")]


async def test_a_replica_that_was_outvoted_ceases_to_count_at_once(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, TMR(), FAULTY(what="answer", replica="r2"), others=("r2", "r3"))
    driver.holds_strays = True
    with system.events() as events:
        assert await driver.ask(Add(1)) == 1
        assert any(isinstance(one, Outvoted) for one in events.take())
    assert [one.path for one in driver.more if isinstance(one, Strayed)] == [driver.path("r2")]
