"""A helper process that a signal has stopped is told to go on when it is needed, and never holds up the end."""

from __future__ import annotations

import os
import signal
import time

import psutil
import pytest

import holdfast as hf
from tests.actors.process.stopped_player import Compute, Large, Member, Pid
from tests.actors.process.waiting import next_event, until
from tests.supervision.programs import Ends, hang, info, keeper_of, python
from tests.warm import own_children

PROGRAM = "import time\nprint('up', flush=True)\ntime.sleep(99)"


def member(**options: object) -> hf.ChildSpec[Member]:
    return hf.child("it", hf.start(Member), isolation="process", **options)  # type: ignore[arg-type]


def fork_server(system: hf.ActorSystem, ref: hf.ActorRef[hf.Actor]) -> psutil.Process:
    found = psutil.Process(system.pid_of(ref)).parent()
    assert found is not None
    return found


async def test_a_fork_server_goes_on_when_a_process_is_needed() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(member(recovery=hf.hybrid()))
        server = fork_server(system, ref)
        before = system.pid_of(ref)
        with system.events() as events:
            server.suspend()
            begin = time.monotonic()
            os.kill(before, signal.SIGKILL)
            assert await ref.ask(Pid(), 30) != before
            assert time.monotonic() - begin < 2.0
            stuck = await next_event(events, hf.events.HelperStuck)
        assert (stuck.address, stuck.helper, stuck.pid) == ("/app", "fork server", server.pid)
        assert fork_server(system, ref) == server


async def test_a_warm_process_that_is_stopped_is_given_to_nobody() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        await system.start(member())
        await until(lambda: "" in system._workers.pids.values())
        warm = next(pid for pid, address in system._workers.pids.items() if not address)
        stopped = psutil.Process(warm)
        stopped.suspend()
        await until(lambda: stopped.status() == psutil.STATUS_STOPPED)
        other = await system.start(hf.child("other", hf.start(Member), isolation="process", start_timeout=10.0))
        assert await other.ask(Pid(), 5) != warm
        await until(lambda: not psutil.pid_exists(warm))


async def test_a_function_of_an_effect_goes_on() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("it", hf.start(Member)))
        assert await ref.ask(Compute(), 15) == "it went on"


async def test_whoever_writes_a_large_state_goes_on() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(
            hf.child("it", hf.start(Large), isolation="process", recovery=hf.hybrid(interval=99.0))
        )
        await ref.ask(Pid(), 30)
        with system.events() as events:
            await system.checkpoint(ref)
            await next_event(events, hf.events.SnapshotTaken)


@pytest.mark.parametrize("who", ["keeper", "fork server", "warm", "actor", "effect", "all"])
async def test_the_system_ends_in_time_with_each_of_them_stopped(ends: Ends, who: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(member(shutdown=0.3))
        await system.start(python(PROGRAM, id="program", ready="up"))
        await until(lambda: "" in system._workers.pids.values())
        program = (await info(system, "/app/program")).pid
        keeper, server, actor = keeper_of(program), fork_server(system, ref), system.pid_of(ref)
        warm = next(pid for pid, address in system._workers.pids.items() if not address)
        roles = {"keeper": keeper.pid, "fork server": server.pid, "warm": warm, "actor": actor}
        if who in ("effect", "all"):
            runner = await system.start(hf.child("runner", hf.start(Member)))
            await runner.ask(Compute(), 30)
            roles["effect"] = next(child.pid for child in own_children() if child not in (keeper, server))
        ends.add(program, *roles.values())
        for pid in roles.values() if who == "all" else (roles[who],):
            os.kill(pid, signal.SIGSTOP)
        begin = time.monotonic()
    assert time.monotonic() - begin < 3.0
    await ends.all()


async def test_the_system_ends_in_time_with_a_fork_server_that_hangs(ends: Ends) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(member())
        server = fork_server(system, ref)
        ends.add(system.pid_of(ref), server.pid)
        hang(server.pid)
        begin = time.monotonic()
    assert time.monotonic() - begin < 9.0
    await ends.all()
