"""Random programs of effects and waits while their processes and the root are killed, judged by an outside ledger.

`HOLDFAST_EFFECTS=10000 python -m pytest tests/effects/test_campaign.py` is the long campaign: so many kills of the
root, and a few times as many of its processes.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

import holdfast
from tests.checkpoint.test_kills import accepted_under_kills
from tests.effects.effect_player import WORKERS, program

pytestmark = pytest.mark.usefixtures("warm_programs")

ROOTS = (str(Path(holdfast.__file__).parents[1]), str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))
PATHS = os.pathsep.join(filter(None, ROOTS))
KILLS = int(os.environ.get("HOLDFAST_EFFECTS", "8"))
SEED = int(os.environ.get("HOLDFAST_SEED", "20261126"))
ROUND = 4
"""Kills of one store, before it is looked at what has happened."""

Seen = list[tuple[int, list[str]]]


def effects(how: str, index: int) -> list[str]:
    """The names of the effects of a step."""
    return [f"{how}{index}"] if how in "eto" else [f"{how}{index}{one}" for one in "ab"] if how == "g" else []


def judge(worker: int, accepted: set[int], seen: Seen, world: Iterable[str]) -> list[str]:
    """What is wrong with what a worker has seen, and with what was done to the world in its name."""
    lines = [line.split() for line in world]
    made = Counter((int(n), step) for of, n, step, _ in lines if int(of) == worker)
    keys: dict[int, set[str]] = {}
    for of, number, _, key in lines:
        if int(of) == worker:
            keys.setdefault(int(number), set()).add(key)
    numbers = [n for n, _ in seen]
    wrong = [f"{n} is lost" for n in sorted(accepted - set(numbers))]
    wrong += [f"{n} is there {count} times" for n, count in Counter(numbers).items() if count > 1]
    wrong += [f"{n} has the keys {sorted(found)}" for n, found in keys.items() if len(found) > 1]
    wrong += [f"{n}, {step}: {count} times" for (n, step), count in made.items() if step[0] == "o" and count > 1]
    for n, said in seen:
        steps = [step for index, how in enumerate(program(worker, n)) for step in effects(how, index)]
        for step, outcome in zip(steps, said, strict=True):
            if outcome == "doubt" and step[0] == "o":
                continue
            if outcome != step:
                wrong.append(f"{n}, {step}: its outcome is {outcome}")
            if not made[n, step]:
                wrong.append(f"{n}, {step}: it was not made")
    return wrong


def begin(store: Path, world: Path, durability: str, *first: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tests.effects.effect_player", str(store), str(world), durability]
    environment = {**os.environ, "PYTHONPATH": PATHS}
    return subprocess.Popen([*command, *map(str, first)], stdout=subprocess.PIPE, env=environment)


@pytest.mark.parametrize("part", range(max(1, KILLS // (2 * ROUND))))
@pytest.mark.parametrize("durability", ["os", "fsync"])
def test_each_effect_is_made_as_often_as_was_promised(tmp_path: Path, durability: str, part: int) -> None:
    seed = f"{SEED} {durability} {part}"
    moments = random.Random(seed)
    store, world = tmp_path / "app.db", tmp_path / "world"
    world.touch()
    workers = len(WORKERS)
    accepted = accepted_under_kills(
        lambda first: begin(store, world, durability, *first), workers, ROUND, moments, 150, 0.05
    )
    root = begin(store, world, durability)
    output, _ = root.communicate(timeout=120)
    assert root.returncode == 0
    found: list[Seen] = json.loads(output.splitlines()[-1])
    lines = world.read_text().splitlines()
    again = len(lines) - len(set(lines))
    doubts = sum(said.count("doubt") for seen in found for _, said in seen)
    print(f"seed {seed}, {ROUND} kills: {len(lines)} effects, {again} of them again, {doubts} in doubt")
    for worker, seen in enumerate(found):
        wrong = judge(worker, accepted[worker], seen, lines)
        assert wrong == [], f"seed {seed}, worker {worker}"
    keys = {line.split()[3]: tuple(line.split()[:2]) for line in lines}
    assert len(set(keys.values())) == len(keys), f"seed {seed}: a key came for two messages"


def test_the_judge_sees_what_is_wrong() -> None:
    n = next(n for n in range(1, 100) if len(set("etog").intersection(program(0, n))) > 1)
    made = [step for index, how in enumerate(program(0, n)) for step in effects(how, index)]
    world = [f"0 {n} {step} key" for step in made]
    assert judge(0, {n}, [(n, made)], world) == []
    assert judge(0, {n, n + 1}, [(n, made)], world) == [f"{n + 1} is lost"]
    assert judge(0, {n}, [(n, made), (n, made)], world)[0] == f"{n} is there 2 times"
    assert judge(0, {n}, [(n, made)], [*world, f"0 {n} {made[0]} other"])[0] == f"{n} has the keys ['key', 'other']"
    assert judge(0, {n}, [(n, made)], world[1:]) == [f"{n}, {made[0]}: it was not made"]
    assert judge(0, {n}, [(n, ["x", *made[1:]])], world) == [f"{n}, {made[0]}: its outcome is x"]
    assert judge(0, set(), [], ["0 7 o1 key", "0 7 o1 key"]) == ["7, o1: 2 times"]
