"""A test or a teardown that hangs ends the run, and says where everything waits."""

import subprocess
import sys
from pathlib import Path

import pytest

SECONDS = 120.0  # far more than it takes

HANGS = """
import asyncio
import holdfast as hf
import pytest
import pytest_asyncio

class Wait(hf.Message): ...

class Waits(hf.Actor):
    @hf.on(Wait)
    async def wait_in_turn(self, message):
        await asyncio.Event().wait()

@pytest_asyncio.fixture
async def system():
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("waits", hf.start(Waits), shutdown="infinity"))
        ref.tell(Wait())
        yield system

ENDED = []

async def test_another_one_before():
    async with hf.ActorSystem("ended", log=False) as system:
        ENDED.append(system)

async def hang_in_task():
    await asyncio.Event().wait()

async def test_it(system):
    task = asyncio.create_task(hang_in_task(), name="forgotten")
    await asyncio.sleep(0)
    if HOW == "the test":
        await task
    task.cancel()
    assert HOW != "a teardown behind a failure"
"""


def ran(folder: Path, program: str, seconds: int) -> subprocess.CompletedProcess[str]:
    """A run of pytest, in which nothing may take longer."""
    (folder / "test_hangs.py").write_text(program, "utf-8")
    options = [
        "-o",
        f"faulthandler_timeout={seconds}",
        "-o",
        "faulthandler_exit_on_timeout=true",
        "-o",
        "asyncio_mode=auto",
    ]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "holdfast.testing.hanging", *options, "--rootdir", "."]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=SECONDS, check=False)


def hung(folder: Path, program: str, what: str, ends: str = "") -> tuple[subprocess.CompletedProcess[str], int]:
    """A run that has told what hangs, and the seconds that a test had; on a busy machine the start takes that long."""
    for seconds in (2, 10, 30):
        run = ran(folder, program, seconds)  # One that is ended while it starts may end of the very dump.
        if f"test_hangs.py::{what} hangs" in run.stderr and ends in run.stdout:
            break
    assert f"test_hangs.py::{what} hangs" in run.stderr
    assert run.returncode == 1
    return run, seconds


@pytest.mark.parametrize("how", ["the test", "the teardown", "a teardown behind a failure"])
def test_what_hangs_is_told_and_ended(how: str, tmp_path: Path) -> None:
    what = "the test" if how == "the test" else "the teardown"
    run, seconds = hung(tmp_path, f"HOW = {how!r}\n{HANGS}", f"test_it: {what}")
    assert "/app/waits (running) has been in the turn of Wait" in run.stderr
    assert "in Waits.wait_in_turn" in run.stderr
    assert "/ended" not in run.stderr
    assert ("task forgotten:" in run.stderr) is (how == "the test")
    assert "in hang_in_task" in run.stderr or how != "the test"
    assert f"Timeout (0:00:{seconds:02d})!" in run.stderr


FORGETS = """
import asyncio

async def test_hangs():
    await asyncio.Event().wait()

async def test_another():
    pass
"""


def test_a_test_that_hangs_fails_alone(tmp_path: Path) -> None:
    run, _ = hung(tmp_path, FORGETS, "test_hangs: the test", ends="1 failed, 1 passed")
    assert "1 failed, 1 passed" in run.stdout
    assert "CancelledError" in run.stdout
