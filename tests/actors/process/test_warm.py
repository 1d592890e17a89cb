"""A fork server of the tests, which is forked from a warm process, is as one that is started by exec."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

from holdfast.actors.process.fork import fork_server, launch
from holdfast.actors.process.fork.fork_server import ForkServer
from tests.actors.process.facts import descriptors
from tests.actors.process.waiting import until
from tests.warm import Forked, WarmServers, bury, own_children, warm_popen

ENTRY = "tests.actors.process.facts:main"


async def facts_of(start: Any, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(fork_server, "exec_server", start)
    server = ForkServer(ENTRY, (), on_exit=lambda pid, status: None, on_lost=lambda: None)
    await server.start()
    try:
        child = await server.fork()
        with contextlib.closing(child):
            # The last descriptor that it closes in the server.
            await until(lambda: not any("page" in one for one in descriptors(server.pid)))
            loop = asyncio.get_running_loop()
            await loop.sock_sendall(child.sock, b"?")
            said = b""
            while not said.endswith(b"\n"):
                more = await loop.sock_recv(child.sock, 1 << 16)
                assert more, "it has ended"
                said += more
    finally:
        await server.stop()
    found: dict[str, Any] = json.loads(said)
    return found


async def test_it_has_all_that_one_started_by_exec_has(
    warm_servers: WarmServers | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "America/New_York")
    monkeypatch.setenv("SAID_BY_A_TEST", "half a pair: \udc80")
    monkeypatch.delenv("HOME", raising=False)
    files = resource.getrlimit(resource.RLIMIT_NOFILE)
    umask = os.umask(0o027)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (files[1] // 2, files[1]))
        warm = await facts_of(warm_servers.exec_server, monkeypatch)
        cold = await facts_of(launch.exec_server, monkeypatch)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, files)
        os.umask(umask)
    assert warm == cold
    assert warm["started by"] == os.getpid()


async def test_its_end_is_known_as_that_of_any_child(warm_servers: WarmServers | None) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")
    lost = asyncio.Event()
    server = ForkServer(ENTRY, (), on_exit=lambda pid, status: None, on_lost=lost.set)
    await server.start()
    assert isinstance(server._process, Forked)
    os.kill(server.pid, signal.SIGKILL)
    async with asyncio.timeout(30):
        await lost.wait()
    assert server._process.returncode == -signal.SIGKILL
    await server.stop()
    assert not own_children()


@pytest.mark.parametrize("name", ["PYTHONHASHSEED", "MALLOC_TRIM_THRESHOLD_", "OMP_NUM_THREADS"])
async def test_what_a_program_reads_as_it_begins_means_exec(
    warm_servers: WarmServers | None, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")
    monkeypatch.setenv(name, "3")
    server = ForkServer(ENTRY, (), on_exit=lambda pid, status: None, on_lost=lambda: None)
    await server.start()
    assert not isinstance(server._process, Forked)
    await server.stop()


PROGRAM = """
import json, os, resource, signal, sys
import holdfast as hf
main = sys.modules["__main__"]
limits = [resource.getrlimit(getattr(resource, name)) for name in dir(resource) if name.startswith("RLIMIT_")]
found = {"argv": sys.argv, "path": sys.path, "folder": os.getcwd(), "limits": limits}
found |= {"environment": dict(os.environ), "parent": os.getppid(), "leads": os.getsid(0) == os.getpid()}
found |= {"name": __name__, "spec": __spec__ and __spec__.name, "file": globals().get("__file__")}
found |= {"is main": main.__dict__ is globals(), "interrupt": str(signal.getsignal(signal.SIGINT))}
found |= {"open": sorted(os.listdir("/proc/self/fd"))[:3], "given": sys.stdin.read()}
print(json.dumps(found))
print("on the other", file=sys.stderr)
if sys.argv[1:] == ["raise"]:
    raise ValueError("as it is")
sys.exit(3)
"""


@pytest.mark.parametrize("how", ["-c", "-m", "file"])
@pytest.mark.parametrize("end", ["exit", "raise"])
def test_a_warm_program_is_as_one_that_is_started_by_exec(
    warm_servers: WarmServers | None, tmp_path: Path, how: str, end: str
) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")
    (tmp_path / "program_of_a_test.py").write_text(PROGRAM)
    words = {"-c": ["-c", PROGRAM], "-m": ["-m", "program_of_a_test"], "file": [str(tmp_path / "program_of_a_test.py")]}
    environment = {**os.environ, "TZ": "America/New_York", "SAID_BY_A_TEST": "half a pair: \udc80"}

    def run() -> tuple[int, Any, str]:
        done = subprocess.run(
            [sys.executable, *words[how], end],
            input="what it reads",
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            check=False,
        )
        return done.returncode, json.loads(done.stdout), done.stderr

    cold = run()
    with warm_popen(warm_servers):
        warm = run()
    assert warm == cold
    assert warm[0] == (1 if end == "raise" else 3)
    assert not own_children()


WITH_PROCESS = """
import asyncio, sys
import holdfast as hf
from holdfast.actors.process.fork import fork_server


class Hold(hf.Message[str]): ...


class Holder(hf.Actor):
    @hf.on(Hold)
    async def hold(self, message: Hold) -> str:
        return "held"


async def main():
    system = hf.ActorSystem("app", log=False)
    await system.__aenter__()
    ref = await system.start(hf.child("it", hf.start(Holder), isolation="process"))
    print(await ref.ask(Hold()), fork_server.exec_server.__name__, flush=True)
    sys.stdin.read()
    await system.__aexit__(None, None, None)


if __name__ == "__main__":
    asyncio.run(main())
"""


@pytest.mark.parametrize("end", ["killed", "over"])
def test_a_warm_program_has_fork_servers_of_its_own_that_end_with_it(
    warm_programs: None, tmp_path: Path, end: str
) -> None:
    (tmp_path / "program.py").write_text(WITH_PROCESS)
    command = [sys.executable, str(tmp_path / "program.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "held exec_server\n"
        below = psutil.Process(program.pid).children(recursive=True)
        assert len(below) >= 2  # a fork server and the process of the actor
        if end == "killed":
            program.kill()
    assert program.returncode == (-signal.SIGKILL if end == "killed" else 0)
    gone, alive = psutil.wait_procs(below, timeout=30)
    assert not alive
    assert len(gone) == len(below)


@pytest.mark.asyncio(loop_factories=["uvloop", "asyncio"])
async def test_a_warm_program_is_started_from_any_loop(warm_servers: WarmServers | None, tmp_path: Path) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")

    async def run() -> tuple[str, int | None]:
        program = "import os, sys; print(sys.stdin.read(), flush=True); print(len(sys.modules)); os._exit(3)"
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", program), stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=tmp_path
        )
        output, _ = await process.communicate(b"what it reads")
        return output.decode(), process.returncode

    cold, status = await run()
    with warm_popen(warm_servers):
        warm, also = await run()
        killed = await asyncio.create_subprocess_exec(sys.executable, "-c", "while True: pass")
        killed.kill()
        assert await killed.wait() == -signal.SIGKILL
    (said, few), (repeated, many) = cold.split("\n")[:2], warm.split("\n")[:2]
    assert said == repeated == "what it reads"
    assert int(few) < int(many), "it was forked"
    assert (status, also) == (3, 3)


def test_whoever_was_adopted_and_has_ended_is_buried() -> None:
    """As those are whose parent ends while something is forked from the warm process."""
    with subprocess.Popen([sys.executable, "-c", "pass"]) as ended, subprocess.Popen(["sleep", "60"]) as other:
        assert os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT) is not None
        bury()
        with pytest.raises(ChildProcessError):
            os.waitpid(ended.pid, os.WNOHANG)
        assert other.poll() is None
        other.kill()
