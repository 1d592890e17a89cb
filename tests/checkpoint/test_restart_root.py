"""The root dies by SIGKILL under load; a new one takes up the same tree from the same store (DESIGN 6, T10, T14)."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("root_player.py")
# The root of the package may be its folder under another name, so the way to it is told.
PATHS = os.pathsep.join(filter(None, (str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
SEED = 20_260_601
KILLS = 4


def begin(store: Path, first: int, last: int) -> subprocess.Popen[str]:
    command = [sys.executable, str(SCRIPT), str(store), str(first), str(last)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": PATHS})


def test_all_that_was_accepted_is_there_once_after_kills_of_the_root(tmp_path: Path) -> None:
    moments = random.Random(SEED)
    store, accepted, unsure = tmp_path / "app.db", set[int](), set[int]()
    following = 1
    for _ in range(KILLS):
        fatal = following + moments.randint(1, 400)
        root = begin(store, following, 1_000_000)
        assert root.stdout is not None
        with root.stdout as out:
            for line in out:
                accepted.add(int(line))
                if int(line) == fatal:
                    root.kill()
        assert root.wait() == -9, f"seed {SEED}: it ended by itself"
        unsure.add(max(accepted) + 1)  # It may have been accepted without our hearing of it.
        following = max(accepted) + 2
    root = begin(store, 1, 0)
    output, _ = root.communicate(timeout=60)
    assert root.returncode == 0
    first, second = json.loads(output.splitlines()[-1])
    assert first == second, f"seed {SEED}: what the first passed on is not what the second got"
    assert first == sorted(set(first)), f"seed {SEED}: doubled or reordered"
    assert accepted <= set(first), f"seed {SEED}: lost {sorted(accepted - set(first))[:10]}"
    assert set(first) <= accepted | unsure


def run_again(store: Path, how: str) -> tuple[list[int], list[str], list[str]]:
    """What becomes of actors whose turns in hand raise, or kill, when the next program runs them again."""
    script = Path(__file__).with_name("raising_player.py")
    environment = {**os.environ, "PYTHONPATH": PATHS}
    for life, code in (("first", -9), ("second", 0)):
        command = [sys.executable, str(script), str(store), life, how]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
        assert ended.returncode == code, ended.stderr
    pings, crashed, restarted = json.loads(ended.stdout)
    return pings, crashed, restarted


def test_a_turn_that_raises_when_it_is_run_again_is_a_crash_and_no_failed_start(tmp_path: Path) -> None:
    pings, crashed, restarted = run_again(tmp_path / "app.db", "raises")
    assert pings == [1, 1, 1, 1], "what waited behind it was lost"
    assert crashed == restarted == ["/app/here/below", "/app/process", "/app/task", "/app/there/below"]


def test_a_turn_that_kills_its_process_when_it_is_run_again_is_no_failed_start(tmp_path: Path) -> None:
    pings, _, restarted = run_again(tmp_path / "app.db", "kills")
    assert pings == [1, 1], "what waited behind it was lost"
    assert restarted == ["/app/process", "/app/there"]
