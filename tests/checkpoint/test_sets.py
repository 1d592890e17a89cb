"""A set has no order, and its texts another one in each process: a replay does not mind (T21)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("sets_player.py")
# The root of the package may be its folder under another name, so the way to it is told.
ROOTS = str(Path(holdfast.__file__).parents[1]), str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")
PATHS = os.pathsep.join(filter(None, ROOTS))


def test_what_holds_sets_is_the_same_in_the_next_root(isolation: str, tmp_path: Path) -> None:
    """Replies, promised ones, refusals and whatever else a turn sends."""

    def root(seed: int, end: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(SCRIPT), str(tmp_path / "app.db"), isolation, end]
        environment = {**os.environ, "PYTHONPATH": PATHS, "PYTHONHASHSEED": str(seed)}
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100, check=False)

    first = root(1, "killed")
    assert first.returncode == -9, first.stderr
    again = root(2, "read")  # Of so many words, the other order is the same by a miracle only.
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout) == [[], [8, 8, 8, 8]], again.stderr
