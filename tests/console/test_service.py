"""`holdfast run`, `new` and `doctor`, in processes of their own, with the real protocol of a service manager."""

import asyncio
import json
import os
import signal
import socket
import sys
import tempfile
from collections.abc import AsyncGenerator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.service.doctor import file_system
from holdfast.console.service.notify import Notifier
from tests.console.commands import holdfast
from tests.system.trees import Counter

pytestmark = pytest.mark.usefixtures("warm_programs")

DONE, FAILED, UNUSABLE = 0, 1, 2
WORDS = "import holdfast as hf\n\n\nclass Tick(hf.Message): ...\n"
ACTORS = """
import holdfast as hf
from words import Tick


class Clock(hf.Actor):
    def __init__(self) -> None:
        self.count, self.release = 0, ""

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.01, Tick())

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.count += 1
        self.release = "first"
"""
CHANGED = (
    ACTORS.replace('"first"', '"second"')
    .replace('0, ""', '0, ""\n        self.added = 0')
    .replace("self.count += 1", "self.count += 1\n        self.added += 1")
)
TREE = """
import holdfast as hf
from clock import Clock


def tree():
    return [hf.child("clock", hf.start(Clock), recovery=hf.hybrid())]


async def main(system):
    await system.start(tree()[0])
    await system.ref("/app/clock")._cell.node.loop.create_future()


async def brief(system):
    await system.start(tree()[0])
"""
STUBBORN = """
import asyncio
from pathlib import Path
import holdfast as hf



class Polite(hf.Actor):
    def on_stop(self, reason):
        Path("stopped").touch()


async def main(system):
    await system.start(hf.child("polite", hf.start(Polite)))
    Path("up").touch()
    while True:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            pass
"""
FILE = '["/app/clock"]\nclass = "clock:Clock"\nrecovery = "hybrid"\n'


@pytest.fixture(autouse=True)
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A program, in the folder in which the commands are given."""
    for name, text in (("words.py", WORDS), ("clock.py", ACTORS), ("tree.py", TREE), ("tree.toml", FILE)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o600)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONSAFEPATH", "1")  # As for the command that is installed: the folder is no path by itself.
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # Files change within a second, which is what a cache looks at.
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield tmp_path


class Service:
    """A program that is run, as its service manager sees it."""

    def __init__(self, process: asyncio.subprocess.Process, manager: socket.socket) -> None:
        self.process, self._manager = process, manager
        self.said: list[str] = []

    async def hears(self, line: str) -> str:
        """The next thing that the manager is told that has this line in it."""
        async with asyncio.timeout(25):
            while True:
                told = (await asyncio.get_running_loop().sock_recv(self._manager, 4096)).decode()
                self.said.append(told)
                if line in told.splitlines():
                    return told

    async def state(self) -> dict[str, Any]:
        """The state of the clock."""
        status, output, errors = await holdfast("inspect", "/app/clock", "--state", "--json")
        assert (status, errors) == (DONE, "")
        (told,) = json.loads(output)
        found: dict[str, Any] = told["state"] | {"life": told["life"]}
        return found

    async def reload(self) -> str:
        """Send SIGHUP, and wait until it is over; returns what the manager hears of it."""
        self.process.send_signal(signal.SIGHUP)
        assert "MONOTONIC_USEC=" in await self.hears("RELOADING=1")
        return await self.hears("READY=1")


@asynccontextmanager
async def running(*arguments: object) -> AsyncGenerator[Service]:
    """The program, up, under a service manager."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, tempfile.TemporaryDirectory(dir="/tmp") as folder:
        manager.bind(f"{folder}/notify")
        manager.setblocking(False)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "holdfast.console.cli", "run", *map(str, arguments)),
            env={**os.environ, "NOTIFY_SOCKET": f"{folder}/notify", "WATCHDOG_USEC": "200000"},
            stderr=asyncio.subprocess.PIPE,
        )
        service = Service(process, manager)
        try:
            await service.hears("READY=1")
            yield service
        finally:
            if process.returncode is None:
                process.kill()
            _, errors = await process.communicate()
            print(errors.decode())


async def test_the_manager_hears_of_the_start_the_loop_and_the_end(project: Path) -> None:
    async with running("tree:tree") as service:
        await service.hears("WATCHDOG=1")
        await service.hears("WATCHDOG=1")
        assert f"MAINPID={service.process.pid}" in service.said[0]
        service.process.send_signal(signal.SIGTERM)
        await service.hears("STOPPING=1")
        async with asyncio.timeout(20):
            assert await service.process.wait() == 143


async def test_a_main_that_does_not_end_does_not_hold_up_the_end_of_the_system(project: Path) -> None:
    """Its actors stop in good order all the same; what is left of the process another signal ends."""
    (project / "stubborn.py").write_text(STUBBORN)
    async with running("stubborn:main") as service, asyncio.timeout(25):
        while not (project / "up").exists():
            await asyncio.sleep(0.01)
        service.process.send_signal(signal.SIGTERM)
        await service.hears("STOPPING=1")
        while not (project / "stopped").exists():
            await asyncio.sleep(0.01)
        assert service.process.stderr is not None
        while b"SIGTERM ends the rest" not in (line := await service.process.stderr.readline()):
            assert line, "it has ended, or says nothing more"
        while service.process.returncode is None:  # The last lines of the program still hear the signal.
            service.process.send_signal(signal.SIGTERM)
            await asyncio.sleep(0.05)
        assert service.process.returncode in (-signal.SIGTERM, 143)


@pytest.mark.parametrize("target", ["tree:tree", "tree:main"])
async def test_sighup_has_changed_code_taken_up_with_state_kept(project: Path, target: str) -> None:
    async with running(target) as service:
        before = await service.state()
        (project / "clock.py").write_text(CHANGED)
        assert "STATUS=app runs" in await service.reload()
        while (after := await service.state())["release"] != "second":
            await asyncio.sleep(0.01)
        assert after["count"] >= before["count"] > 0
        assert after["count"] > after["added"] > 0
        assert after["life"] == 1


async def test_sighup_has_another_tree_planted(project: Path) -> None:
    async with running("tree:tree") as service:
        more = TREE.replace("recovery=hf.hybrid())]", 'recovery=hf.hybrid()), hf.child("more", hf.start(Clock))]')
        (project / "tree.py").write_text(more)
        await service.reload()
        assert await holdfast("tree", "--paths") == (DONE, "/app\n/app/clock\n/app/more\n", "")


@pytest.mark.parametrize(
    ("file", "text", "problem"),
    [
        ("clock.py", "def broken(", "SyntaxError"),
        ("clock.py", ACTORS + "\n1 / 0\n", "ZeroDivisionError"),
        ("clock.py", ACTORS + "\nraise SystemExit(3)\n", "SystemExit"),
        ("clock.py", ACTORS + "\nraise KeyboardInterrupt\n", "KeyboardInterrupt"),
        ("clock.py", ACTORS.replace("count", "number"), "count would be lost; if it was renamed, say @hf.renamed"),
        ("words.py", WORDS + "\n\nclass Tock(hf.Message): ...\n", "words: it defines messages"),
        ("tree.py", TREE.replace('"clock", hf', '"/", hf'), "the id must be text without '/' and control characters"),
        ("tree.py", TREE.replace("Clock)", "Clock, 7)"), "too many positional arguments"),
        ("tree.py", TREE.replace("    return [", "    raise SystemExit(3)\n    return ["), "SystemExit"),
    ],
)
@pytest.mark.some(4)
async def test_a_reload_that_fails_changes_nothing(project: Path, file: str, text: str, problem: str) -> None:
    async with running("tree:tree") as service:
        before, good = await service.state(), (project / file).read_text()
        (project / file).write_text(text)
        told = await service.reload()
        assert "STATUS=reload failed" in told
        assert problem in told
        assert (await service.state())["count"] > before["count"]
        (project / file).write_text(good)
        assert "STATUS=app runs" in await service.reload()
        assert (await service.state())["life"] == 1


@pytest.mark.parametrize("target", ["tree:tree", "tree:main"])
async def test_code_that_would_not_reach_a_process_is_refused(project: Path, target: str) -> None:
    (project / "tree.py").write_text(TREE.replace("hf.hybrid()", 'hf.hybrid(), isolation="process"'))
    async with running(target) as service:
        await service.state()  # It is up, and its process has imported its module.
        (project / "clock.py").write_text(ACTORS.replace('"first"', '"second"'))
        assert "its process has the old module of clock.Clock" in await service.reload()
        assert (await service.state())["release"] in ("", "first")


async def test_a_tree_in_a_file_is_run_reloaded_and_kept_in_a_store(project: Path) -> None:
    options = ("tree.toml", "--store", f"sqlite:{project}/app.db")
    async with running(*options) as service:
        (project / "tree.toml").write_text(FILE + 'restart = "transient"\n')
        await service.reload()
        before = await service.state()
        service.process.send_signal(signal.SIGTERM)
        assert await service.process.wait() == 143
    async with running(*options) as service:
        assert (await service.state())["count"] >= before["count"] > 0
        (project / "tree.toml").write_text("colour = 1\n")
        assert "STATUS=reload failed: tree.toml, line 1, colour" in await service.reload()


async def test_a_reload_leaves_nothing_behind(project: Path) -> None:
    """Where `holdfast apply` asks, nobody can be asked."""
    async with running("tree.toml") as service:
        before = await service.state()
        (project / "other.py").write_text("from clock import Clock\n\n\nclass Watch(Clock):\n    pass\n")
        above = '["/app/top"]\nclass = "holdfast:Supervisor"\n'
        elsewhere = FILE.replace("/app/clock", "/app/top/clock").replace("clock:Clock", "other:Watch")
        (project / "tree.toml").write_text(above + elsewhere)
        told = await service.reload()
        assert "STATUS=reload failed" in told
        assert "/app/top/clock begins anew as Watch, and what is recorded of /app/clock (Clock) is left behind" in told
        assert (await service.state())["count"] > before["count"]


async def test_it_ends_when_its_main_returns(project: Path) -> None:
    status, _, errors = await holdfast("run", "tree:brief")
    assert (status, "app runs, control endpoint" in errors) == (DONE, True)


@pytest.mark.parametrize(
    ("target", "problem"),
    [
        ("nowhere:tree", "it cannot be imported: ModuleNotFoundError"),
        ("tree:nothing", "tree has no nothing"),
        ("tree", "name the specs as 'module:name'"),
        ("tree.py:tree", "name a module"),
        ("gone.toml", "No such file"),
        ("tree:hf", "it must be a spec"),
    ],
)
@pytest.mark.some(3)
async def test_what_cannot_be_run_is_said(project: Path, target: str, problem: str) -> None:
    status, _, errors = await holdfast("run", target)
    assert (status, problem in errors, "Traceback" in errors) == (UNUSABLE, True, False)


async def test_a_manager_that_does_not_listen_holds_nothing_up(project: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("notify")
        notifier = Notifier({"NOTIFY_SOCKET": str(project / "notify"), "WATCHDOG_USEC": "1000"})
        for number in range(1000):
            notifier.ready(f"number {number}")
        manager.setblocking(False)
        told = b""
        async with asyncio.timeout(20):
            while b"number 999" not in told:
                told = await asyncio.get_running_loop().sock_recv(manager, 4096)
        notifier.close()


def test_nobody_is_told_where_no_manager_has_asked() -> None:
    notifier = Notifier({})
    notifier.ready("up")
    notifier.stopping()
    notifier.close()
    assert notifier.beat_seconds == 0.0


def test_the_watchdog_of_another_process_is_not_ours() -> None:
    assert Notifier({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}).beat_seconds == 0.0
    assert Notifier({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}).beat_seconds == 1.0


# -- new --------------------------------------------------------------------------------------------------------------


async def test_the_tests_of_a_new_project_pass_and_it_runs(project: Path) -> None:
    assert (await holdfast("new", "stall"))[0] == DONE
    folder = project / "stall"
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"),
        cwd=folder,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    async with asyncio.timeout(60):
        output, _ = await process.communicate()
    assert process.returncode == 0, output.decode()
    assert "2 passed" in output.decode()
    assert "Warning" not in output.decode()
    assert "holdfast run stall.tree:tree --name stall" in (folder / "stall.service").read_text()
    os.chdir(folder)
    async with running("stall.tree:tree", "--name", "stall"):
        assert "/stall/stock/pears" in (await holdfast("tree", "--paths"))[1].split()


async def test_a_project_is_not_written_over_another_one(project: Path) -> None:
    (project / "stall").mkdir()
    for name, problem in (("stall", "File exists"), ("a-b", "no name of a Python package"), ("class", "no name")):
        status, _, errors = await holdfast("new", name)
        assert (status, problem in errors) == (UNUSABLE, True)


# -- doctor -----------------------------------------------------------------------------------------------------------


async def test_the_doctor_looks_at_the_machine_and_at_stores(project: Path) -> None:
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{project}/app.db") as system:
        await system.start(hf.child("kept", hf.start(Counter), recovery=hf.hybrid()))
    status, output, errors = await holdfast("doctor", project / "app.db", "--json")
    found = {one["about"]: one for one in json.loads(output)}
    assert (status, errors) == (DONE, "")
    assert {"python", "uvloop", "open files", "memory", "clock", "runtime folder"} <= found.keys()
    assert found[f"store {project}/app.db"]["verdict"] == "ok"
    assert all(one["advice"] for one in found.values() if one["verdict"] != "ok")


async def test_the_doctor_says_what_has_failed(project: Path) -> None:
    (project / "notes.db").write_text("no store")
    status, output, _ = await holdfast("doctor", project / "gone.db", project / "notes.db")
    assert status == FAILED
    assert f"failed   store {project}/gone.db: it is not there" in output
    assert f"failed   store {project}/notes.db" in output


def test_the_file_system_of_a_file_is_known(project: Path) -> None:
    assert file_system(Path("/proc/self/status")) == "proc"
