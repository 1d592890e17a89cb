"""Children with a process of their own, below a supervisor that has one too: it decides, the root has the processes."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from pathlib import Path
from typing import Any

import psutil
import pytest

import holdfast as hf
from tests.actors.process.players import Account, Add, Fail, Total
from tests.actors.process.waiting import until

RECORDED = pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])


def team(recovery: hf.Method | None = None, **options: Any) -> hf.ChildSpec:
    """`/app/team` in a process, with `alice` in another and `bob` beside it."""
    alice = hf.child("alice", hf.start(Account, 100), isolation="process", recovery=recovery, **options)
    bob = hf.child("bob", hf.start(Account, 10), recovery=recovery)
    return hf.supervisor("team", children=[alice, bob], isolation="process", intensity=100)


def at(system: hf.ActorSystem, name: str) -> hf.ActorRef[Account]:
    return system.ref(f"/app/team/{name}", Account)


def pids(system: hf.ActorSystem) -> tuple[int, int]:
    """Of the supervisor's process, and of that of `alice`."""
    return system.pid_of(system.ref("/app/team", hf.Supervisor)), system.pid_of(at(system, "alice"))


async def is_gone(pid: int) -> None:
    await until(lambda: not psutil.pid_exists(pid))


@RECORDED
async def test_it_has_a_process_and_its_supervisor_restarts_it(
    system: hf.ActorSystem, recovery: hf.Method | None
) -> None:
    await system.start(team(recovery))
    above, own = pids(system)
    assert len({above, own, os.getpid()}) == 3
    assert system.pid_of(at(system, "bob")) == above
    alice = at(system, "alice")
    assert await alice.ask(Add(1)) == 101
    with pytest.raises(hf.RemoteCrash):
        await alice.ask(Fail("oops"))
    assert await alice.ask(Add(1), timeout=30.0) == (102 if recovery else 101)
    os.kill(system.pid_of(alice), signal.SIGKILL)
    assert await alice.ask(Add(1), timeout=30.0) == (103 if recovery else 101)
    assert pids(system)[0] == above
    assert len({above, own, pids(system)[1]}) == 3


@RECORDED
async def test_it_ends_with_its_supervisor_and_comes_back_with_it(
    system: hf.ActorSystem, recovery: hf.Method | None
) -> None:
    await system.start(team(recovery))
    alice = at(system, "alice")
    assert await alice.ask(Add(1)) == 101
    above, own = pids(system)
    os.kill(above, signal.SIGKILL)
    await is_gone(own)
    assert await alice.ask(Add(1), timeout=30.0) == (102 if recovery else 101)
    assert not {above, own} & set(pids(system))


@RECORDED
async def test_a_stop_of_the_supervisor_ends_it(system: hf.ActorSystem, recovery: hf.Method | None) -> None:
    ref = await system.start(team(recovery))
    alice, own = at(system, "alice"), pids(system)[1]
    assert await alice.ask(Add(1)) == 101
    await system.stop(ref)
    await is_gone(own)
    with pytest.raises(hf.ActorStopped):
        await alice.ask(Total())
    assert not [path for path in system.tree() if path.startswith("/app/team")]


@RECORDED
async def test_it_is_stopped_and_started_again_by_its_supervisor(
    system: hf.ActorSystem, recovery: hf.Method | None
) -> None:
    ref = await system.start(team(recovery))
    assert await at(system, "alice").ask(Add(1)) == 101
    own = pids(system)[1]
    await ref.ask(hf.TerminateChild("alice"))
    await is_gone(own)
    assert {one.id: one.state for one in await ref.ask(hf.WhichChildren())}["alice"] == "stopped"
    alice = await ref.ask(hf.RestartChild("alice"))
    assert await alice.ask(Add(1)) == (102 if recovery else 101)


async def test_what_is_sent_while_it_is_restarted_waits(system: hf.ActorSystem) -> None:
    await system.start(team(hf.hybrid(), backoff=hf.Backoff(initial=0.1)))
    alice = at(system, "alice")
    asks = []
    for number in range(60):
        if number % 20 == 10:
            await alice.ask(Total(), timeout=60.0)
            os.kill(system.pid_of(alice), signal.SIGKILL)
        asks.append(alice.ask(Add(1), timeout=60.0))
        await alice.send(Add(1))
    await asyncio.gather(*asks)
    assert await alice.ask(Total()) == 100 + 2 * 60


async def test_it_is_killed_with_its_supervisor_at_any_moment(system: hf.ActorSystem) -> None:
    """Either dies, or both: each addition that was answered is in the state, once."""
    await system.start(team(hf.hybrid()))
    alice, done = at(system, "alice"), 0
    for number in range(12):
        waiting = alice.ask(Add(1), timeout=60.0)
        for _ in range(number * 7 % 23):
            await asyncio.sleep(0)
        for pid in pids_now(system)[number % 3 : number % 3 + 1 + number % 2]:
            with contextlib.suppress(ProcessLookupError):  # The other end took it along.
                os.kill(pid, signal.SIGKILL)
        assert await waiting == 100 + done + 1
        done += 1
    assert await alice.ask(Total(), timeout=60.0) == 100 + done


def pids_now(system: hf.ActorSystem) -> list[int]:
    """The processes that there are just now, of those two."""
    found = []
    for path in ("/app/team", "/app/team/alice", "/app/team"):
        try:
            found.append(system.pid_of(system.ref(path, hf.Actor)))
        except hf.errors.NoSuchActor:
            continue
    return [pid for pid in found if pid != os.getpid() and psutil.pid_exists(pid)]


@pytest.mark.parametrize("who", ["alice", "bob"])
async def test_who_waits_for_room_is_let_in_by_the_next_life(system: hf.ActorSystem, who: str) -> None:
    children = [
        hf.child("alice", hf.start(Account), isolation="process", recovery=hf.hybrid(), mailbox=hf.bounded(2)),
        hf.child("bob", hf.start(Account), recovery=hf.hybrid(), mailbox=hf.bounded(2)),
    ]
    await system.start(hf.supervisor("team", children=children, isolation="process", intensity=100))
    ref = at(system, who)
    await ref.ask(Total())
    await system.suspend(ref)
    waiting: list[asyncio.Future[Any]] = [ref.ask(Add(1), timeout=60.0) for _ in range(6)]
    waiting += [asyncio.ensure_future(ref.send(Add(1))) for _ in range(3)]
    await asyncio.sleep(0)
    os.kill(system.pid_of(ref), signal.SIGKILL)  # The suspension ends with the life.
    async with asyncio.timeout(30.0):
        await asyncio.gather(*waiting)
    assert await ref.ask(Total()) == 9


@RECORDED
async def test_it_moves_to_its_supervisor_and_back_and_stays_there(
    system: hf.ActorSystem, recovery: hf.Method | None
) -> None:
    await system.start(team(recovery))
    alice = at(system, "alice")
    assert await alice.ask(Add(1)) == 101
    await system.set_isolation(alice, "task", timeout=60.0)
    assert system.pid_of(alice) == pids(system)[0]
    assert await alice.ask(Add(0)) == 101
    alice.tell(Fail("oops"))
    assert await alice.ask(Add(1), timeout=30.0) == (102 if recovery else 101)
    assert system.pid_of(alice) == pids(system)[0]
    await system.set_isolation(alice, "process", timeout=60.0)
    assert await alice.ask(Add(0)) == (102 if recovery else 101)
    for total in (103, 104) if recovery else (102, 101):
        assert await alice.ask(Add(1), timeout=30.0) == total
        assert len(set(pids(system))) == 2
        os.kill(system.pid_of(alice), signal.SIGKILL)
    assert await alice.ask(Add(1), timeout=30.0) == (105 if recovery else 101)
    above, own = pids(system)
    os.kill(above, signal.SIGKILL)
    await is_gone(own)
    assert await alice.ask(Add(1), timeout=30.0) == (106 if recovery else 101)
    assert len(set(pids(system))) == 2


@RECORDED
async def test_it_is_protected_and_lives_there_again_after_that(
    system: hf.ActorSystem, recovery: hf.Method | None
) -> None:
    await system.start(team(recovery))
    alice = at(system, "alice")
    for mechanism in (hf.ftm.PBR(), hf.ftm.LFR(), None):
        async with system.transaction(timeout=60.0) as change:
            change.protect(alice, mechanism)
        assert await alice.ask(Add(1), timeout=30.0) > 100
    assert len(set(pids(system))) == 2
    os.kill(system.pid_of(alice), signal.SIGKILL)
    assert await alice.ask(Total(), timeout=30.0) == (103 if recovery else 100)
    assert len(set(pids(system))) == 2


async def test_the_next_root_has_it_as_it_was(tmp_path: Path) -> None:
    for total in (101, 102):
        async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'a.db'}") as system:
            await system.start(team(hf.hybrid()))
            assert await at(system, "alice").ask(Add(1), timeout=30.0) == total
            assert len(set(pids(system))) == 2


async def test_limits_are_those_of_its_spec(system: hf.ActorSystem) -> None:
    await system.start(team(limits=hf.Limits(niceness=3)))
    above, own = (psutil.Process(pid).nice() for pid in pids(system))
    assert own == min(above + 3, 19)


@pytest.mark.parametrize("who", ["alice", "bob"])
@RECORDED
async def test_whoever_terminates_it_hears_when_it_has_ended(
    system: hf.ActorSystem, recovery: hf.Method | None, who: str
) -> None:
    await system.start(team(recovery))
    ref, reason = at(system, who), hf.Shutdown("enough")
    assert await ref.ask(Add(1)) > 10
    for _ in range(2):
        assert await system.terminate(ref, reason, timeout=30.0) == reason
        assert await ref.ask(Total(), timeout=30.0) in (10, 11, 100, 101)
