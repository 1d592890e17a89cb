"""The root is killed at any moment under load; who heard of an acceptance knows what must be there (T13, T14, T19).

`HOLDFAST_KILLS=10000 python -m pytest tests/checkpoint/test_kills.py` is the long campaign.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import random
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("kill_player.py")
PATHS = os.pathsep.join(filter(None, (str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
KILLS = int(os.environ.get("HOLDFAST_KILLS", "12"))
SEED = int(os.environ.get("HOLDFAST_SEED", "20260901"))
CALLERS = 8
ROUND = 6
"""Kills of one store, before it is looked at what is there."""


@dataclasses.dataclass
class Verdict:
    """What one actor has of what its callers were told."""

    accepted: int = 0
    handled: int = 0
    lost: int = 0
    doubled: int = 0
    reordered: int = 0

    def __str__(self) -> str:
        return ", ".join(f"{name} {value}" for name, value in dataclasses.asdict(self).items())


def judge(accepted: dict[int, set[int]], numbers: list[list[int]]) -> Verdict:
    """Compare."""
    verdict = Verdict(sum(map(len, accepted.values())), len(numbers))
    by_caller: dict[int, list[int]] = {caller: [] for caller in accepted}
    for caller, n in numbers:
        by_caller[caller].append(n)
    for caller, seen in by_caller.items():
        verdict.lost += len(accepted[caller] - set(seen))
        verdict.doubled += len(seen) - len(set(seen))
        verdict.reordered += sum(before > after for before, after in itertools.pairwise(seen))
    return verdict


def begin(store: Path, durability: str, *first: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(SCRIPT), str(store), durability, *map(str, first)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": PATHS})


def accepted_under_kills(
    begun: Callable[[list[int]], subprocess.Popen[bytes]],
    callers: int,
    rounds: int,
    moments: random.Random,
    most: int,
    late: float,
) -> dict[int, set[int]]:
    """Begin a root again and again and kill it; what it says that it has accepted: "caller number", line by line.

    Args:
        begun: begins it, with the number that each caller goes on with.
        callers: how many there are.
        rounds: how often it is killed.
        moments: draws when.
        most: lines after which it is killed, at most.
        late: seconds that it still has then, at most.
    """
    accepted: dict[int, set[int]] = {caller: set() for caller in range(callers)}
    for _ in range(rounds):
        # One more of each may have been accepted without our hearing of it.
        root = begun([max(seen, default=-1) + 2 for seen in accepted.values()])
        assert root.stdout is not None
        fatal, delay = moments.randint(1, most), moments.uniform(0.0, late)
        with root.stdout as out:
            for count, line in enumerate(out):
                if line.endswith(b"\n"):
                    caller, n = map(int, line.split())
                    accepted[caller].add(n)
                if count == fatal:
                    threading.Timer(delay, root.kill).start()
        assert root.wait(60) == -9, "it ended by itself"
    return accepted


@pytest.mark.parametrize("part", range(max(1, KILLS // (2 * ROUND))))
@pytest.mark.parametrize("durability", ["os", "fsync"])
def test_what_was_accepted_is_there_once_and_in_order(tmp_path: Path, durability: str, part: int) -> None:
    seed = f"{SEED} {durability} {part}"
    moments = random.Random(seed)
    store = tmp_path / "app.db"
    print(f"seed {seed}")
    accepted = accepted_under_kills(lambda first: begin(store, durability, *first), CALLERS, ROUND, moments, 600, 0.01)
    root = begin(store, durability)
    output, _ = root.communicate(timeout=120)
    assert root.returncode == 0
    first, second = json.loads(output.splitlines()[-1])
    for name, numbers in (("first", first), ("second", second)):
        verdict = judge(accepted, numbers)
        print(f"seed {seed}, {ROUND} kills, {name}: {verdict}")  # shown if it fails, or with -s
        assert (verdict.lost, verdict.doubled, verdict.reordered) == (0, 0, 0)
    assert sorted(first) == sorted(second), f"seed {seed}: what the first passed on is not what the second got"


def test_the_judge_sees_what_is_wrong() -> None:
    accepted = {0: {1, 2, 3}, 1: {1}}
    assert judge(accepted, [[0, 1], [1, 1], [0, 2], [0, 3]]) == Verdict(4, 4)
    assert judge(accepted, [[0, 2], [0, 1], [0, 1]]) == Verdict(4, 3, lost=2, doubled=1, reordered=1)
