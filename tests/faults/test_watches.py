"""The system can watch no more descriptors (epoll_ctl fails): what is started says so, and the program goes on."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.served import BYTES
from tests.faults.traced import can_trace, end_all
from tests.faults.watches import KINDS

PROGRAM = "import sys; sys.path.append(sys.argv.pop()); from tests.faults.{} import main; main()"
ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(not can_trace(), reason="needs strace, and the right to trace")


def said_until_ready(program: subprocess.Popen[bytes]) -> list[str]:
    """What the program says until it waits for a word, or ends."""
    assert program.stdout is not None
    lines: list[str] = []
    for line in program.stdout:
        if line == b"ready\n":
            return lines
        lines.append(line.decode())
    pytest.fail(f"it has ended: {lines}")


def say(program: subprocess.Popen[bytes]) -> None:
    assert program.stdin is not None
    program.stdin.write(b"go\n")
    program.stdin.flush()


def run(name: str, arguments: list[str], fault: str, folder: Path) -> tuple[list[str], list[str]]:
    """What a program says between its first and second wait for a word, with the fault, and what after them."""
    with open(folder / "errors", "wb") as errors:
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(name), *arguments, str(ROOT)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, cwd=folder,
        )  # fmt: skip
    tracer: subprocess.Popen[bytes] | None = None
    try:
        said_until_ready(program)
        tracer = subprocess.Popen(
            ["strace", "-p", str(program.pid), "-o", "/dev/null", "-e", "trace=epoll_ctl",
             "-e", f"inject=epoll_ctl:{fault}"],
            stderr=subprocess.PIPE,
        )  # fmt: skip
        assert tracer.stderr is not None
        assert b"attached" in tracer.stderr.readline()
        say(program)
        said = said_until_ready(program)
        tracer.terminate()
        tracer.wait()
        say(program)
        after = program.communicate(timeout=60)[0].decode().splitlines(keepends=True)
    finally:
        end_all(program, tracer, folder)
    assert not (folder / "errors").read_text()
    assert program.returncode == 0
    return said, after


@pytest.mark.parametrize("process", ["first", "further"])
@pytest.mark.parametrize(("loop", "error"), [("asyncio", "ENOMEM"), ("uvloop", "ENOSPC")])
def test_nothing_more_can_be_watched(error: str, loop: str, process: str, tmp_path: Path) -> None:
    said, after = run("watches", [loop, process], f"error={error}:when=2+", tmp_path)  # one has room, and then none
    refused = [line for line in said if "started" not in line.split()]
    for kind in KINDS:
        assert any(line.startswith(kind) for line in refused), said
    for line in refused:
        assert "StartFailed" in line
        assert os.strerror(getattr(errno, error)) in line
    assert after == [f"{kind}3 started\n" for kind in KINDS]


@pytest.mark.parametrize(("loop", "error"), [("asyncio", "ENOSPC"), ("uvloop", "ENOMEM")])
def test_neither_clients_nor_pipes_can_be_watched(error: str, loop: str, tmp_path: Path) -> None:
    """Clients hear why they are not served; what a program prints and reads is slower, and whole."""
    said, after = run("served", [loop], f"error={error}", tmp_path)
    assert len(said) == 3
    for line in said[:2]:
        assert line.startswith("NotServed: ")
        assert os.strerror(getattr(errno, error)) in line
    assert said[2] == f"got {BYTES} True\n"
    assert after == ["served\n"]


@pytest.mark.parametrize(("loop", "error"), [("asyncio", "ENOMEM"), ("uvloop", "ENOSPC")])
def test_no_connection_is_made_or_taken_that_cannot_be_watched(loop: str, error: str, tmp_path: Path) -> None:
    said, after = run("connections", [loop], f"error={error}", tmp_path)
    problem = os.strerror(getattr(errno, error))
    assert said == [f"not connected: {problem}\n", "served nobody\n"]
    assert after == ["connected x\n", "served y\n"]
