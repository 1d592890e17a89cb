"""Passive replication, brick by brick: replicas in this process, and a small home that feeds them."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.exit_reasons import SHUTDOWN, pack_exit
from holdfast.checkpoint.protocol import OK, STASHED, TurnEnd
from holdfast.checkpoint.protocol import Closed as LifeClosed
from holdfast.ftm.alarms import ProtectionLost
from holdfast.ftm.bricks.brick_messages import (
    ConfigMismatch,
    Done,
    Follow,
    Lead,
    Request,
    ServerState,
    StaleLeader,
    Work,
)
from holdfast.ftm.bricks.letters import Letter
from holdfast.ftm.bricks.replica_orders import Export, Finish, Install, Join, SetPeer
from holdfast.ftm.bricks.reply_log import ReplyLog
from holdfast.ftm.bricks.state_images import image_from
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR, Checkpoint
from holdfast.ftm.mechanisms.tmr import TMR
from tests.ftm.replicated import (
    Add,
    Back,
    Closed,
    Fail,
    Fetch,
    Guess,
    Large,
    Put,
    Quit,
    Read,
    Say,
    Spoil,
    Total,
    Trap,
    kills_of_two,
    pair,
)


async def test_a_backup_that_leads_goes_on_where_the_primary_was(system: hf.ActorSystem) -> None:
    """A35."""
    driver = await pair(system)
    assert await driver.ask(Add(1)) == 1
    assert await driver.ask(Add(2)) == 3
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Add(3)) == 6
    assert await driver.ask(Read()) == [1, 2, 3]


async def test_finish_takes_a_last_snapshot(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    assert await driver.ask(Add(1)) == 1
    await driver.protocol("r1").ask(Finish(driver.epoch, pack_exit(SHUTDOWN)))
    assert [type(one).__name__ for one in driver.more] == ["Snapshot"]


async def test_a_reply_leaves_only_when_the_backup_has_its_state(system: hf.ActorSystem) -> None:
    """A34, T4, A52: the backup is stopped in the middle; no reply leaves until it goes on."""
    driver = await pair(system)
    backup = system._node.cell_at(driver.path("r2") + "/after").ref
    await system.suspend(backup)
    (key,) = driver.send(Add(1))
    await asyncio.sleep(0.05)
    assert key not in driver.ends
    await system.resume(backup)
    assert await driver.reply(key) == 1
    assert driver.standing("r2").server.points.turn == driver.ends[key].turn


@pytest.mark.parametrize("mechanism", [PBR(), LFR()], ids=["pbr", "lfr"])
async def test_a_primary_whose_backup_is_gone_goes_on_alone_and_says_so(system: hf.ActorSystem, mechanism: Any) -> None:
    """Also of the answer that it has in hand when it is told."""
    driver = await pair(system, Total, mechanism)
    await driver.stop_replica("r2")
    (key,) = driver.send(Add(1))
    await asyncio.sleep(0.05)
    assert key not in driver.ends, "nobody has said that it does not count any more"
    events = system.events()
    await driver.protocol("r1").ask(SetPeer(driver.epoch, None))
    assert await driver.reply(key) == 1
    assert [one.replica for one in events.take() if isinstance(one, ProtectionLost)] == [driver.path("r1")]
    assert await driver.ask(Add(2)) == 3
    assert [one for one in events.take() if isinstance(one, ProtectionLost)] == [], "it is told once"
    events.close()


@pytest.mark.parametrize("mechanism", [PBR(), LFR(), TMR()], ids=["pbr", "lfr", "tmr"])
async def test_who_is_alone_again_says_so_again_though_no_request_came_in_between(
    system: hf.ActorSystem, mechanism: Any
) -> None:
    driver = await pair(system, Total, mechanism)
    with system.events() as events:
        for n in range(3):
            await driver.stop_replica("r2")
            await driver.protocol("r1").ask(SetPeer(driver.epoch, None))
            await driver.ask(Add(n))
            await driver.ask(Add(n))
            told = [one.replica for one in events.take() if isinstance(one, ProtectionLost)]
            assert told == [driver.path("r1")]
            await driver.add("r2")
            await driver.join("r2")


async def test_a_replica_that_joins_later_can_lead(system: hf.ActorSystem) -> None:
    """T8c: state and reply log go over while requests flow."""
    driver = await pair(system, others=())
    keys = driver.send(*(Add(n) for n in range(50)))
    await driver.add("r2")
    joined = asyncio.ensure_future(driver.join("r2"))
    for n in range(50, 60):
        keys += driver.send(Add(n))
    await joined
    keys += driver.send(*(Add(n) for n in range(60, 100)))
    for key in keys:
        await driver.until(key)
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == list(range(100))
    assert driver.doubled == []


async def test_a_duplicate_is_answered_from_the_log_also_by_the_next_primary(system: hf.ActorSystem) -> None:
    """A46, A54, T5: the reply log is part of what the backup has."""
    driver = await pair(system)
    keys = driver.send(Add(1), Add(2), Fail(3))
    ends = [await driver.until(key) for key in keys]
    for name in ("r1", "r2"):
        if name == "r2":
            await driver.stop_replica("r1")
            await driver.lead("r2")
        again = [Request("/app/client", 1, driver.feeds[key]) for key in keys]
        driver.doubled.clear()
        driver.queue.append(Work(driver.epoch, 0, driver._batch(), again, None, True))
        driver._send()
        assert await driver.ask(Read()) == [1, 2]
        assert driver.doubled == ends


async def test_what_was_acknowledged_but_not_heard_of_is_not_done_twice(system: hf.ActorSystem) -> None:
    """The primary dies between the acknowledgement of the backup and its reply (A52, A53)."""
    driver = await pair(system)
    heard: list[Any] = []
    real = driver.take
    driver.take = heard.append  # type: ignore[method-assign,assignment]  # the replies are lost on their way
    keys = driver.send(Add(1), Add(2))
    async with asyncio.timeout(5):
        while not heard:
            await asyncio.sleep(0.001)
    await driver.stop_replica("r1")
    driver.take = real  # type: ignore[method-assign]
    await driver.fail_over("r2")
    assert [await driver.reply(key) for key in keys] == [1, 3]
    assert await driver.ask(Read()) == [1, 2]


async def test_whether_it_traps_exits_is_part_of_its_state(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    assert await driver.ask(Trap(on=True))
    with pytest.raises(hf.RemoteCrash):
        await driver.ask(Fail(1))
    assert await driver.ask(Trap(on=False))
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Trap(on=False))


@pytest.mark.parametrize("setting", [{"window": 0}, {"window": -1}, {"window": "x"}, {"acknowledge": "no"}])
def test_settings_that_mean_nothing_are_refused(setting: Any) -> None:
    with pytest.raises(ValueError, match=rf"PBR: {next(iter(setting))} must be .*not {next(iter(setting.values()))!r}"):
        PBR(**setting)


class _Slow:
    """The clock of a busy machine: each look but every n-th finds that no time has passed."""

    def __init__(self, every: int) -> None:
        self._looks, self._every = 0, every

    def perf_counter(self) -> float:
        self._looks += 1
        return float(self._looks // self._every)


@pytest.mark.parametrize("every", range(2, 8))
async def test_a_part_may_be_over_before_any_turn_that_is_run_again(
    system: hf.ActorSystem, every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a slow machine has left for the next part is not run with the one that is run again."""
    driver = await pair(system)
    driver.standing("r1").server.attempts.size = 1
    monkeypatch.setattr("holdfast.ftm.replica.protected_actor.time", _Slow(every))
    keys = driver.send(Add(1), Spoil(2), Add(3), Fail(4), Spoil(5), Add(6), Add(7))
    assert await driver.reply(keys[6]) == 17
    assert [driver.ends[key].turn for key in keys] == [1, 2, 3, 4, 5, 6, 7]
    assert [driver.ends[keys[at]].status for at in (1, 3, 4)] == ["failed"] * 3


async def test_a_turn_that_fails_leaves_nothing_but_its_number(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    keys = driver.send(Add(1), Fail(2), Add(3), Fail(4), Add(5))
    assert [(await driver.until(key)).turn for key in keys] == [1, 2, 3, 4, 5]
    with pytest.raises(hf.RemoteCrash, match="no 4"):
        await driver.reply(keys[3])
    assert await driver.ask(Read()) == [1, 3, 5]
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 3, 5]


async def test_a_turn_that_asks_is_undone_until_it_stands_at_the_front(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    keys = driver.send(Add(1), Fetch(2), Add(3), Fetch(4), Say(5))
    assert [await driver.reply(key) for key in keys] == [1, 3, 6, 10, 15]
    assert await driver.ask(Read()) == [1, -2, 4, 3, -4, 8, 5]
    verbs = [out.verb for _, out in sorted(driver.released.items())]
    assert verbs == ["ask", "ask", "tell"]


async def test_an_ask_that_is_out_is_joined_by_the_next_primary(system: hf.ActorSystem) -> None:
    """The primary dies while its turn waits for an outcome: the turn is run again, its ask is the same one."""
    driver = await pair(system)
    answer, driver.outside = driver.outside, lambda out: None
    (first, second) = driver.send(Add(1), Fetch(2))
    async with asyncio.timeout(5):
        while not driver.released:
            await asyncio.sleep(0.001)
    assert first in driver.ends
    assert second not in driver.ends
    await driver.stop_replica("r1")
    driver.outside = answer
    await driver.fail_over("r2")
    assert await driver.reply(second) == 3
    assert await driver.ask(Read()) == [1, -2, 4]
    assert len(driver.released) == 1


async def test_what_is_stashed_goes_over_to_the_backup(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    keys = driver.send(Add(1), Put(2), Put(3), Add(4))
    await driver.until(keys[3])
    assert driver.ends[keys[1]].status == STASHED
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Back()) == 5
    assert await driver.reply(keys[1]) == 7
    assert await driver.reply(keys[2]) == 10
    assert await driver.ask(Read()) == [1, 4, 2, 3]


async def test_only_what_has_changed_goes_to_the_backup(system: hf.ActorSystem) -> None:
    driver = await pair(system, Large)
    for n in (1, 2, 2):
        await driver.ask(Add(n))
    keys = driver.send(Add(3), Fail(4), Add(5))
    await driver.until(keys[2])
    backup = driver.standing("r2").server
    assert len(backup.points.point.deltas) >= 3
    assert all(len(one) < 100 for one in backup.points.point.deltas)
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 2, 2, 3, 5]
    await driver.add("r1")
    await driver.join("r1")
    assert await driver.ask(Add(6)) == 1
    await driver.stop_replica("r2")
    await driver.fail_over("r1")
    assert await driver.ask(Read()) == [1, 2, 2, 3, 5, 6]


async def test_one_that_is_not_deterministic_has_one_history(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    keys = driver.send(Guess(), Fail(0), Guess(), Fetch(1), Guess())
    await driver.until(keys[-1])
    seen = await driver.ask(Read())
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == seen
    assert await driver.reply(keys[0]) == seen[0]


async def test_an_actor_that_stops_itself_says_so_behind_its_turns(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    keys = driver.send(Add(1), Quit(), Add(2))
    assert await driver.reply(keys[1]) == 1
    async with asyncio.timeout(5):
        while not any(isinstance(one, LifeClosed) for one in driver.more):
            await asyncio.sleep(0.001)
    assert keys[2] not in driver.ends


async def test_lower_epochs_and_other_configurations_are_refused(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    await driver.ask(Add(1))
    after = system._node.cell_at(driver.path("r2") + "/after").ref
    state = driver.standing("r2").server.points.point
    body = system._node.codec.encoder.encode(Checkpoint(state, []))
    name = "holdfast.ftm.mechanisms.pbr:Checkpoint"
    with pytest.raises(StaleLeader):
        await after.ask(Letter(driver.epoch - 1, 0, name, body, size=len(body), stream=1, number=1))
    with pytest.raises(ConfigMismatch):
        await after.ask(Letter(driver.epoch, 7, name, body, size=len(body), stream=1, number=2))
    for order in (Lead(0, 0), Follow(0, 0), Join(0, driver.path("r2")), Export(0)):
        with pytest.raises((StaleLeader, hf.RemoteCrash)):
            await driver.protocol("r1").ask(order)
    old = Work(driver.epoch - 1, 0, 99, [Request("", 0, driver.feed(Add(2)))])
    driver.protocol("r1").tell(old)
    assert await driver.ask(Read()) == [1]


async def test_an_old_primary_that_wakes_up_changes_nothing(system: hf.ActorSystem) -> None:
    """T1: it is neither heard by the backup that leads now, nor by the home."""
    driver = await pair(system)
    await driver.ask(Add(1))
    server = system._node.cell_at(driver.path("r1") + "/proceed").ref
    await system.suspend(server)
    (key,) = driver.send(Add(2))
    await asyncio.sleep(0.02)
    await driver.fail_over("r2")
    assert await driver.reply(key) == 3
    await system.resume(server)
    async with asyncio.timeout(5):
        while not driver.standing("r1").is_fenced:
            await asyncio.sleep(0.001)
    assert await driver.ask(Add(3)) == 6
    assert await driver.ask(Read()) == [1, 2, 3]
    assert driver.doubled == []


async def test_without_waiting_replies_may_be_ahead_of_the_backup_by_the_window(system: hf.ActorSystem) -> None:
    driver = await pair(system, Total, PBR(acknowledge=False, window=4))
    backup = system._node.cell_at(driver.path("r2") + "/after").ref
    async with asyncio.timeout(5):
        while driver.standing("r2").server.turn < 0:
            await asyncio.sleep(0.001)
    await system.suspend(backup)
    for n in range(4):
        await driver.ask(Add(n))
    (key,) = driver.send(Add(4))
    await asyncio.sleep(0.05)
    assert key not in driver.ends
    await system.resume(backup)
    assert await driver.reply(key) == 10


async def test_the_state_can_be_given_out_between_two_batches(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    driver.send(Add(1), Put(2))
    exported = await driver.protocol("r1").ask(Export(driver.epoch))
    assert exported.turn == 2
    assert exported.stash == [2]
    assert exported.data


async def test_a_state_from_the_home_is_where_the_first_primary_begins(system: hf.ActorSystem) -> None:
    first = await pair(system)
    first.send(Add(1), Add(2))
    exported = await first.protocol("r1").ask(Export(first.epoch))
    await first.add("r3")
    half = len(exported.data) // 2
    epoch = first.epoch + 1
    protocol = first.protocol("r3")
    for at, is_last in ((exported.data[:half], False), (exported.data[half:], True)):
        await protocol.ask(Install(epoch, exported.turn, at, exported.stash, is_last, []))
    assert await first.lead("r3") == 2


async def test_a_crash_of_any_brick_is_the_end_of_its_replica(system: hf.ActorSystem) -> None:
    driver = await pair(system)
    await driver.ask(Add(1))
    for name in ("proceed", "before", "after", "protocol", "state"):
        await driver.add(f"r{name}")
        cell = system._node.cell_at(driver.path(f"r{name}"))
        system._node.cell_at(f"{cell.path}/{name}").kill()
        await cell.ended()
    assert await driver.ask(Add(2)) == 3


def test_an_evicted_reply_is_told_apart_from_an_unknown_request() -> None:
    """T6."""
    log = ReplyLog(capacity=2)
    log.add(("", 0, number, TurnEnd(number, number, OK, [], None)) for number in (0, 1, 2, 4))  # type: ignore[arg-type]
    assert [log.find(number) is not None for number in range(5)] == [False, False, True, False, True]
    assert [log.was_evicted(number) for number in range(6)] == [True, True, False, False, False, False]


@pytest.mark.parametrize("seed", range(6))
async def test_kills_at_any_moment_lose_and_double_nothing(system: hf.ActorSystem, seed: int) -> None:
    await kills_of_two(await pair(system), system, random.Random(seed))


def test_names_used_here_are_those_of_the_library() -> None:
    assert issubclass(Closed, Total)
    assert ServerState(0, image_from(b""), [], [], [], False).stash_ids == []
    assert Done(0, 0, 0, [], True).more == []
