"""SIGINT and SIGTERM at any moment, once or twice: the program ends in time, and leaves nothing behind.

`HOLDFAST_SIGNALS=n` sends them to n programs, `HOLDFAST_SEED` draws other moments.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

import holdfast
from tests.system.signal_player import BOUND

RUNS = int(os.environ.get("HOLDFAST_SIGNALS", "3"))
SEED = os.environ.get("HOLDFAST_SEED", "20261122")
SCRIPT = Path(__file__).with_name("signal_player.py")
ROOT = Path(__file__).parents[2]
PATHS = os.pathsep.join(
    filter(None, (str(ROOT), str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH")))
)
PATIENCE = 3 * BOUND  # of a machine that is busy with other things
ENDS = {signal.SIGINT: ("KeyboardInterrupt",), signal.SIGTERM: ("",)}


@pytest.mark.parametrize("number", range(RUNS))
def test_a_program_ends_in_time_whenever_it_is_told_to(number: int, tmp_path: Path) -> None:
    chance = random.Random(f"{SEED} {number}")
    first, *more = chance.choices((signal.SIGINT, signal.SIGTERM), k=chance.choice((1, 2)))
    while_up = number % 3 != 0
    moment, pause = chance.uniform(0.0, 1.0 if while_up else 2.0), chance.uniform(0.0, 0.5)
    plan = (
        f"seed {SEED}, {'up' if while_up else 'begun'} + {moment:.3f} s: {first.name}, then {more} after {pause:.3f} s"
    )
    sign = f"HOLDFAST_TEST_SIGNALS={tmp_path}"
    environment = {**os.environ, "PYTHONPATH": PATHS, "HOLDFAST_TEST_SIGNALS": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, str(SCRIPT), str(tmp_path / "app.db")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as program:
        try:
            assert program.stdout is not None
            for told in ("begun\n", "up\n")[: 1 + while_up]:
                assert program.stdout.readline() == told, plan
            time.sleep(moment)  # What is tested is that the moment does not matter.
            program.send_signal(first)
            for other in more:
                time.sleep(pause)
                program.send_signal(other)
            _, errors = program.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            program.send_signal(signal.SIGUSR1)
            with contextlib.suppress(subprocess.TimeoutExpired):
                program.communicate(timeout=1.0)
            program.kill()
            pytest.fail(f"it did not end: {plan}\n{program.communicate()[1]}")
        finally:
            program.kill()
    assert program.returncode in (143, 130, -signal.SIGINT, -signal.SIGTERM), (plan, errors)
    assert errors.rstrip().rpartition("\n")[2] in {end for one in (first, *more) for end in ENDS[one]}, (plan, errors)
    assert "ResourceWarning" not in errors, plan
    left = [one.pid for one in psutil.process_iter() if sign in _environment(one)]
    assert not left, (plan, left)


def _environment(process: psutil.Process) -> list[str]:
    try:
        return [f"{name}={value}" for name, value in process.environ().items()]
    except psutil.Error:
        return []
