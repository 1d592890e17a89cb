"""The death of the fork server is one fault, however many processes end with it: for restarts, and for messages."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import psutil
import pytest

import holdfast as hf
from holdfast.actors.events import ActorStarted, ChildRestarted, ChildTerminated, MessageQuarantined, SupervisorGaveUp
from holdfast.supervision.spec import Strategy
from tests.actors.process.fork_players import Add, Counter, Eat, Leaving, Life, Linger, SlowToReturn, Stray
from tests.actors.process.waiting import end_of, next_event, until

MANY = 6


def fork_server(system: hf.ActorSystem, ref: hf.ActorRef[hf.Actor]) -> int:
    parent = psutil.Process(system.pid_of(ref)).ppid()
    assert parent != os.getpid()
    return parent


def counters(count: int = MANY, **more: object) -> list[hf.ChildSpec]:
    return [hf.child(f"c{n}", hf.start(Counter), isolation="process", **more) for n in range(count)]  # type: ignore[arg-type]


async def lives(system: hf.ActorSystem, above: str, count: int = MANY) -> list[int]:
    refs = [system.ref(f"{above}/c{n}", hf.Actor) for n in range(count)]
    return list(await asyncio.gather(*(ref.ask(Life(), timeout=60.0) for ref in refs)))


async def test_many_children_of_the_root_come_back_and_count_once() -> None:
    async with hf.ActorSystem("app", log=False, intensity=1) as system:
        refs = [await system.start(spec) for spec in counters()]
        server = fork_server(system, refs[0])
        with system.events() as events:
            os.kill(server, signal.SIGKILL)
            ended = [await next_event(events, ChildTerminated) for _ in refs]
        assert await lives(system, "/app") == [2] * MANY
        assert {event.reason for event in ended} == {hf.ForkServerDied(server, "SIGKILL")}
        assert max(event.restarts for event in ended) <= 1


@pytest.mark.parametrize(
    ("strategy", "order"),
    [("one_for_all", range(MANY)), ("rest_for_one", range(MANY)), ("rest_for_one", range(MANY)[::-1])],
)
async def test_a_group_is_restarted_once(strategy: Strategy, order: range) -> None:
    """Whatever process was forked, and is seen to end, first."""
    async with hf.ActorSystem("app", log=False) as system:
        group = hf.supervisor("group", strategy=strategy, children=counters(), intensity=1)
        top = await system.start(group)
        for n in order:  # From here on their processes have another order.
            await top.ask(hf.TerminateChild(f"c{n}"))
            await top.ask(hf.RestartChild(f"c{n}"))
        before = await lives(system, "/app/group")
        with system.events() as events:
            os.kill(fork_server(system, system.ref("/app/group/c0", hf.Actor)), signal.SIGKILL)
            await next_event(events, ChildRestarted)
            assert await lives(system, "/app/group") == [life + 1 for life in before]
            assert [event for event in events.take() if isinstance(event, ChildRestarted)] == []


async def test_each_death_of_a_fork_server_counts() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("group", children=counters(), intensity=2, period=600.0))
        first = system.ref("/app/group/c0", hf.Actor)
        with system.events() as events:
            for n in range(2):
                os.kill(fork_server(system, first), signal.SIGKILL)
                for _ in range(MANY):
                    await next_event(events, ActorStarted)
                assert await lives(system, "/app/group") == [n + 2] * MANY
            os.kill(fork_server(system, first), signal.SIGKILL)
            gave_up = await next_event(events, SupervisorGaveUp)
        assert gave_up.address == "/app/group"
        assert isinstance(gave_up.reason, hf.ForkServerDied)


async def test_supervisors_that_give_up_by_one_cause_count_once_above_them() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        teams = [hf.supervisor(f"t{n}", children=counters(2), intensity=0) for n in range(MANY)]
        await system.start(hf.supervisor("teams", children=teams, intensity=1, period=600.0))
        with system.events() as events, system.events() as everything:
            os.kill(fork_server(system, system.ref("/app/teams/t0/c0", hf.Actor)), signal.SIGKILL)
            for _ in range(2 * MANY):
                await next_event(events, ActorStarted, lambda event: event.address[-2:] in ("c0", "c1"))
            gave_up = [event.address for event in everything.take() if isinstance(event, SupervisorGaveUp)]
        assert sorted(gave_up) == [f"/app/teams/t{n}" for n in range(MANY)]


async def test_processes_that_end_by_themselves_count_each() -> None:
    """What ends one process is its own fault, also when it strikes several one after another: memory, or a signal."""
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(hf.supervisor("group", children=counters(3), intensity=2, period=600.0))
        with system.events() as events:
            for n in range(2):
                system.ref(f"/app/group/c{n}", hf.Actor).tell(Eat())
                assert isinstance((await next_event(events, ChildRestarted)).reason, hf.OutOfMemory)
            os.kill(system.pid_of(system.ref("/app/group/c2", hf.Actor)), signal.SIGKILL)
            gave_up = await next_event(events, SupervisorGaveUp)
        assert gave_up.reason == hf.Signal(signal.SIGKILL)


async def test_starts_that_fail_by_a_second_death_count_once(tmp_path: Path) -> None:
    waiting, gate = tmp_path / "waiting", tmp_path / "gate"
    waiting.mkdir()
    start = hf.start(SlowToReturn, str(gate), str(waiting))
    async with hf.ActorSystem("app", log=False) as system:
        slow = [hf.child(f"c{n}", start, isolation="process") for n in range(MANY)]
        await system.start(hf.supervisor("group", children=slow, intensity=2, period=600.0))
        os.kill(fork_server(system, system.ref("/app/group/c0", hf.Actor)), signal.SIGKILL)
        await until(lambda: len(list(waiting.glob("*-2"))) == MANY)
        server = system._workers._server
        assert server is not None
        os.kill(server.pid, signal.SIGKILL)
        await until(lambda: len(list(waiting.glob("*-3"))) == MANY)
        gate.touch()
        assert await lives(system, "/app/group") == [3] * MANY


async def test_protected_actors_whose_start_fails_by_a_second_death_count_once() -> None:
    """Their replicas have processes, and nobody could take over yet."""
    async with hf.ActorSystem("app", log=False) as system:
        groups = [
            hf.child(f"c{n}", hf.start(Counter), mechanism=hf.ftm.PBR(), recovery=hf.hybrid()) for n in range(MANY)
        ]
        await system.start(hf.supervisor("group", children=groups, intensity=3, period=600.0))
        workers = system._workers
        first = workers._server
        assert first is not None
        with system.events() as events:
            os.kill(first.pid, signal.SIGKILL)
            await next_event(events, ChildRestarted)
            await until(lambda: sum("/ftm/" in home for home in workers.pids.values()) >= MANY)
            second = workers._server
            assert second is not None
            os.kill(second.pid, signal.SIGKILL)
            for n in range(MANY):
                await system.ref(f"/app/group/c{n}", hf.Actor).ask(Add(), timeout=60.0)
            assert not [event for event in events.take() if isinstance(event, SupervisorGaveUp)]


@pytest.mark.parametrize("place", ["of its own", "of its supervisor"])
async def test_the_message_in_its_turn_is_not_blamed(tmp_path: Path, place: str) -> None:
    begun, gate = tmp_path / "begun", tmp_path / "gate"
    method = hf.hybrid(max_deliveries=1)
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        if place == "of its own":
            own = hf.child("counter", hf.start(Counter), isolation="process", recovery=method)
            ref = await system.start(own)
        else:
            child = hf.child("counter", hf.start(Counter), recovery=method)
            await system.start(hf.supervisor("group", isolation="process", children=[child]))
            ref = system.ref("/app/group/counter", Counter)
        assert await ref.ask(Add()) == 1
        with system.events() as events:
            answer = ref.ask(Linger(str(begun), str(gate)), timeout=60.0)
            waiting = asyncio.ensure_future(answer)
            for deaths in (1, 2):
                await until(lambda deaths=deaths: begun.exists() and begun.read_text().count("\n") == deaths)  # type: ignore[misc]
                os.kill(system._workers._server.pid, signal.SIGKILL)  # type: ignore[union-attr]
            gate.touch()
            assert await waiting == 2
            assert not [event for event in events.take() if isinstance(event, MessageQuarantined)]


async def test_a_stray_that_keeps_a_socket_open_holds_up_nobody_for_long(tmp_path: Path) -> None:
    """What has left the process group of its actor lives on; the end of the socket never comes."""
    gate = tmp_path / "gate"
    async with hf.ActorSystem("app", log=False, intensity=1) as system:
        refs = [await system.start(hf.child(f"c{n}", hf.start(Leaving), isolation="process")) for n in range(2)]
        stray = os.pidfd_open(await refs[0].ask(Stray(str(gate))))
        with system.events() as events:
            os.kill(fork_server(system, refs[0]), signal.SIGKILL)
            try:
                async with asyncio.timeout(20.0):
                    for _ in refs:
                        await next_event(events, ActorStarted)
            finally:
                gate.touch()
        assert await lives(system, "/app", 2) == [2, 2]
        await end_of(stray)
        os.close(stray)


async def test_why_names_the_fork_server() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(counters(1)[0])
        server = fork_server(system, ref)
        with system.events() as events:
            os.kill(server, signal.SIGKILL)
            await next_event(events, ActorStarted)
        said = " ".join(await system.why("/app/c0"))
    assert f"its process ended with the fork server (pid {server}: SIGKILL)" in said
    assert "no fault of its own" in said
