"""Monitors and links of a recorded actor go on over the death of the root (otp.md 1.13; T14)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("ties_player.py")
PATHS = os.pathsep.join(filter(None, (str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
OTHERS = "monitored,watched,linked,untied"


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env={**os.environ, "PYTHONPATH": PATHS})


@pytest.mark.parametrize("saved", ["saved", "journaled"])
@pytest.mark.parametrize("order", [f"watcher,{OTHERS}", f"{OTHERS},watcher"], ids=["watcher first", "watcher last"])
def test_what_was_watched_before_the_root_died_is_watched_after(tmp_path: Path, order: str, saved: str) -> None:
    store = tmp_path / "app.db"
    first = run(store, order, saved, "first")
    assert first.returncode == -9, first.stderr
    second = run(store, order, saved, "second")
    assert second.returncode == 0, second.stderr
    assert sorted(json.loads(second.stdout)) == [
        "DOWN /app/monitored False",
        "DOWN /app/monitored False",
        "DOWN /app/watched False",
        "EXIT /app/linked",
    ]
    third = run(store, order, saved, "second") if saved == "saved" else None
    if third is not None:  # They were told: nothing of it is tied any more.
        assert third.returncode == 0, third.stderr
        assert len(json.loads(third.stdout)) == 4
