"""Failover with real processes: whatever dies, and at whatever step, nothing is lost, wrong or done twice."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections import Counter as Multiset
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import TurnsLost
from holdfast.ftm.alarms import ProtectionLost
from holdfast.ftm.events import FailedOver, ReplicaJoined, ReplicaLost, WrongSuspicion
from holdfast.ftm.group.group import Group
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.group.membership import Lives, Membership, Suspicion
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tmr import TMR
from tests.ftm.accounts import (
    Account,
    Add,
    Bank,
    Boom,
    Closed,
    Counter,
    Die,
    Leave,
    Load,
    Put,
    Tags,
    Total,
    Transfer,
)

SEED = int(os.environ.get("HOLDFAST_SEED", "20261121"))
METHODS = {
    "without recovery": lambda: None,
    "hybrid": lambda: hf.hybrid(interval=0.05),
    "replay_only": hf.replay_only,
    "checkpoint_only": lambda: hf.checkpoint_only(interval=0.05),
}
PARTS = ("proxy", "detector", "failover", "join")


def group_of(ref: hf.ActorRef[Any]) -> Group:
    host = ref._cell.host.place
    assert isinstance(host, GroupPlace)
    assert host.group is not None
    return host.group


def pid_of(system: hf.ActorSystem, ref: hf.ActorRef[Any], name: str) -> int:
    """The process of one replica."""
    return system._workers.processes()[f"{ref.path}/ftm/{name}"]


def other(group: Group) -> str:
    """The replica that does not lead."""
    return next(name for name in group.membership.names if name != group.membership.primary)


async def started(system: hf.ActorSystem, recipe: Any = None, **options: Any) -> hf.ActorRef[Any]:
    spec = hf.child("alice", recipe or hf.start(Counter), mechanism=PBR(), **options)
    return await system.start(spec)


async def two_again(ref: hf.ActorRef[Any]) -> None:
    """Wait until the group is complete."""
    async with asyncio.timeout(30):
        while not is_complete(ref):
            await asyncio.sleep(0.005)


def is_complete(ref: hf.ActorRef[Any]) -> bool:
    host = ref._cell.host.place
    group = host.group if isinstance(host, GroupPlace) else None
    return group is not None and group.replicas.whole_since()[0]


def stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


async def stop_process(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    async with asyncio.timeout(5):
        while not stopped(pid):
            await asyncio.sleep(0.001)


@pytest.mark.parametrize("method", METHODS)
async def test_a_protected_actor_answers_as_an_ordinary_one(system: hf.ActorSystem, method: str) -> None:
    """A7, A60."""
    ref = await started(system, hf.start(Counter, 10), recovery=METHODS[method]())
    assert [await ref.ask(Add(tag)) for tag in range(5)] == [11, 12, 13, 14, 15]
    assert await ref.ask(Tags()) == [0, 1, 2, 3, 4]
    with pytest.raises(hf.RemoteCrash, match="boom"):
        await ref.ask(Boom())
    assert await ref.ask(Total()) == 15
    assert len(group_of(ref).membership.members) == 2


@pytest.mark.parametrize("mechanism", [PBR(), LFR(), TMR()], ids=["pbr", "lfr", "tmr"])
async def test_a_first_start_loses_no_protection(system: hf.ActorSystem, mechanism: Any) -> None:
    """The first replica starts the actor before another one could have joined, but nobody is answered before that."""
    with system.events() as events:
        ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=mechanism))
        assert await ref.ask(Add(1)) == 1
        await two_again(ref)
        assert not [one for one in events.take() if isinstance(one, ProtectionLost)]


@pytest.mark.parametrize("mechanism", [PBR(), LFR(), TMR()], ids=["pbr", "lfr", "tmr"])
async def test_a_start_that_replays_loses_no_protection(tmp_path: Path, mechanism: Any) -> None:
    """What is replayed comes out again before another replica has joined; that is no loss, a death behind it is."""
    spec = hf.child("alice", hf.start(Counter), recovery=hf.replay_only(), mechanism=mechanism)
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await system.start(spec)
        assert [await ref.ask(Add(tag)) for tag in range(9)][-1] == 9
    async with hf.ActorSystem("app", store=store, log=False) as system:
        with system.events() as events:
            ref = await system.start(spec)
            await two_again(ref)
            assert not [one for one in events.take() if isinstance(one, ProtectionLost)]
            for name in group_of(ref).membership.names[1:]:
                os.kill(pid_of(system, ref, name), signal.SIGKILL)
            assert [await ref.ask(Add(tag)) for tag in (9, 10)] == [10, 11]
            await events.until(ProtectionLost)


async def test_the_graph_of_the_mechanism_is_seen_in_the_tree(system: hf.ActorSystem) -> None:
    """A41, A89."""
    ref = await started(system)
    seen = {path.removeprefix(f"{ref.path}/ftm/") for path in system.tree() if path.startswith(f"{ref.path}/ftm/")}
    bricks = {
        f"{name}/{brick}"
        for name in ("r1", "r2")
        for brick in ("protocol", "before", "proceed", "state", "server", "beat")
    }
    assert {*PARTS, "r1", "r2"} | bricks <= seen
    backup = other(group_of(ref))
    os.kill(pid_of(system, ref, backup), signal.SIGKILL)
    async with asyncio.timeout(10):
        while is_complete(ref):
            await asyncio.sleep(0.001)
    await two_again(ref)
    assert f"{ref.path}/ftm/{backup}/server" in system.tree()


async def test_the_bindings_of_the_bricks_are_seen_from_outside(system: hf.ActorSystem) -> None:
    """A44-A51: from the proxy to the protected actor, and back."""
    ref = await started(system)
    group = group_of(ref)
    first, second = group.membership.primary, other(group)

    async def bound(brick: str) -> dict[str, str]:
        status = await system.get_status(system.ref(f"{ref.path}/ftm/{brick}", hf.Actor))
        return {port: path.removeprefix(f"{ref.path}/ftm/") for port, path in status.bindings.items()}

    assert await ref.ask(Add(0)) == 1
    assert await bound("proxy") == {"protocol": f"{first}/protocol"}
    assert (await bound(f"{first}/protocol")).items() >= {"before": f"{first}/before", "next": "proxy"}.items()
    assert (await bound(f"{first}/before"))["next"] == f"{first}/proceed"
    found = await bound(f"{first}/proceed")
    assert (found["next"], found["server"]) == (f"{first}/after", f"{first}/server")
    found = await bound(f"{first}/after")
    assert (found["next"], found["peer"], found["state"]) == (
        f"{first}/protocol", f"{second}/after", f"{first}/state")  # fmt: skip
    assert await bound(f"{first}/state") == {"server": f"{first}/server"}
    status = await system.get_status(system.ref(f"{ref.path}/ftm/{first}/server", hf.Actor))
    assert status.kind.endswith("Counter")
    assert status.state == "running"
    assert first is not None
    os.kill(pid_of(system, ref, first), signal.SIGKILL)
    assert await ref.ask(Add(1)) == 2
    assert await bound("proxy") == {"protocol": f"{second}/protocol"}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("who", ["primary", "backup"])
@pytest.mark.some(4)
async def test_killing_a_replica_under_load_loses_nothing(system: hf.ActorSystem, method: str, who: str) -> None:
    ref = await started(system, recovery=METHODS[method]())
    load, rng = Load(ref), random.Random(f"{SEED} {method} {who}")
    events = system.events()
    killed: list[str] = []
    for _ in range(4):
        await load.reached(rng.randrange(1, 60))
        group = group_of(ref)
        name = group.membership.primary if who == "primary" else other(group)
        assert name is not None
        killed.append(name)
        os.kill(pid_of(system, ref, name), signal.SIGKILL)
        await load.reached(20)
        await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    seen = events.take()
    assert sum(isinstance(event, FailedOver) for event in seen) == (4 if who == "primary" else 0)
    assert sum(isinstance(event, ReplicaJoined) for event in seen) >= 4
    assert not Multiset(killed) - Multiset(event.replica for event in seen if isinstance(event, ReplicaLost))
    events.close()


@pytest.mark.parametrize("method", ["hybrid", "replay_only"])
async def test_killing_all_replicas_of_a_recorded_actor_loses_nothing(system: hf.ActorSystem, method: str) -> None:
    ref = await started(system, recovery=METHODS[method]())
    load = Load(ref)
    for _ in range(2):
        await load.reached(40)
        for pid in (pid_of(system, ref, "r1"), pid_of(system, ref, "r2")):
            os.kill(pid, signal.SIGKILL)
        await load.reached(40)
        await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_an_actor_without_recovery_begins_afresh_when_no_replica_is_left(system: hf.ActorSystem) -> None:
    ref = await started(system, hf.start(Counter, 10))
    assert await ref.ask(Add(0)) == 11
    with system.events() as events:
        for pid in (pid_of(system, ref, "r1"), pid_of(system, ref, "r2")):
            os.kill(pid, signal.SIGKILL)
        in_hand = [ref.ask(Add(tag), timeout=30) for tag in (1, 2)]
        assert (await events.until(TurnsLost)).address == ref.path
    assert await asyncio.gather(*in_hand) == [11, 12]
    assert await ref.ask(Tags()) == [1, 2]


@pytest.mark.parametrize("part", PARTS)
async def test_the_parts_at_the_root_may_die_at_any_moment(system: hf.ActorSystem, part: str) -> None:
    ref = await started(system)
    load, rng = Load(ref), random.Random(f"{SEED} {part}")
    for turn in range(6):
        await load.reached(rng.randrange(1, 60))
        group = group_of(ref)
        if turn % 2:
            assert group.membership.primary is not None
            os.kill(pid_of(system, ref, group.membership.primary), signal.SIGKILL)
            await asyncio.sleep(rng.random() * 0.03)
        cell = group.replicas.cell_of(part)
        assert cell is not None
        cell.kill()
        await load.reached(20)
        await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))


@pytest.mark.parametrize("method", ["hybrid", "replay_only"])
async def test_the_supervisor_of_the_mechanism_may_die(system: hf.ActorSystem, method: str) -> None:
    ref = await started(system, recovery=METHODS[method]())
    load = Load(ref)
    await load.reached(40)
    ftm = group_of(ref).replicas.node.find(f"{ref.path}/ftm")
    assert ftm is not None
    ftm.kill()
    await load.reached(40)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert ref._cell.life == 2


STEPS = ("depose", "epoch", "kill", "lead", "bind", "peer")


@pytest.mark.parametrize("step", STEPS)
async def test_the_failover_manager_may_die_at_each_step(system: hf.ActorSystem, step: str) -> None:
    """A58."""
    ref = await started(system)
    load, hit = Load(ref), list[str]()

    def strike(name: str) -> None:
        if name == step and hit.count(name) < 2:
            hit.append(name)
            raise RuntimeError(f"struck at {name}")

    host = ref._cell.host.place
    assert isinstance(host, GroupPlace)
    host.on_step = strike
    await load.reached(30)
    group = group_of(ref)
    name = other(group) if step == "peer" else group.membership.primary
    assert name is not None
    os.kill(pid_of(system, ref, name), signal.SIGKILL)
    await load.reached(50)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert hit == [step, step]


async def test_a_stopped_primary_that_wakes_up_changes_nothing(system: hf.ActorSystem) -> None:
    """T1, T2."""
    ref = await started(system)
    load = Load(ref)
    events = system.events()
    await load.reached(30)
    primary = group_of(ref).membership.primary
    assert primary is not None
    pid = pid_of(system, ref, primary)
    await stop_process(pid)
    await load.reached(30)
    with pytest.raises(ProcessLookupError):  # It was killed and reaped before another one led.
        os.kill(pid, signal.SIGCONT)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    over = [event for event in events.take() if isinstance(event, FailedOver)]
    assert [event.epoch for event in over] == [2]
    assert "no heartbeat" in over[0].why
    events.close()


async def test_a_silent_primary_that_nobody_could_replace_is_waited_for(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    ref = await started(system)
    group = group_of(ref)
    assert await ref.ask(Add(0)) == 1
    events = system.events()
    leads = group.membership.primary
    assert leads is not None
    pid = pid_of(system, ref, leads)
    os.kill(pid_of(system, ref, other(group)), signal.SIGKILL)
    await stop_process(pid)
    looks, real = list[bool](), Membership.is_awaited

    def is_awaited(known: Membership, name: str, lives: Lives, now: float, hopeless: float) -> bool:
        looks.append(real(known, name, lives, now, hopeless))
        return looks[-1]

    monkeypatch.setattr(Membership, "is_awaited", is_awaited)
    async with asyncio.timeout(30):
        while len(looks) < 3 and not group.membership.is_over:
            await asyncio.sleep(0.005)
    os.kill(pid, signal.SIGCONT)
    assert await ref.ask(Add(1), timeout=30) == 2
    seen = events.take()
    assert not any(isinstance(event, FailedOver) for event in seen)
    assert any(isinstance(event, WrongSuspicion) for event in seen)
    await two_again(ref)
    assert await ref.ask(Tags()) == [0, 1]
    events.close()


async def test_a_silent_successor_that_is_all_there_is_is_waited_for(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be building the actor from a large state, which nobody else has any more."""
    ref = await started(system)
    host: Any = ref._cell.host.place
    group = group_of(ref)
    assert await ref.ask(Add(0)) == 1
    first, heir, stopped = group.membership.primary, other(group), list[int]()
    assert first is not None
    looks, is_awaited = list[str](), Membership.is_awaited

    def looked(known: Membership, name: str, lives: Lives, now: float, hopeless: float) -> bool:
        looks.append(name)
        return is_awaited(known, name, lives, now, hopeless)

    monkeypatch.setattr(Membership, "is_awaited", looked)

    def stop_heir(step: str) -> None:
        if step == "lead" and not stopped:
            stopped.append(pid_of(system, ref, heir))
            os.kill(stopped[0], signal.SIGSTOP)

    host.on_step = stop_heir
    os.kill(pid_of(system, ref, first), signal.SIGKILL)
    async with asyncio.timeout(30):
        while looks.count(heir) < 10 and not group.membership.is_over:
            await asyncio.sleep(0.005)
    assert heir in group.membership.members
    os.kill(stopped[0], signal.SIGCONT)
    assert await ref.ask(Add(1), timeout=30) == 2
    await two_again(ref)
    assert await ref.ask(Tags()) == [0, 1]


async def test_a_stopped_backup_holds_nobody_up_for_long(system: hf.ActorSystem) -> None:
    ref = await started(system)
    load = Load(ref)
    await load.reached(30)
    group = group_of(ref)
    leads = group.membership.primary
    await stop_process(pid_of(system, ref, other(group)))
    await load.reached(100)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert group_of(ref).membership.primary == leads
    assert load.longest < 5.0


async def test_a_primary_that_wakes_up_before_it_is_killed_was_suspected_wrongly(system: hf.ActorSystem) -> None:
    ref = await started(system)
    events = system.events()
    group = group_of(ref)
    backup = other(group)
    life = group.membership.members[backup]
    group.membership.suspected[backup] = Suspicion(life, "a test wants it", 0.0, is_silence=True)  # Nobody was told.
    async with asyncio.timeout(10):
        while not any(isinstance(event, WrongSuspicion) for event in events.take()):
            await asyncio.sleep(0.005)
    assert group.replicas.wrong == 1
    assert await ref.ask(Add(0)) == 1
    events.close()


async def test_no_sign_of_life_saves_a_replica_that_has_to_be_replaced(system: hf.ActorSystem) -> None:
    ref = await started(system)
    group = group_of(ref)
    await two_again(ref)
    name = group.membership.primary
    assert name is not None
    life = group.membership.members[name]
    group.replicas.suspect(name, life, "a test wants it")
    group.replicas.heard(name, life)  # Before anybody has acted on that.
    async with asyncio.timeout(30):
        while group.membership.primary in (None, name):
            await asyncio.sleep(0.001)
    assert group.replicas.wrong == 0
    assert await ref.ask(Add(0)) == 1


async def test_what_asks_in_the_middle_of_its_turns_moves_no_money_twice(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account, 1000)))
    two = await system.start(hf.child("two", hf.start(Account, 1000)))
    ref = await started(system, hf.start(Bank), bindings={"one": one.path, "other": two.path})
    load, rng = Load(ref, clients=3, make=Transfer), random.Random(SEED)
    for _ in range(4):
        await load.reached(rng.randrange(1, 40))
        group = group_of(ref)
        name = rng.choice([group.membership.primary, other(group)])
        assert name is not None
        os.kill(pid_of(system, ref, name), signal.SIGKILL)
        await load.reached(10)
        await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    moved = len(load.answered)
    assert await one.ask(Put(0)) == 1000 - moved
    assert await two.ask(Put(0)) == 1000 + moved


async def test_a_message_that_kills_every_replica_is_quarantined(system: hf.ActorSystem) -> None:
    ref = await started(system, recovery=hf.hybrid(max_deliveries=3))
    assert await ref.ask(Add(0)) == 1
    with pytest.raises(hf.Quarantined):
        await ref.ask(Die(), timeout=60)
    assert await ref.ask(Add(1), timeout=30) == 2
    assert [one.address for one in system.quarantined(ref)] == [ref.path]


async def test_who_is_in_the_company_of_a_message_that_kills_is_handled(system: hf.ActorSystem) -> None:
    """They go in together, and it is found out whose fault it was."""
    ref = await started(system, recovery=hf.hybrid(max_deliveries=3))
    await system.suspend(ref)
    asked = [ref.ask(Add(tag), timeout=60) for tag in range(3)]
    died = ref.ask(Die(), timeout=60)
    asked += [ref.ask(Add(tag), timeout=60) for tag in range(3, 6)]
    await system.resume(ref)
    with pytest.raises(hf.Quarantined):
        await died
    assert await asyncio.gather(*asked) == [1, 2, 3, 4, 5, 6]
    assert await ref.ask(Tags(), timeout=30) == list(range(6))


async def test_an_actor_that_stops_itself_ends_for_good_if_its_spec_says_so(system: hf.ActorSystem) -> None:
    ref = await started(system, restart="transient")
    await ref.ask(Leave())
    async with asyncio.timeout(30):
        while ref._cell.state == "running":
            await asyncio.sleep(0.005)
    assert [path for path in system.tree() if path.startswith(f"{ref.path}/")] == []


async def test_stopping_ends_all_processes(system: hf.ActorSystem) -> None:
    ref = await started(system, recovery=hf.hybrid())
    assert await ref.ask(Add(0)) == 1
    pids = [pid_of(system, ref, name) for name in ("r1", "r2")]
    await system.stop(ref)
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    again = await started(system, recovery=hf.hybrid())
    assert await again.ask(Tags()) == [0]


async def test_control_reaches_the_replica_that_leads(system: hf.ActorSystem) -> None:
    ref = await started(system)
    await ref.ask(Add(7))
    assert await system.get_state(ref) == {"total": 1, "tags": [7]}
    with pytest.raises(hf.errors.ControlFailed, match="`protect` it by None"):
        await system.replace_state(ref, dict)
    await system.suspend(ref)
    asked = asyncio.ensure_future(ref.ask(Add(8)))
    assert (await system.get_status(ref)).state == "suspended"
    assert not asked.done()
    await system.resume(ref)
    assert await asked == 2


async def test_with_a_store_a_protected_actor_comes_back_after_a_restart_of_the_root(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'store.db'}"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await started(system, recovery=hf.hybrid(interval=0.05))
        for tag in range(20):
            await ref.ask(Add(tag))
        os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
        assert await ref.ask(Add(20), timeout=30) == 21
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await started(system, recovery=hf.hybrid(interval=0.05))
        assert await ref.ask(Tags()) == list(range(21))
        assert await ref.ask(Add(21)) == 22


async def test_without_state_access_a_follower_is_there_before_the_first_request(system: hf.ActorSystem) -> None:
    """Later nobody could be brought to what the leader has."""
    ref = await system.start(hf.child("alice", hf.start(Closed), mechanism=LFR()))
    assert await ref.ask(Add(1), timeout=60) == 1
    os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
    assert await ref.ask(Add(2), timeout=60) == 2


@pytest.mark.parametrize("mechanism", [hf.ftm.PBR(), hf.ftm.LFR()], ids=["pbr", "lfr"])
async def test_one_that_comes_back_fresh_leads_on_from_no_state(system: hf.ActorSystem, mechanism: Any) -> None:
    recovery = hf.hybrid(interval=3600.0, on_escalate="fresh")
    spec = hf.child("counter", hf.start(Counter), mechanism=mechanism, recovery=recovery)
    await system.start(hf.supervisor("team", children=[spec], intensity=0))
    ref = system.ref("/app/team/counter", Counter)
    assert await ref.ask(Add(0, 5), timeout=60.0) == 5
    with system.events() as stream:
        for name in group_of(ref).membership.names:
            os.kill(pid_of(system, ref, name), signal.SIGKILL)
        async with asyncio.timeout(30.0):
            async for one in stream:
                if isinstance(one, hf.events.ActorStarted) and one.address == ref.path:
                    break
    again = system.ref(ref.path, Counter)
    assert await again.ask(Add(1), timeout=30.0) == 1
    assert await again.ask(Tags(), timeout=30.0) == [1]
