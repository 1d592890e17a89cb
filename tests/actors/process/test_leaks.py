"""Nothing is left behind: no zombie, no orphan, no descriptor, no task, however processes end.

The fixtures of `tests/conftest.py` look for what a test leaves; these tests provoke it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

import holdfast as hf
from holdfast.actors.events import ProcessDied
from tests.actors.process.players import Account, Add, Picky, Run, Total, Worker
from tests.actors.process.waiting import end_of, next_event, until
from tests.warm import own_children

KILLS = 200


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def zombies() -> list[psutil.Process]:
    return [child for child in psutil.Process().children(recursive=True) if child.status() == psutil.STATUS_ZOMBIE]


async def test_two_hundred_kills_under_load(system: hf.ActorSystem) -> None:
    """R28, T14: each kill is survived, and costs nothing that is not given back."""
    account = await system.start(hf.child("account", hf.start(Account), isolation="process"))
    await account.ask(Add(1))
    tasks, files = len(asyncio.all_tasks()), open_files()
    counts = {"answered": 0, "failed": 0}
    running = True

    async def load() -> None:
        while running:
            asks = [account.ask(Add(1), timeout=60) for _ in range(20)]
            for outcome in await asyncio.gather(*asks, return_exceptions=True):
                counts["failed" if isinstance(outcome, hf.AskFailed) else "answered"] += 1
                assert isinstance(outcome, int | hf.AskFailed), outcome

    loading = [asyncio.ensure_future(load()) for _ in range(3)]
    pids = set()
    for _ in range(KILLS):
        pid = system.pid_of(account)
        pids.add(pid)
        os.kill(pid, signal.SIGKILL)
        await until(lambda pid=pid: system._workers.processes().get("/app/account", pid) != pid)  # type: ignore[misc]
        answered = counts["answered"]
        await until(lambda answered=answered: counts["answered"] > answered)  # type: ignore[misc]
    running = False
    await asyncio.gather(*loading)
    assert len(pids) > KILLS * 0.9, "pids come again only after all others"
    assert not zombies()
    assert system._workers.processes().keys() == {"/app/account"}
    await until(lambda: len(system._workers._alive) <= 2)  # the actor's and the warm one
    await until(lambda: len(asyncio.all_tasks()) <= tasks + 1)
    assert open_files() <= files + 8, "descriptors of one more warm process, at most"
    assert not account._cell.queue


async def test_many_actors_die_at_once(system: hf.ActorSystem) -> None:
    refs = [await system.start(hf.child(f"a{n}", hf.start(Account), isolation="process")) for n in range(20)]
    for ref in refs:
        os.kill(system.pid_of(ref), signal.SIGKILL)
    assert await asyncio.gather(*(ref.ask(Add(2), timeout=30) for ref in refs)) == [2] * 20
    assert not zombies()


async def test_starts_that_fail_leave_nothing(system: hf.ActorSystem) -> None:
    await system.start(hf.child("account", hf.start(Account), isolation="process"))
    await until(lambda: len(system._workers._ready) == 1)
    files = open_files()
    for number in range(10):
        with pytest.raises(hf.StartFailed):
            await system.start(hf.child(f"p{number}", hf.start(Picky), isolation="process"))
    await until(lambda: len(system._workers._ready) == 1 and len(system._workers._alive) == 2)
    assert open_files() <= files
    assert not zombies()


async def test_the_fork_server_killed_and_all_come_back(system: hf.ActorSystem) -> None:
    """DESIGN 5: if the fork server dies the root starts another and recovers all."""
    refs = [await system.start(hf.child(f"a{n}", hf.start(Account), isolation="process")) for n in range(5)]
    for _ in range(3):
        server = system._workers._server
        assert server is not None
        before = {system.pid_of(ref) for ref in refs}
        queued = [ref.ask(Add(1), timeout=30) for ref in refs]
        with system.events() as events:
            os.kill(server.pid, signal.SIGKILL)
            outcomes = await asyncio.gather(*queued, return_exceptions=True)
            died = {(await next_event(events, ProcessDied)).pid for _ in refs}
        assert died == before
        assert all(isinstance(outcome, int | hf.AskFailed) for outcome in outcomes), outcomes
        assert len(await asyncio.gather(*(ref.ask(Total(), timeout=30) for ref in refs))) == 5
        after = {system.pid_of(ref) for ref in refs}
        assert len(after) == 5
        assert not after & before
    assert not zombies()


async def test_what_an_actor_has_started_ends_with_the_fork_server(system: hf.ActorSystem) -> None:
    """The actor's process dies with the server that would have ended it; the next one finds its port free."""
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
    program = psutil.Process(await worker.ask(Run("start_program"), timeout=60.0))
    server = psutil.Process(system.pid_of(worker)).parent()
    assert server is not None
    server.kill()
    await until(lambda: not program.is_running() or program.status() == psutil.STATUS_ZOMBIE)
    assert await worker.ask(Total(), timeout=60.0) == 0


@pytest.mark.parametrize("victim", ["server", "spare"])
async def test_no_actor_is_given_a_process_that_is_about_to_end(system: hf.ActorSystem, victim: str) -> None:
    """A start attempt lost that way would count as a restart. Nothing runs here between the death and the taking."""
    await system.start(hf.child("account", hf.start(Account), isolation="process"))
    workers = system._workers
    await until(lambda: len(workers._ready) == 1)
    spare = workers._ready[0]
    pid = spare.pid if victim == "spare" else spare.server.pid
    pidfd = os.pidfd_open(pid)
    os.kill(pid, signal.SIGKILL)
    assert ended(pidfd)
    os.close(pidfd)
    taken = await workers.take()
    assert taken is not spare
    assert taken.is_alive()
    taken.kill(hf.KILLED)


async def test_a_process_that_has_ended_launches_nobody(system: hf.ActorSystem) -> None:
    """It may have ended since it was taken: then its end has been told, and nobody would end the launch."""
    ref = await system.start(hf.child("account", hf.start(Account), isolation="process"))
    taken = await system._workers.take()
    taken.kill(hf.KILLED)
    await taken.gone()
    with pytest.raises(hf.StartFailed, match="its process has ended"):
        await asyncio.wait_for(taken.launch(ref._cell, b"", {}), 60.0)


async def test_a_stopped_system_leaves_no_process_that_an_actor_started() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
        program = os.pidfd_open(await worker.ask(Run("start_program")))
        pids = [os.pidfd_open(pid) for pid in (system.pid_of(worker), system._workers._server.pid)]  # type: ignore[union-attr]
    for pidfd in (program, *pids):
        await end_of(pidfd)
        os.close(pidfd)


async def test_shutdown_while_processes_start_leaves_none() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        children = [hf.child(f"a{n}", hf.start(Account), isolation="process") for n in range(5)]
        starting = [asyncio.ensure_future(system.start(child)) for child in children]
        await asyncio.sleep(0)
    outcomes = await asyncio.gather(*starting, return_exceptions=True)
    assert len(outcomes) == 5, "each start has an outcome"
    assert not own_children()


PROGRAM = """
    import os, sys
    import holdfast as hf
    from tests.actors.process.players import Account, Run, Where, Worker

    async def main():
        async with hf.ActorSystem("app", log=False) as system:
            refs = [await system.start(hf.child(f"a{n}", hf.start(Worker), isolation="process", shutdown=0.5))
                    for n in range(3)]
            team = hf.supervisor("team", isolation="process", children=[hf.child("x", hf.start(Worker))])
            await system.start(team)
            pids = [await ref.ask(Where()) for ref in refs]
            pids.append(await system.ref("/app/team/x", Worker).ask(Where()))
            pids.append(await refs[0].ask(Run("start_program")))
            pids.append(system._workers._server.pid)
            refs[1].tell(Run("loop", sys.argv[1]))
            while not os.path.exists(sys.argv[1]):
                await refs[2].ask(Where())
            print(*pids, flush=True)
            await refs[1].ask(Where(), timeout=600)

    if __name__ == "__main__":
        hf.run(main())
"""


@pytest.fixture
def program(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A root process with actors in processes, one of them stuck in its handler; and pidfds of all of these."""
    script = tmp_path / "program.py"
    script.write_text(textwrap.dedent(PROGRAM))
    root = Path(__file__).parents[3]
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join([str(root), *filter(None, sys.path)]))
    with subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "begun")], stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        pidfds: list[int] = []
        try:
            assert process.stdout is not None
            pidfds += [os.pidfd_open(int(pid)) for pid in process.stdout.readline().split()]
            assert len(pidfds) == 6
            yield process, pidfds
        finally:
            process.kill()
            for pidfd in pidfds:
                os.close(pidfd)


def ended(pidfd: int) -> bool:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(20_000))


def test_the_root_killed_and_no_process_is_left(program: tuple[subprocess.Popen[str], list[int]]) -> None:
    """Children end on their socket's end, stuck ones by the fork server, which ends with its parent."""
    process, pidfds = program
    process.send_signal(signal.SIGKILL)
    assert all(ended(pidfd) for pidfd in pidfds)


def test_root_and_fork_server_killed_together(program: tuple[subprocess.Popen[str], list[int]]) -> None:
    """Then nobody is left to kill; the kernel does it. (A program an actor had started is not its to end.)"""
    process, pidfds = program
    *actors, started, server = pidfds
    signal.pidfd_send_signal(server, signal.SIGKILL)
    process.send_signal(signal.SIGKILL)
    assert all(ended(pidfd) for pidfd in (*actors, server))
    with contextlib.suppress(ProcessLookupError):
        signal.pidfd_send_signal(started, signal.SIGKILL)


def test_sigterm_stops_the_root_in_order(program: tuple[subprocess.Popen[str], list[int]]) -> None:
    process, pidfds = program
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=30) == 143
    assert all(ended(pidfd) for pidfd in pidfds)
