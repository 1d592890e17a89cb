"""Checks that keep old, doubled and foreign words out, each by itself: what comes at the wrong time changes nothing."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.checkpoint.protocol import DROPPED, OK, REPLY, Answer, Outcome, TurnEnd, came
from holdfast.ftm.bricks.brick_messages import Done, NotFollowing, ReplyEvicted, Request, ServerState, StateDelta, Work
from holdfast.ftm.bricks.letters import Letter
from holdfast.ftm.bricks.replica_orders import Broken
from holdfast.ftm.bricks.reply_log import ReplyLog
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.group.proxy import TakeAll
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR, Checkpoint
from holdfast.ftm.replica.rewind_points import checksum
from holdfast.ftm.replica.state_manager import MISFIT, Apply
from tests.ftm import accounts
from tests.ftm.replicated import Add, Fetch, Read, Total, pair
from tests.ftm.test_failover import group_of, pid_of, stop_process, two_again

CHECKPOINT = "holdfast.ftm.mechanisms.pbr:Checkpoint"


async def said(driver: Any, state: ServerState | StateDelta, *, epoch: int, log: Any = ()) -> int:
    """What the backup answers to this state."""
    body = driver.system._node.codec.encoder.encode(Checkpoint(state, list(log)))
    after = driver.system._node.cell_at(driver.path("r2") + "/after").ref
    letter = Letter(epoch, 0, CHECKPOINT, body, size=len(body), stream=1, number=1)
    return msgspec.msgpack.decode(await after.ask(letter))


async def test_who_was_not_told_that_it_follows_takes_nothing(system: hf.ActorSystem) -> None:
    """It was meant for the life before, which had another state."""
    driver = await pair(system)
    assert await driver.ask(Add(1)) == 1
    state = driver.standing("r2").server.points.point
    with pytest.raises(NotFollowing):
        await said(driver, msgspec.structs.replace(state, turn=9), epoch=driver.epoch + 1)
    assert driver.standing("r2").server.turn == 1
    assert driver.standing("r2").epoch == driver.epoch


async def test_a_state_that_was_overtaken_does_not_come_back(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    assert await driver.ask(Add(1)) == 1
    old = driver.standing("r2").server.points.point
    assert await driver.ask(Add(2)) == 3
    assert await said(driver, old, epoch=driver.epoch) == 2
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 2]


async def test_what_has_changed_since_a_state_that_is_not_here_is_not_taken(system: hf.ActorSystem) -> None:
    """All of it is wanted instead."""
    driver = await pair(system)
    assert await driver.ask(Add(1)) == 1
    change = StateDelta(7, 5, None, [b"\x80"], checksum([b"\x80"]), [], [], True)
    assert await system._node.cell_at(driver.path("r2") + "/state").ref.ask(Apply(change)) == MISFIT
    assert driver.standing("r2").server.turn == 1
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1]


async def test_outcomes_without_their_state_are_not_known(system: hf.ActorSystem) -> None:
    """Else a request would be answered that has left nothing behind."""
    driver = await pair(system)
    (key,) = driver.send(Add(1))
    assert await driver.reply(key) == 1
    change = StateDelta(7, 5, None, [b"\x80"], checksum([b"\x80"]), [], [], True)
    log = [("", 0, 77, TurnEnd(7, 77, OK, [], Answer(REPLY, "", b"\x63")))]
    assert await said(driver, change, epoch=driver.epoch, log=log) == MISFIT
    assert driver.standing("r2").log.find(77) is None
    assert driver.standing("r2").log.find(key) is not None


async def test_a_request_whose_outcome_was_evicted_is_not_handled_again(system: hf.ActorSystem) -> None:
    """T6: who asks for it is told so."""
    driver = await pair(system)
    driver.standing("r1").log = ReplyLog(capacity=2)
    keys = driver.send(Add(1), Add(2), Add(3))
    assert [await driver.reply(key) for key in keys] == [1, 3, 6]
    again = [Request("/app/client", 1, driver.feeds[keys[0]])]
    del driver.ends[keys[0]]
    taken: list[TurnEnd] = []
    real = driver.take

    def take(done: Done) -> None:
        taken.extend(done.ends)
        real(Done(done.epoch, done.config, done.number, [], done.is_last))

    driver.take = take  # type: ignore[method-assign]
    driver.queue.append(Work(driver.epoch, 0, driver._batch(), again, None, True))
    driver._send()
    async with asyncio.timeout(10):
        while not taken:
            await asyncio.sleep(0.001)
    driver.take = real  # type: ignore[method-assign]
    assert [(end.status, end.answer.name) for end in taken] == [
        (DROPPED, f"{ReplyEvicted.__module__}:{ReplyEvicted.__name__}")
    ]
    assert await driver.ask(Read()) == [1, 2, 3]


@pytest.mark.parametrize("mechanism", [PBR(), LFR()], ids=lambda one: one.name)
async def test_a_batch_that_comes_to_proceed_twice_is_computed_once(system: hf.ActorSystem, mechanism: Any) -> None:
    driver = await pair(system, Total, mechanism)
    proceed = system._node.cell_at(driver.path("r1") + "/proceed").ref
    await system.suspend(proceed)
    (key,) = driver.send(Add(1))
    proceed.tell(Work(driver.epoch, 0, driver.number, [Request("/app/client", 1, driver.feeds[key])]))
    await system.resume(proceed)
    assert await driver.reply(key) == 1
    assert await driver.ask(Read()) == [1]


async def test_what_a_follower_hears_before_it_has_the_state_does_not_keep_the_state_away(
    system: hf.ActorSystem,
) -> None:
    """A new life at an address that is known joins while a turn waits for what it has asked."""
    driver = await pair(system, Total, LFR())
    answer, driver.outside = driver.outside, lambda out: None
    (key,) = driver.send(Fetch(2))
    async with asyncio.timeout(10):
        while not driver.released:
            await asyncio.sleep(0.001)
    await driver.stop_replica("r2")
    await driver.add("r2")
    joining = asyncio.ensure_future(driver.join("r2"))
    async with asyncio.timeout(10):
        while driver.standing("r1").other.state != "joining":
            await asyncio.sleep(0.001)
    for (turn, k), out in driver.released.items():
        driver.inward(Outcome(turn, k, came(answer(out))))
    async with asyncio.timeout(10):
        await joining
    assert await driver.reply(key) == 2
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [-2, 4]


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_what_an_earlier_epoch_says_and_what_is_said_twice_is_nobodys_answer(system: hf.ActorSystem) -> None:
    """At the proxy, where whoever led before may still be heard."""
    ref = await system.start(hf.child("alice", hf.start(accounts.Counter), mechanism=PBR()))
    await two_again(ref)
    assert await ref.ask(accounts.Add(0)) == 1
    group = group_of(ref)
    assert group.membership.primary is not None
    pid = pid_of(system, ref, group.membership.primary)
    await stop_process(pid)
    asked = ref.ask(accounts.Add(1), timeout=30)
    async with asyncio.timeout(10):
        while group.delivery.out is None:
            await asyncio.sleep(0.001)
    wrong, key, turn = Answer(REPLY, "", b"\x63"), group.delivery.out.requests[0].feed.id, group.switch.turn
    known = next(key for key in range(key) if key not in group.switch.open)
    end = TurnEnd(turn + 1, key, OK, [], wrong)
    group.take_done(Done(group.membership.epoch - 1, group.adaptation.config, group.delivery.out.number, [end], True))
    assert group.delivery.stale == 1
    group.take_done(
        Done(group.membership.epoch, group.adaptation.config, 0, [TurnEnd(turn, known, OK, [], wrong)], False)
    )
    assert group.delivery.doubled == 1
    os.kill(pid, signal.SIGCONT)
    assert await asked == 2
    assert await ref.ask(accounts.Tags()) == [0, 1]


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_who_led_before_is_dead_when_another_one_is_told_to_lead(system: hf.ActorSystem) -> None:
    """T38, fail-silence: it was silent only, and could have gone on at any moment."""
    ref = await system.start(hf.child("alice", hf.start(accounts.Counter), mechanism=PBR()))
    await two_again(ref)
    assert await ref.ask(accounts.Add(0)) == 1
    group, host = group_of(ref), ref._cell.host.place
    assert isinstance(host, GroupPlace)
    assert group.membership.primary is not None
    pid = pid_of(system, ref, group.membership.primary)
    seen: list[tuple[str, bool]] = []
    host.on_step = lambda step: seen.append((step, Path(f"/proc/{pid}").exists()))
    await stop_process(pid)
    assert await ref.ask(accounts.Add(1), timeout=30) == 2
    assert ("depose", True) in seen
    assert [alive for step, alive in seen if step in ("lead", "bind")] == [False, False]


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_nobody_speaks_for_a_replica(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(accounts.Counter), mechanism=PBR()))
    await two_again(ref)
    assert await ref.ask(accounts.Add(0)) == 1
    group = group_of(ref)
    assert group.membership.primary is not None
    detector, proxy = (system._node.cell_at(f"{ref.path}/ftm/{name}").ref for name in ("detector", "proxy"))
    detector.tell(Broken(group.membership.primary, group.replicas.life_of(group.membership.primary), "forged"))
    end = TurnEnd(group.switch.turn + 1, 1, OK, [], Answer(REPLY, "", b"\x63"))
    proxy.tell(Done(group.membership.epoch, group.adaptation.config, -1, [end], False))
    await proxy.ask(TakeAll())
    assert (group.membership.suspected, group.delivery.stale, group.membership.epoch) == ({}, 1, 1)
    assert await ref.ask(accounts.Add(1)) == 2
