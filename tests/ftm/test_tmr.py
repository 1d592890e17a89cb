"""Triple modular redundancy: one of three may be crashed, silent or wrong."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from typing import Any, ClassVar

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Masked, Outvoted, ProtectionLost
from holdfast.ftm.events import FailedOver, ReplicaJoined
from holdfast.ftm.mechanisms.tmr import TMR
from holdfast.ftm.model.mechanism import MechanismRefused, find, revive
from holdfast.ftm.votes.voters import Median, NoMajority
from tests.ftm.accounts import Account, Bank, Counter, Load, Tags, Transfer
from tests.ftm.accounts import Put as Pay
from tests.ftm.replicated import Add, Back, Closed, Fail, Fetch, Put, Read, Say, Total, all_once, pair, traffic
from tests.ftm.test_failover import group_of, pid_of, stop_process
from tests.ftm.versions import FAULTY

OTHERS = ("r2", "r3")


async def trio(system: hf.ActorSystem, *inner: Any, kind: Any = Total) -> Any:
    return await pair(system, kind, TMR(), *inner, others=OTHERS)


async def ended(driver: Any, name: str) -> None:
    """Wait until a replica has ended by itself; the driver does not start it again."""
    async with asyncio.timeout(5):
        while (cell := driver.system._node.find(driver.path(name))) is not None and cell.state == "running":
            await asyncio.sleep(0.001)


async def test_three_agree(system: hf.ActorSystem) -> None:
    driver = await trio(system)
    with system.events() as events:
        keys = driver.send(Add(1), Fetch(2), Say(3), Fail(4), Put(7), Add(5), Back())
        with pytest.raises(hf.RemoteCrash, match="no 4"):
            await driver.reply(keys[3])
        assert await driver.reply(keys[5]) == 11
        assert await driver.reply(keys[4]) == 18
        assert [one for one in events.take() if isinstance(one, Outvoted)] == []
    assert driver.standing("r2").server.turn == driver.standing("r3").server.turn == driver.standing("r1").server.turn
    await driver.stop_replica("r1")
    await driver.fail_over("r3")
    assert await driver.ask(Read()) == [1, -2, 4, 3, 5, 7]
    assert sorted(out.verb for out in driver.released.values()) == ["ask", "tell"]


@pytest.mark.parametrize("always", [False, True])
@pytest.mark.parametrize("what", ["answer", "state", "message"])
async def test_a_leader_that_is_wrong_is_outvoted_and_gives_way(
    system: hf.ActorSystem, what: str, always: bool
) -> None:
    """T43: what has not left yet is answered by the next one, from what the two others have agreed on."""
    driver = await trio(system, FAULTY(what=what, always=always, skip=2))
    assert await driver.ask(Add(1)) == 1
    with system.events() as events:
        keys = driver.send(Add(2), Add(3), Add(4))
        await ended(driver, "r1")
        assert {one.replica for one in events.take() if isinstance(one, Outvoted)} == {driver.path("r1")}
    await driver.fail_over("r2")
    assert [await driver.reply(key) for key in keys] == [3, 6, 10]
    await driver.join("r3")
    assert await driver.ask(Add(5)) == 15
    assert await driver.ask(Read()) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("what", ["answer", "state"])
async def test_a_follower_that_is_wrong_is_outvoted_and_ends(system: hf.ActorSystem, what: str) -> None:
    driver = await trio(system, FAULTY(what=what, replica="r2"))
    with system.events() as events:
        keys = driver.send(Add(1), Add(2))
        assert [await driver.reply(key) for key in keys] == [1, 3]
        await ended(driver, "r2")
        assert {one.replica for one in events.take() if isinstance(one, Outvoted)} == {driver.path("r2")}
    assert await driver.ask(Add(3)) == 6
    await driver.stop_replica("r1")
    await driver.fail_over("r3")
    assert await driver.ask(Read()) == [1, 2, 3]


async def test_with_one_gone_a_wrong_value_is_seen_and_not_answered(system: hf.ActorSystem) -> None:
    driver = await trio(system, FAULTY(what="answer", skip=1, replica="r2"))
    await driver.stop_replica("r3")
    assert await driver.ask(Add(1)) == 1
    with pytest.raises(NoMajority):
        await driver.ask(Add(2))
    assert await driver.ask(Add(3)) == 4
    await driver.stop_replica("r2")
    with system.events() as events:
        assert await driver.ask(Add(4)) == 8
        assert any(isinstance(one, ProtectionLost) for one in events.take())
    assert await driver.ask(Read()) == [1, 3, 4]


class Gated(Total):
    """Its next run on a replica in `gates` stands still there."""

    gates: ClassVar[dict[str, asyncio.Future[None]]] = {}

    @hf.on(Fetch)
    async def fetch(self, message: Fetch) -> Any:
        reached = self.gates.pop(self.ctx._cell.path.split("/")[4], None)
        if reached is not None:
            reached.set_result(None)
            await asyncio.Event().wait()
        return await super().fetch(message)


async def test_a_replica_that_is_stopped_while_it_computes_has_no_vote(system: hf.ActorSystem) -> None:
    """What it has not come to the end of is no outcome: nobody is outvoted, and nothing was masked."""
    driver = await trio(system, kind=Gated)
    Gated.gates["r2"] = reached = asyncio.get_running_loop().create_future()
    with system.events() as events:
        (key,) = driver.send(Fetch(2))
        await reached
        system._node.cell_at(driver.path("r2")).request_stop(hf.SHUTDOWN)  # As when one of its bricks has crashed.
        assert await driver.reply(key) == 2
        assert [one for one in events.take() if isinstance(one, Outvoted | Masked)] == []
    assert await driver.ask(Add(5)) == 7


async def test_nothing_leaves_before_all_that_are_up_have_it(system: hf.ActorSystem) -> None:
    """Whoever leads next has what was answered."""
    driver = await trio(system)
    before = system._node.cell_at(driver.path("r3") + "/before").ref
    await system.suspend(before)
    (key,) = driver.send(Add(1))
    await asyncio.sleep(0.05)
    assert key not in driver.ends
    await driver.stop_replica("r3")
    assert await driver.reply(key) == 1


@pytest.mark.parametrize("seed", range(6))
async def test_kills_at_any_moment_lose_and_double_nothing(system: hf.ActorSystem, seed: int) -> None:
    dice = random.Random(seed)
    driver = await trio(system)
    sent: list[int] = []
    up = ["r1", "r2", "r3"]
    for _ in range(10):
        await traffic(driver, dice, sent)
        victim = dice.choice(up)
        await driver.stop_replica(victim)
        if victim == driver.primary:
            await driver.fail_over(dice.choice([name for name in up if name != victim]))
        await driver.add(victim)
        await driver.join(victim)
    await all_once(driver, system, sent)


async def three_again(ref: hf.ActorRef[Any]) -> None:
    async with asyncio.timeout(60):
        while (
            ref._cell.state != "running"
            or getattr(ref._cell.host.place, "group", None) is None
            or len(group_of(ref).membership.members) < 3
        ):
            await asyncio.sleep(0.005)


async def test_processes_are_killed_and_silenced_under_load(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=TMR()))
    await three_again(ref)
    load = Load(ref, clients=3)
    await load.reached(20)
    for name, how in (("r3", signal.SIGKILL), ("r1", signal.SIGKILL), ("r2", signal.SIGSTOP)):
        if how == signal.SIGSTOP:
            await stop_process(pid_of(system, ref, name))
        else:
            os.kill(pid_of(system, ref, name), how)
        await load.reached(20)
        await three_again(ref)
        await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))


@pytest.mark.parametrize("replica", ["r1", "r3"])
async def test_a_process_that_is_wrong_for_good_is_restarted_and_joins_again(
    system: hf.ActorSystem, replica: str
) -> None:
    layers = TMR(), FAULTY(what="state", always=True, skip=10, replica=replica)
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=layers))
    await three_again(ref)
    load = Load(ref, clients=2)
    with system.events() as events:
        seen: list[Any] = []
        async with asyncio.timeout(60):
            while not (
                any(isinstance(one, Outvoted) for one in seen)
                and any(isinstance(one, ReplicaJoined) and one.replica == replica for one in seen)
            ):
                seen += events.take()
                await asyncio.sleep(0.005)
        await load.reached(20)
    await load.stop()
    assert {one.replica for one in seen if isinstance(one, Outvoted)} == {f"{ref.path}/ftm/{replica}"}
    assert any(isinstance(one, FailedOver) for one in seen) == (replica == "r1")
    load.check(await ref.ask(Tags()))


async def test_asks_in_the_middle_of_turns_are_made_once(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account, 1000)))
    other = await system.start(hf.child("other", hf.start(Account, 1000)))
    bank = await system.start(
        hf.child("bank", hf.start(Bank), mechanism=TMR(), bindings={"one": one.path, "other": other.path})
    )
    await three_again(bank)
    load = Load(bank, clients=2, make=Transfer)
    await load.reached(10)
    os.kill(pid_of(system, bank, "r1"), signal.SIGKILL)
    await load.reached(10)
    await load.stop()
    load.check(await bank.ask(Tags()))
    assert await one.ask(Pay(0)) == 1000 - load.sent
    assert await other.ask(Pay(0)) == 1000 + load.sent


def test_what_cannot_work_is_refused_with_the_reason() -> None:
    class Random(Total):
        deterministic = False

    TMR().check(Total)
    with pytest.raises(MechanismRefused, match="state_access = False"):
        TMR().check(Closed)
    with pytest.raises(MechanismRefused, match="deterministic = False"):
        TMR().check(Random)
    with pytest.raises(ValueError, match=r"take Tolerance"):
        TMR(voter=Median())
    with pytest.raises(ValueError, match=r"one such as .*Majority\(\).*not 'majority'"):
        TMR(voter="majority")
    assert revive(TMR().describe()) == TMR()
    assert find("tmr") is TMR
