"""A loop that stands still keeps no program alive that was told to end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast as hf

SCRIPT = Path(__file__).with_name("standstill_player.py")
PATHS = os.pathsep.join(filter(None, (str(Path(hf.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
PATIENCE = 60.0  # of a machine that is busy with other things


def told_to_end(how: str, number: signal.Signals) -> tuple[int, str]:
    """Run the program, and send it a signal when it is busy. Returns its exit code and what it wrote to stderr."""
    with subprocess.Popen(
        [sys.executable, str(SCRIPT), how],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": PATHS},
    ) as program:
        try:
            assert program.stdout is not None
            assert program.stdout.readline() in ("busy\n", "up\n")
            program.send_signal(number)
            _, stderr = program.communicate(timeout=PATIENCE)
            return program.returncode, stderr
        finally:
            program.kill()


@pytest.mark.parametrize(
    ("how", "number", "code"),
    [
        ("turn", signal.SIGTERM, 143),
        ("turn", signal.SIGINT, 130),
        ("call", signal.SIGTERM, 143),
        ("stop", signal.SIGTERM, 143),
    ],
)
def test_a_turn_that_never_yields_does_not_outlive_the_signal(how: str, number: signal.Signals, code: int) -> None:
    ended_with, said = told_to_end(how, number)
    assert ended_with == code
    assert f"{number.name} came, and the event loop has stood still for 0.4 s" in said
    assert "standstill_player.py" in said, "it does not say where"


@pytest.mark.parametrize("how", ["well", "slow"])
def test_a_program_whose_loop_goes_on_takes_its_time(how: str) -> None:
    assert told_to_end(how, signal.SIGTERM) == (143, "")


@pytest.mark.parametrize("seconds", [0.0, float("inf"), "long"])
def test_a_limit_that_is_none_is_refused(seconds: float) -> None:
    async def main() -> None:
        raise AssertionError("it runs")

    with pytest.raises(hf.errors.SpecError, match="standstill"):
        hf.run(main, standstill=seconds)
