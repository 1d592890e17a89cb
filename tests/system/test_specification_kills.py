"""Random transactions while the root is killed and started again: the tree is as before the last one or as after it.

HOLDFAST_ROOTS=N kills so many roots in a row, on one store; HOLDFAST_SEED=N draws others.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.system.transaction.arrangement import Arrangement
from holdfast.system.transaction.draft import Draft
from tests.launched import environment
from tests.system.trees import Add, Client, Counter, Double, counter, ref

pytestmark = pytest.mark.usefixtures("warm_programs")

KILLS = int(os.environ.get("HOLDFAST_ROOTS", "6"))
SEED = int(os.environ.get("HOLDFAST_SEED", "1"))
LONGEST = 0.4
"""Seconds that a root lives at most once it changes its tree."""
TOPS = ("/app/left", "/app/right")
"""They stay where they are; two more children of the root may go anywhere."""
OURS = "rst"
"""The recorded actors that the program has from the beginning."""


@asynccontextmanager
async def program(store: str) -> AsyncGenerator[hf.ActorSystem]:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False) as system:
        recorded = hf.hybrid(interval=900.0)
        client = hf.child("client", hf.start(Client), bindings={"peer": "/app/left/a"})
        below = hf.supervisor("sub", intensity=9, children=[counter("x"), counter("y")])
        await system.start(hf.supervisor("left", children=[counter("a"), counter("r", recovery=recorded), below]))
        await system.start(hf.supervisor("right", children=[counter("b"), client, counter("s", recovery=recorded)]))
        await system.start(counter("t", recovery=recorded))
        await system.start(hf.supervisor("low", children=[counter("u")]))
        yield system


def lines(system: hf.ActorSystem) -> list[str]:
    """The tree in words: who is where, in which order, of which class, by which flags and bound to whom."""
    return ours(Draft(system._node, Arrangement(), 10.0).lines())


def ours(tree: list[str]) -> list[str]:
    """Without what the system itself has, which comes with the first recorded actor."""
    return [line for line in tree if line.startswith("/app/") and not line.startswith("/app/recovery")]


def draw(dice: random.Random, change: hf.system.Change, tree: list[str], number: int) -> None:
    """One random step."""
    paths = [line.partition(":")[0] for line in tree]
    supervisors = ["/app", *(path for path, line in zip(paths, tree, strict=True) if ": Supervisor" in line)]
    others = [path for path in paths if path not in TOPS]
    above, one = dice.choice(supervisors), dice.choice(others)
    names = [path.rpartition("/")[2] for path in others if path.rpartition("/")[0] == above]
    match dice.randrange(9):
        case 0:
            change.add(above, counter(f"n{number}", recovery=dice.choice([None, hf.hybrid(interval=900.0)])))
        case 1:
            change.add(above, hf.supervisor(f"t{number}", children=[counter("z")]))
        case 2:
            if not any(path.rpartition("/")[2] in OURS for path in paths if f"{path}/".startswith(f"{one}/")):
                change.remove(one)  # These stay: what is acknowledged at them is looked at.
        case 3:
            change.move(one, above)
        case 4:
            dice.shuffle(names)
            change.reorder(above, names)
        case 5:
            change.strategy(above, dice.choice(["one_for_one", "one_for_all", "rest_for_one"]))
        case 6:
            change.intensity(above, dice.randrange(5, 99), float(dice.randrange(1, 9)))
        case 7:
            change.replace_code(one, dice.choice([Counter, Double]))
        case _:
            change.replace_state(dice.choice(["/app/left/r", "/app/right/s"]), one_more)


def one_more(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "count": state["count"] + 1}


async def changing(store: str, log: str, seed: int) -> None:
    """Change the tree for ever, and say before each change what comes of it, and behind it that it is in force."""
    dice = random.Random(seed)
    async with program(store) as system:
        number = seed * 1000
        with open(log, "w", encoding="utf-8", buffering=1) as told, open(f"{log}.acks", "a", buffering=1) as acks:
            told.write(f"0\t{'|'.join(lines(system))}\n")
            while True:
                number += 1
                steps = [dice.randrange(2**32) for _ in range(dice.randrange(1, 4))]
                tree = lines(system)

                def collect(change: hf.system.Change, steps: list[int] = steps, tree: list[str] = tree) -> None:
                    for at, one in enumerate(steps):
                        draw(random.Random(one), change, tree, number * 10 + at)  # noqa: B023

                dry = system.transaction(dry_run=True)
                try:
                    async with dry as change:
                        collect(change)
                except hf.TransactionRefused:
                    continue
                assert dry._draft is not None
                told.write(f"{number}\t{'|'.join(ours(dry._draft.lines()))}\n")
                async with system.transaction(timeout=10.0) as change:
                    collect(change)
                told.write(f"{number}\n")
                for path in recorded(system):  # Wherever they are now.
                    acks.write(f"{path.rpartition('/')[2]} {await ref(system, path).ask(Add(1))}\n")


def recorded(system: hf.ActorSystem) -> list[str]:
    """The addresses of the recorded actors that the program has from the beginning, if they are still there."""
    paths = [line.partition(":")[0] for line in lines(system)]
    return [path for path in paths if path.rpartition("/")[2] in OURS]


PROGRAM = """
import asyncio, sys
from tests.system.test_specification_kills import changing


if __name__ == "__main__":
    asyncio.run(changing(sys.argv[1], sys.argv[2], int(sys.argv[3])))
"""


async def test_the_tree_is_as_before_or_as_after_the_last_transaction_whenever_the_root_is_killed(
    tmp_path: Path,
) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    dice, store, log = random.Random(SEED), str(tmp_path / "store"), tmp_path / "log"
    carried_out = 0
    for kill in range(KILLS):
        seed = SEED * 100_000 + kill
        arguments = (str(tmp_path / "program.py"), store, str(log), str(seed))
        process = subprocess.Popen([sys.executable, *arguments], env=environment())
        async with asyncio.timeout(60):
            while not (log.exists() and log.read_text()):
                await asyncio.sleep(0.005)
        await asyncio.sleep(dice.uniform(0.0, LONGEST))
        process.send_signal(signal.SIGKILL)
        assert await asyncio.to_thread(process.wait) == -signal.SIGKILL, f"seed {seed}: it has ended by itself"
        told = [line.split("\t") for line in log.read_text().split("\n")[:-1]]
        log.unlink()
        is_over = len(told[-1]) == 1 or told[-1][0] == "0"
        trees = [one[1].split("|") for one in told if len(one) == 2]
        expected = trees[-1:] if is_over else trees[-2:]
        carried_out += sum(len(one) == 1 for one in told)
        async with program(store) as system:
            assert lines(system) in expected, f"seed {seed}"
            acks = Path(f"{log}.acks").read_text().split("\n")[:-1]
            known = {name: int(value) for name, value in map(str.split, acks)}  # The last of each.
            for path in recorded(system):
                name = path.rpartition("/")[2]
                assert await ref(system, path).ask(Add(0)) >= known.get(name, 0), f"seed {seed}: {path}"
    assert carried_out
