"""The fork server with real processes: what is started ends, what ends is reported, and nothing is left behind.

Waiting is always for an event (a byte, the end of a socket, a pidfd), within `SECONDS`. No virtual clock: the time
that the processes take is real.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import sys
from collections.abc import AsyncGenerator
from pathlib import Path

import psutil
import pytest

from holdfast.actors.errors import HoldfastError, ProcessUnavailable
from holdfast.actors.process.fork.fork_server import ForkServer
from holdfast.actors.process.fork.forked_process import Forked
from tests.supervision.programs import hang, let_go

SECONDS = 30.0

CHILDREN = '''
"""Entry points, imported by the fork server."""
import os, random, signal, socket, subprocess, sys, mmap

SLEEPER = [sys.executable, "-S", "-c", "import time; print(1, flush=True); time.sleep(600)"]


def sleeper(**how):
    program = subprocess.Popen(SLEEPER, stdout=subprocess.PIPE, **how)
    program.stdout.readline()
    return program.pid


def double_forked():
    """A daemon: its parent is gone, it leads its own session."""
    code = f"import os, subprocess; p = subprocess.Popen({SLEEPER!r}, stdout=subprocess.PIPE, start_new_session=True)"
    code += "; p.stdout.readline(); print(p.pid, flush=True); os._exit(0)"
    return int(subprocess.run([sys.executable, "-S", "-c", code], stdout=subprocess.PIPE, check=True).stdout)


def forked_daemon():
    """As above, but without an exec: it is nothing but a fork with a new session."""
    out, into = os.pipe()
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            signal.pause()
        os._exit(0)
    os.wait()
    return 0


def is_found(name):
    return hasattr(sys.modules["__main__"], name)


def held(page):
    shared = mmap.mmap(page, 4096)
    shared[:4] = b"turn"
    return "ok"


def descriptors():
    return sorted(int(fd) for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}"))


def main(sock, page):
    """Evaluate what comes; the end of the socket is the end."""
    while line := sock.recv(4096):
        sock.sendall(repr(eval(line, globals(), {"sock": sock, "page": page})).encode())
    return 7
'''

pytestmark = [
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="pidfd and memfd are Linux's"),
    pytest.mark.usefixtures("cold_fork_servers"),
]


class Fixture:
    """A fork server, and what it has called back."""

    def __init__(self, preload: tuple[str, ...] = (), entry: str = "fs_children:main", seconds: float = 10.0) -> None:
        self.exits: dict[int, int] = {}
        self.lost = asyncio.Event()
        self._seen = asyncio.Event()
        self.server = ForkServer(entry, preload, on_exit=self._on_exit, on_lost=self.lost.set, fork_seconds=seconds)

    def _on_exit(self, pid: int, status: int) -> None:
        assert pid not in self.exits
        self.exits[pid] = status
        self._seen.set()

    async def status_of(self, pid: int) -> int:
        """Exit code as `subprocess` has it."""
        while pid not in self.exits:
            self._seen.clear()
            await self._seen.wait()
        return os.waitstatus_to_exitcode(self.exits[pid])


@contextlib.asynccontextmanager
async def running(preload: tuple[str, ...] = (), seconds: float = 10.0) -> AsyncGenerator[Fixture, None]:
    fixture = Fixture(preload, seconds=seconds)
    async with asyncio.timeout(SECONDS):
        await fixture.server.start()
        try:
            yield fixture
        finally:
            await fixture.server.stop()


async def call(child: Forked, expression: str) -> str:
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(child.sock, expression.encode())
    return (await loop.sock_recv(child.sock, 4096)).decode()


def wait_gone(pidfds: list[int], seconds: float = SECONDS) -> None:
    """Block until each process has ended; a pidfd becomes readable then."""
    for pidfd in pidfds:
        poll = select.poll()
        poll.register(pidfd, select.POLLIN)
        assert poll.poll(seconds * 1000), "a process that should have ended lives"
        os.close(pidfd)


def is_alive(pidfd: int) -> bool:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return not poll.poll(0)


def own_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.fixture(autouse=True)
def entry_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make `fs_children` a module that the fork server finds on our path."""
    (tmp_path / "fs_children.py").write_text(CHILDREN)
    monkeypatch.syspath_prepend(str(tmp_path))


async def test_a_child_answers_and_returns_its_exit_code() -> None:
    async with running() as fixture:
        child = await fixture.server.fork()
        assert await call(child, "os.getpid()") == str(child.pid)
        assert await call(child, "os.getsid(0) == os.getpid()") == "True"
        assert await call(child, "os.getppid()") == str(fixture.server.pid)
        assert await call(child, "os.readlink('/proc/self/fd/0')") == "'/dev/null'"
        child.close()  # the end of its socket
        assert await fixture.status_of(child.pid) == 7


async def test_overlapping_forks_are_not_mixed_up() -> None:
    async with running() as fixture:
        children = await asyncio.gather(*(fixture.server.fork() for _ in range(50)))
        answers = [await call(child, "os.getpid(), random.random()") for child in children]
        assert [eval(answer)[0] for answer in answers] == [child.pid for child in children]
        assert len({eval(answer)[1] for answer in answers}) == 50  # no two draw the same numbers
        for child in children:
            child.close()
        assert {await fixture.status_of(child.pid) for child in children} == {7}


async def test_output_goes_to_the_pipes() -> None:
    async with running() as fixture:
        child = await fixture.server.fork()
        await call(child, "print('to out'), print('to err', file=sys.stderr)")
        child.kill()  # the lines are out already
        await fixture.status_of(child.pid)
        assert os.read(child.stdout_fd, 100) == b"to out\n"
        assert os.read(child.stderr_fd, 100) == b"to err\n"
        assert os.read(child.stdout_fd, 100) == b""
        child.close()


async def test_an_exception_in_the_entry_is_printed() -> None:
    async with running() as fixture:
        child = await fixture.server.fork()
        await asyncio.get_running_loop().sock_sendall(child.sock, b"1 / 0")
        assert await fixture.status_of(child.pid) == 1
        assert b"ZeroDivisionError" in os.read(child.stderr_fd, 10_000)
        child.close()


async def test_a_child_holds_nothing_of_the_server() -> None:
    async with running() as fixture:
        first, second = await fixture.server.fork(), await fixture.server.fork()
        for child in (first, second):
            # three standard streams, the socket, the page: nothing of the server, nothing of a sibling
            expected = await call(child, "sorted([0, 1, 2, sock.fileno(), page])")
            assert await call(child, "descriptors()") == expected
            assert await call(child, "[os.get_inheritable(fd) for fd in (sock.fileno(), page)]") == "[False, False]"
            assert await call(child, "signal.pthread_sigmask(signal.SIG_BLOCK, ())") == "set()"
            assert await call(child, "signal.getsignal(signal.SIGCHLD) == signal.SIG_DFL") == "True"
            assert "default_int_handler" in await call(child, "signal.getsignal(signal.SIGINT)")
            child.close()


async def test_the_environment_is_set_for_speed_unless_the_user_did(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MALLOC_TOP_PAD_", raising=False)

    async with running() as fixture:
        child = await fixture.server.fork()
        assert await call(child, "os.environ['OMP_NUM_THREADS']") == "'3'"
        assert await call(child, "os.environ['MALLOC_TOP_PAD_']") == "'16777216'"
        child.close()


async def test_a_hundred_kills_leave_nothing() -> None:
    async with running() as fixture:
        server = psutil.Process(fixture.server.pid)
        before = own_descriptors(), server.num_fds()
        for signum in [signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM, signal.SIGKILL] * 25:
            child = await fixture.server.fork()
            await call(child, "1")
            child.kill(signum)
            assert await fixture.status_of(child.pid) == -signum
            child.kill()  # dead: no error
            child.close()
            child.close()
        assert (own_descriptors(), server.num_fds()) == before
        assert server.children() == []
        assert len(fixture.exits) == 100


async def test_sigint_is_for_children_and_not_for_the_server() -> None:
    async with running() as fixture:
        child = await fixture.server.fork()
        await call(child, "1")
        for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(fixture.server.pid, signum)
        other = await fixture.server.fork()  # it lives
        child.kill(signal.SIGINT)
        assert await fixture.status_of(child.pid) == 1
        assert b"KeyboardInterrupt" in os.read(child.stderr_fd, 10_000)
        child.close()
        other.close()


async def test_the_page_survives_sigkill() -> None:
    async with running() as fixture:
        child = await fixture.server.fork()
        assert await call(child, "held(page)") == "'ok'"
        child.kill()
        await fixture.status_of(child.pid)
        assert child.page[:5] == b"turn\0"
        child.close()


@pytest.mark.parametrize("how", ["sleeper()", "sleeper(start_new_session=True)", "double_forked()"])
async def test_descendants_die_with_their_process(how: str) -> None:
    async with running() as fixture:
        child, bystander = await fixture.server.fork(), await fixture.server.fork()
        gone = os.pidfd_open(int(await call(child, how)))
        spared = os.pidfd_open(int(await call(bystander, how)))
        child.kill()
        assert await fixture.status_of(child.pid) == -signal.SIGKILL
        wait_gone([gone])
        assert is_alive(spared)  # the daemon of a process that lives
        bystander.close()
        assert await fixture.status_of(bystander.pid) == 7  # an orderly end is an end too
        wait_gone([spared])
        child.close()


async def test_a_daemon_without_exec_dies_too() -> None:
    async with running() as fixture:
        child = await fixture.server.fork()
        await call(child, "forked_daemon()")
        child.kill()
        await fixture.status_of(child.pid)
        loop = asyncio.get_running_loop()
        assert await loop.sock_recv(child.sock, 1) == b""  # the daemon held a copy: this ends when it does
        child.close()


async def test_death_of_the_server_kills_all_children() -> None:
    """Also one that was stopped in its very first steps, before it could ask the kernel to end it with the server."""
    fixture = Fixture()
    await fixture.server.start()
    children = []
    for _ in range(5):
        children.append(await fixture.server.fork())
        os.kill(children[-1].pid, signal.SIGSTOP)
    pidfds = [os.dup(child.pidfd) for child in children]
    os.kill(fixture.server.pid, signal.SIGKILL)
    await fixture.lost.wait()
    wait_gone(pidfds)
    with pytest.raises(ProcessUnavailable):
        await fixture.server.fork()
    with pytest.raises(HoldfastError):
        fixture.server.preload("json")
    await fixture.server.stop()
    for child in children:
        child.close()


async def test_what_its_children_have_started_ends_with_the_server() -> None:
    """But for what has left their process group."""
    async with running() as fixture:
        child = await fixture.server.fork()
        gone = os.pidfd_open(int(await call(child, "sleeper()")))
        left = os.pidfd_open(int(await call(child, "sleeper(start_new_session=True)")))
        os.kill(fixture.server.pid, signal.SIGKILL)
        await fixture.lost.wait()
        wait_gone([gone])
        assert is_alive(left)
        signal.pidfd_send_signal(left, signal.SIGKILL)
        wait_gone([left])
        child.close()


async def test_a_fork_under_way_fails_when_the_server_dies() -> None:
    fixture = Fixture()
    await fixture.server.start()
    hang(fixture.server.pid)
    forks = [asyncio.create_task(fixture.server.fork()) for _ in range(100)]  # more than may be in flight
    await asyncio.sleep(0)
    os.kill(fixture.server.pid, signal.SIGKILL)
    results = await asyncio.gather(*forks, return_exceptions=True)
    assert {type(result) for result in results} == {ProcessUnavailable}
    await fixture.lost.wait()


async def test_a_server_that_hangs_does_not_hang_a_fork() -> None:
    async with running(seconds=0.1) as fixture:
        before = own_descriptors()
        hang(fixture.server.pid)
        with pytest.raises(ProcessUnavailable, match=r"did not answer within 0\.1 s"):
            await fixture.server.fork()
        assert own_descriptors() == before
        let_go(fixture.server.pid)
        # What was asked for in vain is started now, and is killed; nobody hears of it.
        fixture.server._fork_seconds = SECONDS
        child = await fixture.server.fork()
        child.kill()
        await fixture.status_of(child.pid)
        assert list(fixture.exits) == [child.pid]
        child.close()


async def test_stop_of_a_server_that_hangs() -> None:
    async with running() as fixture:
        child = await fixture.server.fork()
        pidfd = os.dup(child.pidfd)
        hang(fixture.server.pid)
        await fixture.server.stop(0.05)
        wait_gone([pidfd])
        child.close()


async def test_a_cancelled_fork_leaves_nothing() -> None:
    async with running() as fixture:
        before = own_descriptors()
        for ticks in range(30):  # cancelled at each stage
            task = asyncio.create_task(fixture.server.fork())
            for _ in range(ticks):
                await asyncio.sleep(0.0001)
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                (await task).close()
        child = await fixture.server.fork()
        child.kill()
        await fixture.status_of(child.pid)
        child.close()
        assert own_descriptors() == before


async def test_stop_ends_everything_and_may_be_repeated() -> None:
    fixture = Fixture()
    await fixture.server.stop()  # not even started
    fixture = Fixture()
    await fixture.server.start()
    child = await fixture.server.fork()
    gone = [os.pidfd_open(int(await call(child, f"{how}"))) for how in ("sleeper()", "double_forked()")]
    await asyncio.gather(fixture.server.stop(), fixture.server.stop())
    wait_gone([os.dup(child.pidfd), *gone], seconds=0)  # before stop returned
    await fixture.server.stop()
    assert not fixture.lost.is_set()
    child.close()


async def test_problems_of_imports_are_reported_by_name(tmp_path: Path) -> None:
    (tmp_path / "fs_broken.py").write_text("print('half a line', end='')\n1 / 0\n")
    (tmp_path / "fs_leaves.py").write_text("raise SystemExit(3)\n")
    (tmp_path / "fs_good.py").write_text("value = 5\n")

    async with running(("fs_broken", "fs_missing", "fs_leaves", str(tmp_path / "fs_good.py"))) as fixture:
        errors = fixture.server.preload_errors
        assert set(errors) == {"fs_broken", "fs_missing", "fs_leaves"}
        assert "ZeroDivisionError" in errors["fs_broken"]
        assert "fs_broken.py:2" in errors["fs_broken"]
        child = await fixture.server.fork()
        assert await call(child, "sys.modules['fs_good'].value") == "5"
        child.close()


async def test_modules_loaded_later_are_in_later_children(tmp_path: Path) -> None:
    (tmp_path / "fs_later.py").write_text("value = 6\n")

    async with running() as fixture:
        early = await fixture.server.fork()
        fixture.server.preload("fs_later")
        fixture.server.preload("fs_missing")
        late = await fixture.server.fork()
        assert await call(early, "'fs_later' in sys.modules") == "False"
        assert await call(late, "sys.modules['fs_later'].value") == "6"
        assert set(fixture.server.preload_errors) == {"fs_missing"}
        early.close()
        late.close()


async def test_an_entry_that_cannot_be_imported_is_an_error() -> None:
    for entry in ("fs_children:missing", "fs_missing:main"):
        with pytest.raises(ProcessUnavailable, match=entry):
            await Fixture(entry=entry).server.start()


async def test_start_can_be_cancelled(tmp_path: Path) -> None:
    (tmp_path / "fs_slow.py").write_text("import signal\nsignal.pause()\n")

    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.2):
            await Fixture(("fs_slow",)).server.start()


async def test_other_platforms_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    try:
        with pytest.raises(ProcessUnavailable, match="darwin"):
            await Fixture().server.start()
    finally:
        monkeypatch.undo()
