"""The tests that the guard watches, in random order, again and again: it has nothing to tell of any of them.

`make alarms RUNS=100`, or `python -m tests.alarms RUNS [SEED] [arguments of pytest]` from the root of the repository.
Watched are those that use the fixtures of the plugin; each run has an order of its own, which `SEED` repeats. What a
run tells is shown, and the rest are made all the same.
"""

from __future__ import annotations

import random
import re
import subprocess
import sys
import time
from collections import Counter

import pytest

FIXTURES = {"actor_system", "actor_systems"}
FILES = ("tests/testing", "tests/actors/test_topics.py")
QUIET = ("-q", "-p", "no:cacheprovider", "--tb=short", "--no-header")


class InRandomOrder:
    """Leaves the tests that the guard watches, in an order that a seed says."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        watched = [item for item in items if FIXTURES & set(getattr(item, "fixturenames", ()))]
        config.hook.pytest_deselected(items=[item for item in items if item not in watched])
        random.Random(self._seed).shuffle(watched)
        items[:] = watched


def run_again(runs: int, seed: int, arguments: list[str]) -> int:
    """Make the runs, and say what was told in each.

    Returns:
        How many of them have told anything, or failed otherwise.
    """
    failed, tests, told = 0, 0, Counter[str]()
    began = time.monotonic()
    for number in range(seed, seed + runs):
        command = [sys.executable, "-m", "tests.alarms", "--one", str(number), *(arguments or FILES)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        tests += sum(map(int, re.findall(r"(\d+) passed", done.stdout)))
        if done.returncode:
            failed += 1
            lines = re.findall(r"^(?:ERROR|FAILED) .*$", done.stdout, re.M)
            told.update(lines or [f"exit status {done.returncode}"])
            print(f"seed {number}:\n{done.stdout}{done.stderr}", flush=True)
    print(f"{runs} runs, {tests} tests, {time.monotonic() - began:.0f} s: {failed} runs with alarms")
    for line, count in told.most_common():
        print(f"{count} x {line}")
    return failed


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        sys.exit(pytest.main([*QUIET, *sys.argv[3:]], plugins=[InRandomOrder(int(sys.argv[2]))]))
    chosen = int(sys.argv[2]) if sys.argv[2:] and sys.argv[2].isdecimal() else None
    sys.exit(1 if run_again(int(sys.argv[1]), chosen or 0, sys.argv[2 if chosen is None else 3 :]) else 0)
