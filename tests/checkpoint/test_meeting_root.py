"""The root dies by SIGKILL around final snapshots, erasures and starts of journaled children: all of it, or none."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("meeting_player.py")
PATHS = os.pathsep.join(filter(None, (str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
KILLS = 6


class Model:
    """What must be there after a kill, as far as it was said: each fact is there, is not, or (None) may be."""

    def __init__(self) -> None:
        self.words: list[str] = []
        self.children: set[str] = set()
        self.empty: set[str] = set()  # whose start was begun when the root died, before they got their word
        self.begun = ""

    def hear(self, line: str) -> None:
        if line != "done":
            self.begun = line
            return
        self.words, self.children = self.after()
        self.begun = ""

    def after(self) -> tuple[list[str], set[str]]:
        """If what was begun is done."""
        verb, _, name = self.begun.partition(" ")
        words = [] if verb == "fresh" else [*self.words, name] if verb == "put" else self.words
        children = {"start": self.children | {name}, "end": self.children - {name}}.get(verb, self.children)
        return words, children

    def check(self, have: dict[str, list[str]], seed: str) -> None:
        words, children = have.pop("ledger"), set(have)
        assert words in (self.words, self.after()[0]), f"{seed}, in {self.begun!r}: {words} of {self.words}"
        assert children in (self.children, self.after()[1]), f"{seed}, in {self.begun!r}: {children ^ self.children}"
        for name, held in have.items():
            if f"start {name}" == self.begun and not held:
                self.empty.add(name)
            assert held == ([] if name in self.empty else [name]), f"{seed}: {name} has {held}"
        self.words, self.children, self.begun = words, children, ""


@pytest.mark.parametrize("seed", [20_260_701, 20_260_702, 20_260_703])
def test_a_kill_of_the_root_leaves_everything_done_or_not_begun(tmp_path: Path, seed: int) -> None:
    moments, model = random.Random(seed), Model()
    for life in range(KILLS + 1):
        where = f"seed {seed}, life {life}"
        steps = 0 if life == KILLS else 1_000_000
        command = [sys.executable, str(SCRIPT), str(tmp_path / "app.db"), str(moments.getrandbits(32)), str(steps)]
        root = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": PATHS})
        fatal, delay = moments.randint(1, 60), moments.uniform(0.0, 0.006)
        assert root.stdout is not None
        try:
            with root.stdout as out:
                model.check(json.loads(out.readline()), where)
                for count, line in enumerate(out):
                    model.hear(line.strip())
                    if count == fatal:
                        threading.Timer(delay, root.kill).start()
        except BaseException:
            root.kill()
            root.wait(60)
            raise
        assert root.wait(60) == (0 if life == KILLS else -9), f"{where}: it ended by itself"
