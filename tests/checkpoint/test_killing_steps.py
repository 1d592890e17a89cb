"""What kills the root at a step of a turn is put aside, whatever the turn has waited for; who merely waits never is.

`HOLDFAST_CROSSED=1` crosses all that may come before with all that kills, and has more who wait.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.checkpoint.test_restart_root import PATHS

pytestmark = pytest.mark.usefixtures("warm_programs")

PLAYER = Path(__file__).with_name("killing_player.py")
IS_CROSSED = "HOLDFAST_CROSSED" in os.environ
FIRST, KILLS = (
    ("wait", "sleep", "until", "ask", "async", "thread", "process", ""),
    ("fatal async", "fatal thread", "fatal race", "fatal code"),
)
SOME = [("sleep", "fatal async"), ("wait", "fatal thread"), ("ask", "fatal race")]
PATIENT = [("", "async"), ("sleep", "ask"), ("", "retried"), ("async", "wait"), ("until", "sleep")]
MORE_PATIENT = [
    *itertools.product(FIRST, ("async", "ask", "wait", "sleep", "retried")),
    ("", "process"),
    ("sleep", "process"),
]


def live(store: Path, steps: list[str]) -> tuple[bool, list[list[object]]]:
    """One program, until it dies: whether of itself, and then what was put aside."""
    command = [sys.executable, str(PLAYER), str(store), *steps]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": PATHS}, timeout=120)
    assert done.returncode == -9, done.stderr
    return bool(done.stdout), json.loads(done.stdout or "[]")


@pytest.mark.parametrize("guilty", [list(itertools.product(FIRST, [how])) for how in KILLS] if IS_CROSSED else [SOME])
def test_what_kills_is_put_aside_and_what_waits_is_not(tmp_path: Path, guilty: list[tuple[str, str]]) -> None:
    innocent = MORE_PATIENT if IS_CROSSED else PATIENT
    steps = [
        f"{kind}:{first}:{then}" for kind, of in (("innocent", innocent), ("guilty", guilty)) for first, then in of
    ]
    store, most = tmp_path / "app.db", 3 * len(guilty)
    deaths = next((count for count in range(most + 1) if live(store, steps)[0]), -1)
    assert 2 * len(guilty) <= deaths  # More, if somebody else was at work when a thread has killed the program.
    expected = sorted([f"/app/guilty{len(innocent) + index}", 2] for index in range(len(guilty)))
    for _ in range(9 if IS_CROSSED else 2):
        assert sorted(live(store, steps)[1]) == expected


def test_of_several_turns_with_threads_the_one_that_kills_is_put_aside(tmp_path: Path) -> None:
    """They run one at a time, for each of them may have been it."""
    steps = ["slow::slow", "slow::slow", "guilty::fatal thread"]
    lives = [live(tmp_path / "app.db", steps) for _ in range(3)]
    assert lives == [(False, []), (False, []), (True, [["/app/guilty2", 2]])]


def test_who_was_at_work_once_and_is_not_started_any_more_does_not_hide_others(tmp_path: Path) -> None:
    store, steps = tmp_path / "app.db", ["innocent::sleep", "guilty::fatal thread"]
    assert live(store, ["guilty::fatal code"]) == (False, [])
    assert [live(store, steps) for _ in range(3)] == [(False, []), (False, []), (True, [["/app/guilty1", 2]])]
