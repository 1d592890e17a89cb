"""The operating system refuses something: who asked hears why, or it is tried again; nothing else ends for it."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import socket
from typing import Any

import psutil
import pytest

import holdfast as hf
from holdfast.actors.process import worker_pool
from holdfast.actors.process.fork import fork_server, launch
from tests.actors.process.players import Account, Add, Total, Where
from tests.actors.process.waiting import until
from tests.supervision.programs import hang
from tests.warm import own_children


def account(name: str) -> hf.ChildSpec:
    return hf.child(name, hf.start(Account), isolation="process")


def servers() -> list[psutil.Process]:
    """The fork servers of this program."""
    return own_children()


class Refusing:
    """Stands before a call of the system and refuses it while there is something `left` to refuse."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, number: int) -> None:
        self.left = self.refused = 0
        call, error = getattr(owner, name), OSError(number, os.strerror(number))

        def refusing(*args: Any) -> Any:
            if not self.left:
                return call(*args)
            self.left -= 1
            self.refused += 1
            raise error

        monkeypatch.setattr(owner, name, refusing)


async def warmed_up(system: hf.ActorSystem) -> None:
    """Wait until a process is in reserve, so that nobody asks for one of himself."""
    await until(lambda: bool(system._workers._ready))


async def test_a_refusal_is_told_and_keeps_the_fork_server(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    await system.start(account("first"))
    await warmed_up(system)
    (server,) = servers()
    refusing = Refusing(monkeypatch, socket, "socketpair", errno.EMFILE)
    refusing.left = 1000
    await system.start(account("second"))  # the one in reserve
    for name in ("third", "fourth"):
        with pytest.raises(hf.StartFailed, match=os.strerror(errno.EMFILE)):
            await system.start(account(name))
    refusing.left = 0
    await system.start(account("fifth"))
    assert servers() == [server]


async def test_a_fork_server_that_was_replaced_ends_with_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    defaults = fork_server.ForkServer.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "fork_seconds", 1.0)
    async with hf.ActorSystem("app", log=False) as system:
        first = await system.start(account("first"))
        await warmed_up(system)
        (hung,) = servers()
        await system.start(account("second"))
        await warmed_up(system)
        hang(hung.pid)
        await system.start(account("third"))  # the one in reserve
        await system.start(account("fourth"))
        assert len(servers()) == 2
        assert await first.ask(Add(1)) == 1
    assert servers() == []


async def test_a_process_of_whose_end_nobody_has_told_in_time_leaves_nothing_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its fork server does not answer, and what waits for its word comes too late, as on a busy machine."""

    def late(worker: worker_pool.Worker) -> None:
        if worker.end.is_complete:
            worker.bury()

    monkeypatch.setattr(worker_pool, "REAPED_WITHIN", 0.05)
    async with hf.ActorSystem("app", log=False) as system:
        await system.stop(await system.start(account("first")))
        await warmed_up(system)
        (hung,) = servers()
        (reserve,) = system._workers._alive.values()
        monkeypatch.setattr(worker_pool.Worker, "_bury_soon", late)
        hang(hung.pid)
    assert servers() == []
    assert reserve.forked.pidfd == -1


async def test_a_fork_server_whose_start_is_given_up_twice_ends_with_the_system(
    cold_fork_servers: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    start_server = launch.exec_server

    def exec_and_hang(*args: Any) -> Any:
        process = start_server(*args)
        hang(process.pid)  # It does not get ready before it is given up.
        return process

    monkeypatch.setattr(fork_server, "exec_server", exec_and_hang)
    async with hf.ActorSystem("app", log=False) as system:
        starting = asyncio.ensure_future(system.start(account("first")))
        await until(lambda: bool(servers()))
        first = system.ref("/app/first", Account)
        killed = asyncio.Event()
        monkeypatch.setattr(fork_server, "signal_by", lambda *args: killed.set())  # It takes its time to die.
        first.kill()
        await killed.wait()
        first.kill()
        with pytest.raises(hf.StartFailed):
            await starting
        (server,) = servers()
        monkeypatch.undo()
    assert servers() == []
    assert not psutil.pid_exists(server.pid)


async def test_what_cannot_be_received_is_tried_again_in_a_moment(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    problems: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, problem: problems.append(problem))
    first = await system.start(account("first"))
    await warmed_up(system)
    (server,) = servers()
    refusing = Refusing(monkeypatch, fork_server, "receive", errno.ENOMEM)
    refusing.left = 4
    await system.start(account("second"))
    with pytest.raises(hf.StartFailed, match=os.strerror(errno.ENOMEM)):
        await system.start(account("third"))
    await until(lambda: not refusing.left)
    await system.start(account("fourth"))
    assert servers() == [server]
    assert await first.ask(Add(1)) == 1
    assert problems == []


@pytest.mark.parametrize("times", [1, 3])
async def test_the_death_of_a_fork_server_of_which_nothing_can_be_received(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    problems: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, problem: problems.append(problem))
    first = await system.start(account("first"))
    await warmed_up(system)
    (server,) = servers()
    refusing = Refusing(monkeypatch, fork_server, "receive", errno.ENOMEM)
    refusing.left = times
    server.kill()
    await until(lambda: not refusing.left)
    await until(lambda: server not in servers())
    assert await first.ask(Total(), timeout=60.0) == 0
    assert problems == []


async def test_an_actor_that_has_lived_waits_for_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """That there are no descriptors left says nothing of the actor: not each refusal counts as a restart."""
    async with hf.ActorSystem("app", log=False, intensity=2, period=600.0) as system:
        first = await system.start(account("first"))
        await warmed_up(system)
        refusing = Refusing(monkeypatch, socket, "socketpair", errno.EMFILE)
        refusing.left = 5
        for _ in range(2):  # The first death takes the process in reserve; there is no other.
            pid = await first.ask(Where())
            os.kill(pid, signal.SIGKILL)
            await until(lambda pid=pid: system._workers.processes().get("/app/first", pid) != pid)  # type: ignore[misc]
        assert refusing.refused == 5
        assert await first.ask(Total()) == 0


async def test_a_kill_that_is_refused_ends_it_by_its_socket(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = await system.start(account("first"))
    pid = await first.ask(Where())
    refusing = Refusing(monkeypatch, signal, "pidfd_send_signal", errno.EPERM)
    refusing.left = 1000
    first.kill()
    await until(lambda: not psutil.pid_exists(pid))
    assert refusing.refused
    refusing.left = 0
    assert await first.ask(Total()) == 0
