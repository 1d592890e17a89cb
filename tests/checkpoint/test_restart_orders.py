"""Orders that a recorded turn gives to actors of the runtime, which keep no journal, when the program is killed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.checkpoint.conftest import ROOT

pytestmark = pytest.mark.usefixtures("warm_programs")

HEARD = {
    "by id": "/app/house/dynamic/one",
    "without id": "AskTimeout None",
    "fresh": "AskTimeout None",
    "end": "NoneType",
    "erase": "NoneType NoneType",
    "restart": "AskTimeout None",
    "of the user": "AskTimeout None",
}


@pytest.mark.parametrize("place", ["task", "process"])
@pytest.mark.parametrize(("order", "heard"), HEARD.items())
def test_the_next_program_gives_an_order_again_that_bears_it(
    tmp_path: Path, order: str, heard: str, place: str
) -> None:
    """Of others nobody knows whether they were obeyed, and whoever has given them is told so."""
    command = [sys.executable, "-m", "tests.checkpoint.orders_player", f"sqlite:{tmp_path / 'app.db'}", order, place]
    for run, code, out in (("first", -9, ""), ("next", 0, f"{heard}\n")):
        done = subprocess.run([*command, run], capture_output=True, text=True, cwd=ROOT)
        assert (done.returncode, done.stdout) == (code, out), done.stderr
