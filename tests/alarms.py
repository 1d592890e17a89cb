"""Tests under the guard, in random order, again and again: it has nothing to tell of any of them.

`make alarms RUNS=100`, or `python -m tests.alarms RUNS [SEED] [arguments of pytest]` from the root of the repository.
Watched are those that use the fixtures of the plugin, and every other async test, too: there is a guard around each,
and what its systems send and reply is looked at. (Most of the latter crash actors and lose letters on purpose, so that
is not told.) A test that leaves something behind on purpose, or mutates what it has sent, says so as a user's does, by
`@pytest.mark.holdfast(...)`. Each run has an order of its own, which `SEED` repeats, as it repeats what
Hypothesis draws. What a run tells is shown, and the rest are made all the same.
"""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_asyncio

from holdfast.system.system import ActorSystem
from holdfast.testing.guard.sends import SendChecks
from holdfast.testing.guarded import Guard, GuardedSystem, UnexpectedEnd
from holdfast.testing.plugin import EXPECTABLE
from holdfast.testing.swaps import Swaps
from holdfast.testing.wanted import SystemsWanted

FIXTURES = {"actor_system", "actor_systems"}
ROOMS = {
    "testing": ("tests/testing",),
    "actors": ("tests/actors", "--ignore=tests/actors/process"),
    "supervision": ("tests/supervision",),
    "checkpoint": tuple(
        f"tests/checkpoint/test_{name}.py"
        for name in (
            *("begun_first", "commit_lanes", "commits", "finding", "hook_changes", "ignored", "keys", "limits"),
            *("plain", "restart_timers", "restart_unrecorded", "turn_rows", "verbs"),
        )
    ),
}
"""What is run in turn, a room in each run. Of the last one some units: all of it takes as long as the others."""
SEED = "HOLDFAST_RANDOM"
QUIET = ("-q", "-p", "no:cacheprovider", "--tb=short", "--no-header")


class SystemsWatched:
    """Looks at what all systems of a test send and reply that have no guard of their own."""

    def __init__(self, wanted: SystemsWanted) -> None:
        self._wanted = wanted
        self.checks: dict[ActorSystem, SendChecks] = {}
        self._swaps = Swaps()
        self._swaps.put(ActorSystem, "__aenter__", self._entering(ActorSystem.__aenter__))
        self._swaps.put(ActorSystem, "shutdown", self._ending(ActorSystem.shutdown))

    def _entering(self, enter: Any) -> Any:
        async def entered(system: ActorSystem) -> ActorSystem:
            await enter(system)
            if not isinstance(system, GuardedSystem):
                checks = self.checks[system] = SendChecks(system._node)
                checks.is_expected, checks.are_replies_expected, checks.are_types_expected = map(
                    self._wanted.expects, ("sends", "replies", "types")
                )
            return system

        return entered

    def _ending(self, end: Any) -> Any:
        async def ended(system: ActorSystem) -> None:
            checks = self.checks.get(system)
            if checks is not None:
                checks.last_look()
            try:
                await end(system)
            finally:
                if checks is not None:
                    checks.close()

        return ended

    def close(self) -> list[str]:
        """End that, and list what was not expected."""
        self._swaps.undo()
        found: list[str] = []
        for system, checks in self.checks.items():
            checks.close()
            found += [f"system {system.name!r}: {problem}" for problem in checks.problems()]
        return found


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave the tests that are watched, in an order that the seed says."""
    watched = [item for item in items if _is_watched(item)]
    config.hook.pytest_deselected(items=[item for item in items if item not in watched])
    random.Random(os.environ[SEED]).shuffle(watched)
    items[:] = watched


def _is_watched(item: pytest.Item) -> bool:
    return bool(FIXTURES & set(getattr(item, "fixturenames", ()))) or pytest_asyncio.is_async_test(item)


@pytest.fixture(autouse=True)
def guard_if_async(no_task_left_if_async: None, request: pytest.FixtureRequest) -> None:
    if pytest_asyncio.is_async_test(request.node):
        request.getfixturevalue("guard_around")


@pytest_asyncio.fixture
async def guard_around(no_task_left: None, request: pytest.FixtureRequest) -> AsyncIterator[None]:
    wanted = SystemsWanted(request.node, EXPECTABLE)
    guard = Guard(allowed=wanted.leaks, exceptions=not wanted.exceptions)
    systems = SystemsWatched(wanted)
    try:
        yield
    finally:
        problems = systems.close()
        await guard.close()
    if problems:
        raise UnexpectedEnd(tuple(problems))


def run_again(runs: int, seed: int, arguments: list[str]) -> int:
    """Make the runs, and say what was told in each.

    Returns:
        How many of them have told anything, or failed otherwise.
    """
    failed, tests, told = 0, 0, Counter[str]()
    began = time.monotonic()
    rooms = list(ROOMS)
    for number in range(seed, seed + runs):
        room = rooms[number % len(rooms)]
        command = [sys.executable, "-m", "pytest", "-p", "tests.alarms", *QUIET, *(arguments or ROOMS[room])]
        env = {**os.environ, SEED: str(number + 2)}  # 0 and 1 have a meaning of their own.
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        passed = sum(map(int, re.findall(r"(\d+) passed", done.stdout)))
        tests += passed
        print(f"seed {number}, {'as said' if arguments else room}: {passed} tests passed", flush=True)
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
    chosen = int(sys.argv[2]) if sys.argv[2:] and sys.argv[2].isdecimal() else None
    sys.exit(1 if run_again(int(sys.argv[1]), chosen or 0, sys.argv[2 if chosen is None else 3 :]) else 0)
