"""The system can watch no more descriptors (epoll_ctl fails): what is started says so, and the program goes on."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.traced import can_trace, end_all
from tests.faults.watches import KINDS

PROGRAM = "import sys; sys.path.append(sys.argv.pop()); from tests.faults.watches import main; main()"
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


@pytest.mark.parametrize("process", ["first", "further"])
@pytest.mark.parametrize(("loop", "error"), [("asyncio", "ENOMEM"), ("uvloop", "ENOSPC")])
def test_nothing_more_can_be_watched(error: str, loop: str, process: str, tmp_path: Path) -> None:
    with open(tmp_path / "errors", "wb") as errors:
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, loop, process, str(ROOT)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, cwd=tmp_path,
        )  # fmt: skip
    tracer: subprocess.Popen[bytes] | None = None
    try:
        said_until_ready(program)
        option = f"inject=epoll_ctl:error={error}:when=2+"  # one has room, and then none
        tracer = subprocess.Popen(
            ["strace", "-p", str(program.pid), "-o", "/dev/null", "-e", "trace=epoll_ctl", "-e", option],
            stderr=subprocess.PIPE,
        )
        assert tracer.stderr is not None
        assert b"attached" in tracer.stderr.readline()
        say(program)
        said = said_until_ready(program)
        tracer.terminate()
        tracer.wait()
        say(program)
        after = program.communicate(timeout=60)[0].decode()
    finally:
        end_all(program, tracer, tmp_path)
    refused = [line for line in said if "started" not in line.split()]
    for kind in KINDS:
        assert any(line.startswith(kind) for line in refused), said
    for line in refused:
        assert "StartFailed" in line
        assert os.strerror(getattr(errno, error)) in line
    assert after.split("\n")[:-1] == [f"{kind}3 started" for kind in KINDS]
    assert not (tmp_path / "errors").read_text()
    assert program.returncode == 0
