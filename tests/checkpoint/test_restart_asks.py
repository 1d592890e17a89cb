"""The root dies while asks between recorded actors are out; the next one has them answered, once (T14, T20, T23)."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("rejoin_player.py")
PATHS = os.pathsep.join(filter(None, (str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH"))))


def run(*arguments: object, script: Path = SCRIPT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env={**os.environ, "PYTHONPATH": PATHS})


@pytest.mark.parametrize("how", ["wait", "later", "saved", "forward"])
@pytest.mark.parametrize("order", [",".join(one) for one in itertools.permutations(["asker", "relay", "oracle"])])
def test_an_ask_that_was_out_when_the_root_died_is_answered(tmp_path: Path, how: str, order: str) -> None:
    store = tmp_path / "app.db"
    first = run(store, how, order, "first")
    assert first.returncode == -9, first.stderr
    second = run(store, how, order, "second")
    assert second.returncode == 0, second.stderr
    answers, asked = json.loads(second.stdout)
    assert answers == [10, 20]
    assert asked == 2, "a question reached the oracle twice, or not at all"


@pytest.mark.parametrize("order", ["busy,asker", "asker,busy"])
def test_an_ask_that_waited_for_room_when_the_root_died_ends_at_its_deadline(tmp_path: Path, order: str) -> None:
    store, script = tmp_path / "app.db", SCRIPT.with_name("waiting_player.py")
    first = run(store, "busy,asker", "first", script=script)
    assert first.returncode == -9, first.stderr
    second = run(store, order, "second", script=script)
    assert (second.returncode, second.stdout) == (0, "late, handled: None\n"), second.stderr
