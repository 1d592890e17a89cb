"""What does the guard of the fixtures cost a test suite?

Baseline: the same 1,000 small tests with a fixture that starts a plain `ActorSystem`. Each run of pytest is a process
of its own, in turn, and the seconds are those of its tests, without the start of the interpreter.

    python benchmarks/bench_guard.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from harness import Run, main, pairs

TESTS = 1000
ACTORS = """
import pytest
import holdfast as hf

class Add(hf.Message[int]):
    n: int

class Put(hf.Message):
    items: list[int]

class Account(hf.Actor):
    def __init__(self):
        self.total, self.items = 0, []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total

    @hf.on(Put)
    def put(self, message: Put) -> None:
        self.items = list(message.items)
"""
PLAIN = """
@pytest.fixture
async def actor_system():
    async with hf.ActorSystem(log=False) as system:
        yield system
"""
TEST = """
@pytest.mark.parametrize("number", range({tests}))
async def test_adds(actor_system, number):
    account = actor_system.spawn(hf.start(Account), "account")
    account.tell(Add(1))
    account.tell(Put([1, 2, 3]))
    for total in range(2, 10):
        assert await account.ask(Add(1)) == total
    await actor_system.stop(account)
"""
CLOCK = """
import time
import pytest

@pytest.hookimpl(wrapper=True)
def pytest_runtestloop(session):
    began = time.process_time()
    try:
        return (yield)
    finally:
        print(f"seconds {time.process_time() - began}")
"""
SETTINGS = "[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope = function\n"


def suite(folder: Path, fixture: str, tests: int) -> float:
    """Seconds of processor time that the tests took."""
    folder.mkdir(exist_ok=True)
    (folder / "pytest.ini").write_text(SETTINGS)
    (folder / "conftest.py").write_text(CLOCK)
    (folder / "test_suite.py").write_text(ACTORS + fixture + TEST.format(tests=tests))
    command = [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", str(folder)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return next(float(line.split()[-1]) for line in done.stdout.splitlines() if "seconds" in line)


async def guarded_tests(run: Run) -> None:
    """Tests under guard beside the same tests of a plain system."""
    tests = run.size(TESTS)
    with tempfile.TemporaryDirectory() as folder:
        measured = await pairs(
            lambda: suite(Path(folder) / "guarded", "", tests),
            lambda: suite(Path(folder) / "plain", PLAIN, tests),
            run.n,
        )
    run.bound("guarded tests over plain ones", min(measured.ours) / min(measured.limit), unit="times", target=1.15)


if __name__ == "__main__":
    main([guarded_tests])
