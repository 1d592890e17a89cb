"""Whoever was tied to somebody who does not come back with the next program is told so, once, and of nobody else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.checkpoint.test_verbs import PATHS

pytestmark = [pytest.mark.pairs, pytest.mark.usefixtures("warm_programs")]

GONE = ["made up", "given", "recorded", "spawned"]
MAY_COME = ["listed", "keyed", "journaled"]


def run(*arguments: object) -> Any:
    """What the program prints, if it ends by itself."""
    command = [sys.executable, "-m", "tests.checkpoint.gone_player", *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": PATHS}
    ended = subprocess.run(command, capture_output=True, text=True, timeout=90, env=environment, check=False)
    assert ended.returncode == (-9 if arguments[-1] == "killed" else 0), ended.stderr
    return json.loads(ended.stdout)


@pytest.mark.parametrize("end", ["killed", "stopped"])
@pytest.mark.parametrize("order", ["watcher first", "house first", "stranger first", "again"])
@pytest.mark.parametrize("place", ["task", "process"])
@pytest.mark.parametrize("kind", GONE)
@pytest.mark.parametrize("isolation", ["task", "process", "subtree"])
def test_who_does_not_come_back_is_told_of_once(
    tmp_path: Path, isolation: str, kind: str, place: str, order: str, end: str
) -> None:
    """`again`: the watcher ties itself anew in `on_recovered`. Who comes below the same supervisor is another one."""
    if kind == "given" and order == "stranger first":
        pytest.skip("an id that is given is the same one's")
    told = [tmp_path / "app.db", isolation, kind, place, order]
    path = run(*told, end)
    before, after = run(*told, "told")
    noproc = [f"DOWN {path} no such actor", f"DOWN {path} no such actor", f"EXIT {path} no such actor"]
    assert sorted(before) == noproc
    assert sorted(after) == noproc


@pytest.mark.parametrize("end", ["killed", "stopped"])
@pytest.mark.parametrize("order", ["watcher first", "house first", "again"])
@pytest.mark.parametrize("place", ["task", "process"])
@pytest.mark.parametrize("kind", MAY_COME)
@pytest.mark.parametrize("isolation", ["task", "process", "subtree"])
def test_who_may_come_back_is_waited_for(
    tmp_path: Path, isolation: str, kind: str, place: str, order: str, end: str
) -> None:
    """One of a list that was not started yet, one that goes on with its records, one that its supervisor brings."""
    told = [tmp_path / "app.db", isolation, kind, place, order]
    path = run(*told, end)
    before, after = run(*told, "told")
    assert before == []
    assert f"EXIT {path} RuntimeError: boom" in after
    assert not any("no such actor" in text for text in after)
