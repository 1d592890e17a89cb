"""The programs of the quick start and the tutorial that a reader kills: what was counted is not lost."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"
COUNTED = re.compile(r"(\d+) from process (\d+)\n")


@contextmanager
def running(program: str, *args: str, folder: Path) -> Generator[subprocess.Popen[str]]:
    """The program, started in this folder; it is killed at the end."""
    command = [sys.executable, str(EXAMPLES / program), *args]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def counted(process: subprocess.Popen[str]) -> Iterator[tuple[int, int]]:
    """The numbers that the quick start prints, each with the process in which it was counted."""
    assert process.stdout is not None
    for line in process.stdout:
        found = COUNTED.fullmatch(line)
        if found:
            yield int(found[1]), int(found[2])


def test_the_counter_of_the_quick_start_survives_its_process(tmp_path: Path) -> None:
    with running("quick_start.py", folder=tmp_path) as process:
        numbers = counted(process)
        first, pid = next(numbers)
        assert (first, pid != process.pid) == (1, True)
        os.kill(pid, signal.SIGKILL)
        second, later_pid = next(numbers)
        assert (second, later_pid != pid) == (2, True)


def test_with_a_store_it_survives_the_whole_program(tmp_path: Path) -> None:
    lasts: list[int] = []
    for _ in range(3):
        with running("quick_start.py", "sqlite:counter.db", folder=tmp_path) as process:
            lasts.append(next(counted(process))[0])
    assert lasts[0] == 1
    # A number may have been counted and not been printed when the program was killed.
    assert lasts == sorted(set(lasts))


def test_the_bank_of_chapter_4_goes_on_with_each_start(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        program = [sys.executable, str(EXAMPLES / "tutorial" / "chapter_4_store.py")]
        done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
        assert (done.stdout, done.returncode) == (f"transfer {number}\n", -signal.SIGKILL), done.stderr
