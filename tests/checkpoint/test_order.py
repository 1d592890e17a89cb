"""Messages from one recorded sender to one receiver stay in order, over programs that start either of them late.

`HOLDFAST_ORDER=200 python -m pytest tests/checkpoint/test_order.py` is the long campaign.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast
from tests.checkpoint.order_player import RECEIVERS, SUPERVISORS

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("order_player.py")
PATHS = os.pathsep.join(filter(None, (str(Path(holdfast.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
ROUNDS = int(os.environ.get("HOLDFAST_ORDER", "1"))
SEED = int(os.environ.get("HOLDFAST_SEED", "20261128"))

Steps = list[list[Any]]


def program(store: Path, steps: Steps) -> str:
    """Run a program to its end; what it has printed."""
    command = [sys.executable, str(SCRIPT), str(store), json.dumps(steps)]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": PATHS}, capture_output=True, text=True, timeout=180, check=False
    )
    assert done.returncode == (-9 if any("kill" in step[0] for step in steps) else 0), f"{steps}\n{done.stderr[-3000:]}"
    return done.stdout


def judge(said: str, *, is_lossless: bool) -> None:
    """What has come from each sender rises, and without losses all is there that had to come."""
    sent, got = json.loads(said)
    for to, name in itertools.product(RECEIVERS, sent):
        numbers, passed = got[to].get(name, []), got[to].get(f"{name} by the gate", [])
        assert all(before < after for before, after in itertools.pairwise(passed)), f"{name} by the gate: {passed}"
        if is_lossless:
            missing = set(sent[name].get(f"{to} by the gate", ())) - set(passed)
            assert not missing, f"{name} by the gate to {to}: {missing} are missing in {passed}"
        assert all(before < after for before, after in itertools.pairwise(numbers)), f"{name} to {to}: {numbers}"
        if is_lossless:
            missing = set(sent[name].get(to, ())) - set(numbers)
            assert not missing, f"{name} to {to}: {missing} of {sent[name][to]} are missing in {numbers}"


@pytest.mark.parametrize("how", ["kill", "end"])
@pytest.mark.parametrize("kind", ["task", "process", "pbr"])
def test_what_an_earlier_program_has_kept_comes_first(kind: str, how: str, tmp_path: Path) -> None:
    store, begin = tmp_path / "app.db", [["sender", "s0", kind]]
    receivers = [["supervisor", name, "task"] for name in SUPERVISORS]
    end = [["kill"]] if how == "kill" else []
    program(store, [*begin, *receivers, ["say", "s0", "r0", "tell", 3]])
    for verb in ("tell", "send"):
        program(store, [*begin, ["say", "s0", "r0", verb, 5], *end])
    judge(
        program(store, [*begin, ["say", "s0", "r0", "tell", 5], *receivers, ["tell all", ["s0"]]]),
        is_lossless=True,
    )


@pytest.mark.parametrize("verb", ["tell", "send"])
def test_who_has_moved_is_told_under_its_old_address_before_it_is_started(verb: str, tmp_path: Path) -> None:
    store, begin = tmp_path / "app.db", [["sender", "s0", "task"]]
    receivers = [["supervisor", name, "task"] for name in SUPERVISORS]
    program(store, [*begin, *receivers])
    program(store, [*receivers, ["move", "r1", "south"]])
    program(store, [*begin, ["say", "s0", "r1", verb, 3], ["kill"]])
    judge(program(store, [*begin, ["say", "s0", "r1", verb, 3], *receivers, ["tell all", ["s0"]]]), is_lossless=True)


@pytest.mark.parametrize(("first", "moved"), [("sender", "before"), ("receiver", "after")])
@pytest.mark.parametrize("verb", ["tell", "send", "ask"])
def test_a_replay_knows_a_receiver_by_each_address_that_it_has_had(
    verb: str, first: str, moved: str, tmp_path: Path
) -> None:
    store, begin = tmp_path / "app.db", [["sender", "s0", "task"]]
    receivers: Steps = [["supervisor", name, "task"] for name in SUPERVISORS]
    move: Steps = [*receivers, ["move", "r2", "north"], ["kill"]]
    if moved == "before":
        program(store, move)
    program(store, [*begin, *receivers, ["say", "s0", "r2", verb, 2], ["kill"]])
    if moved == "after":
        program(store, move)
    both = [*begin, *receivers] if first == "sender" else [*receivers, *begin]
    judge(program(store, [*both, ["tell all", ["s0"]]]), is_lossless=True)


@pytest.mark.parametrize(("kind", "verb"), [("task", "tell"), ("task", "ask"), ("pbr", "send")])
def test_whoever_is_removed_and_started_anew_says_other_things_than_before(
    verb: str, kind: str, tmp_path: Path
) -> None:
    """The new sender counts its turns from the beginning, and its own numbers from 100 on."""
    store, begin = tmp_path / "app.db", [["sender", "s0", kind]]
    receivers: Steps = [["supervisor", name, "task"] for name in SUPERVISORS]
    say: Steps = [["say", "s0", "r0", verb, 2]]
    program(store, [*begin, *receivers, *say])
    anew: Steps = [["sender anew", "s0", kind, 100]]
    program(store, [*begin, *anew, *say, ["wait", 0.1], ["kill"]])
    again: Steps = [["sender anew", "s0", kind, 200]]
    program(store, [["sender", "s0", kind, 100], *say, *again, *say, ["wait", 0.1]])
    said = program(store, [["sender", "s0", kind, 200], *receivers, ["tell all", ["s0"]]])
    judge(said, is_lossless=True)
    got = json.loads(said)[1]["r0"]["s0"]
    assert {1, 2, 101, 102, 103, 104, 201, 202} <= set(got), f"something is missing in {got}"


def test_who_is_answered_by_another_program_when_the_ask_had_timed_out_starts_again(tmp_path: Path) -> None:
    store, begin, receiver = tmp_path / "app.db", [["sender", "s0", "task"]], [["supervisor", "north", "task"]]
    program(store, [*begin, *receiver])
    program(store, [*receiver, *begin, ["end supervisor", "north"], ["say", "s0", "r0", "ask", 2], ["kill"]])
    program(store, [*receiver, ["wait", 0.1], ["kill"]])  # It answers into the journal of who is not there.
    last: Steps = [*begin, *receiver, ["supervisor", "south", "task"], ["tell all", ["s0"]]]
    judge(program(store, last), is_lossless=True)


class Plan:
    """The steps of some programs, drawn by a seed."""

    def __init__(self, seed: int, *, is_lossless: bool) -> None:
        self.draw = random.Random(seed)
        self.is_lossless = is_lossless
        pick = self.draw.choice
        self.senders = {name: pick(["task", "task", "process", "pbr", "lfr"]) for name in ("s0", "s1", "gate")}
        self.supervisors = {name: pick(["task", "task", "process", "pbr"]) for name in SUPERVISORS}
        self.at = {name: path.split("/")[2] for name, path in RECEIVERS.items()}
        self.stopped = set[str]()

    def path(self, name: str) -> str:
        return f"/app/{self.at[name]}/{name}"

    def begin_all(self) -> Steps:
        return [
            *(["sender", *one] for one in self.senders.items()),
            *(["supervisor", *one] for one in self.supervisors.items()),
        ]

    def say(self, senders: list[str]) -> list[Any]:
        verbs = ["tell", "send", "timer", "pass on", *(["stream"] if self.is_lossless else ["publish", "ask", "pass"])]
        draw = self.draw
        return ["say", draw.choice(senders), draw.choice(list(RECEIVERS)), draw.choice(verbs), draw.randint(1, 6)]

    def program(self) -> Steps:
        draw, steps, up, ended = self.draw, Steps(), list[str](), set[str]()
        waiting = self.begin_all()
        draw.shuffle(waiting)
        if draw.random() < 0.7:
            waiting = waiting[: draw.randint(1, len(waiting))]
        for _ in range(draw.randint(4, 14)):
            if waiting and (not up or draw.random() < 0.35):
                begun = waiting.pop()
                steps.append(begun)
                up.append(begun[1])
                continue
            senders = [name for name in up if name in self.senders and name != "gate"]
            above = [name for name in up if name in SUPERVISORS and name not in ended]
            free = [name for name, where in self.at.items() if where in above]
            kind = draw.choice(
                ["say"] * 6
                + ["move"] * 2 * self.is_lossless
                + ["restart", "end", "begin", "move", "wait", "stop", "start"]
            )
            if kind == "say" and senders:
                steps.append(self.say(senders))
            elif kind == "restart" and above:
                steps.append(["restart", draw.choice(above)])
            elif kind == "end" and above:
                steps.append(["end supervisor", one := draw.choice(above)])
                ended.add(one)
            elif kind == "begin" and ended:
                steps.append(["begin supervisor", one := draw.choice(sorted(ended))])
                ended.discard(one)
            elif kind == "wait":
                steps.append(["wait", draw.choice([0.0, 0.02, 0.15])])
            elif kind == "move" and len(above) == 2 and (movable := sorted(set(free) - self.stopped)):
                one = draw.choice(movable)
                to = "south" if self.at[one] == "north" else "north"
                steps.append(["move", one, to])
                self.at[one] = to
            elif kind == "stop" and not self.is_lossless and (running := sorted(set(free) - self.stopped)):
                one = draw.choice(running)
                steps.append(["stop", self.path(one)])
                self.stopped.add(one)
            elif kind == "start" and (idle := sorted(set(free) & self.stopped)):
                one = draw.choice(idle)
                steps.append(["start", f"/app/{self.at[one]}", one])
                self.stopped.discard(one)
        if self.is_lossless and draw.random() < 0.5:
            steps.insert(draw.randrange(len(steps)), ["kill soon", 0.2 * draw.random()])
            steps.append(["wait", 10.0])
        elif draw.random() < 0.6:
            steps.append(["kill"])
        return steps

    def last(self) -> Steps:
        starts = [["start", f"/app/{self.at[name]}", name] for name in sorted(self.stopped)]
        return [
            *self.begin_all(),
            *starts,
            ["tell all", [name for name in self.senders if name != "gate"]],
        ]


@pytest.mark.parametrize("is_lossless", [True, False], ids=["all must come", "some may be lost"])
@pytest.mark.parametrize("number", range(ROUNDS))
def test_what_comes_rises_over_random_programs(number: int, is_lossless: bool, tmp_path: Path) -> None:
    seed = SEED + number
    print(f"HOLDFAST_SEED={seed}")
    plan, store = Plan(seed, is_lossless=is_lossless), tmp_path / "app.db"
    programs = [plan.begin_all(), *(plan.program() for _ in range(plan.draw.randint(2, 5)))]
    for steps in programs:
        print(json.dumps(steps))
        program(store, steps)
    judge(program(store, plan.last()), is_lossless=is_lossless)
