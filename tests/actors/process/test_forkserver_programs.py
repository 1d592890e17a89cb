"""The fork server below a program of its own: all that was started ends with that."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from holdfast.actors.process.fork import fork_server
from tests.actors.process.test_forkserver import CHILDREN, SECONDS, is_alive, wait_gone

PROGRAM = """
import asyncio, sys
from holdfast.actors.process.fork.fork_server import ForkServer

class Account:
    pass

async def main():
    server = ForkServer("fs_children:main", [], on_exit=print, on_lost=lambda: None)
    await server.start()
    children = [await server.fork() for _ in range(3)]
    loop = asyncio.get_running_loop()
    pids = [server.pid]
    for child in children:
        for expression in ("is_found('Account')", "sleeper()", "sleeper(start_new_session=True)", "double_forked()"):
            await loop.sock_sendall(child.sock, expression.encode())
            pids.append(eval(await loop.sock_recv(child.sock, 1000)))
        pids.append(child.pid)
    print([pid for pid in pids if pid is not True], pids.count(True), server.preload_errors, flush=True)
    await loop.run_in_executor(None, sys.stdin.read)
    await server.stop()

if __name__ == "__main__":
    asyncio.run(main())
"""


def import_root() -> str:
    """The directory `holdfast` is imported from, whatever the way it got there."""
    return str(Path(fork_server.__file__).parents[3])


def start_program(tmp_path: Path, *arguments: str, text: str = PROGRAM) -> subprocess.Popen[str]:
    (tmp_path / "fs_children.py").write_text(CHILDREN)
    (tmp_path / "fs_program.py").write_text(textwrap.dedent(text))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([import_root(), *sys.path])}
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=environment,
    )


@pytest.mark.parametrize("arguments", [("fs_program.py",), ("-m", "fs_program")], ids=["script", "module"])
@pytest.mark.parametrize("end", ["killed", "ends"])
def test_everything_ends_with_the_parent(tmp_path: Path, arguments: tuple[str, ...], end: str) -> None:
    with start_program(tmp_path, *arguments) as program:
        assert program.stdout is not None
        pids, found, errors = eval(f"[{program.stdout.readline().replace('] ', '], ').replace(' {', ', {')}]")
        assert (len(pids), found, errors) == (13, 3, {})  # and `Account` was found in `__main__` by all three
        pidfds = [os.pidfd_open(pid) for pid in pids]
        assert all(map(is_alive, pidfds))
        if end == "killed":
            program.kill()
            program.wait(SECONDS)
        else:
            program.communicate(timeout=SECONDS)
            assert program.returncode == 0
        wait_gone(pidfds)


def test_a_program_without_guard_is_told_so(tmp_path: Path) -> None:
    text = PROGRAM.replace('if __name__ == "__main__":', "if True:")
    with start_program(tmp_path, "fs_program.py", text=text) as program:
        out, _ = program.communicate(timeout=SECONDS)
        assert "__name__" in out
        assert "Account" not in out
