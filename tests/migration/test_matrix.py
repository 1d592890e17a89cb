"""Every actor, wherever it lives, taken to every other place: the table in docs/moves.md, cell by cell.

No cell refuses.
`HOLDFAST_MATRIX=n` runs the walks with faults n times as often.
"""

from __future__ import annotations

import asyncio
import os
import random
import re
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.migration.move import Move
from tests.migration.travellers import BELOW, KINDS, OWN_BELOW, Luggage, Stream, Traveller, path, take, tree

TEXT = (Path(__file__).parents[2] / "docs" / "moves.md").read_text("utf-8")
TIMES = int(os.environ.get("HOLDFAST_MATRIX", "1"))


def cells() -> list[Any]:
    """(place, kind, step) of each cell that is a change."""
    found = re.search(r"^\| it lives in \|.*\n\|[-|]+\|\n(?:\|.*\n)+", TEXT, re.M)
    assert found, "the table of moves"
    head, _, *rows = ([text.strip().strip("`") for text in row.strip("|").split("|")] for row in found[0].splitlines())
    return [
        pytest.param(row[0], kind, step, id=f"{row[0]}-{kind}-{step}")
        for row in rows
        for step, cell in zip(head[1:], row[1:], strict=True)
        for kind in KINDS
        if cell != "–"
    ]


def test_the_table_refuses_nothing() -> None:
    rows = re.findall(r"^\| (?:a task|a process|replicas).*$", TEXT, re.M)
    assert len(rows) == 6
    assert not [row for row in rows if re.search(r"\| no\b", row)]


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        await running.start(hf.supervisor("there", intensity=1000))
        yield running


@pytest.mark.pairs
@pytest.mark.parametrize(("place", "kind", "step"), cells())
async def test_an_actor_is_taken_there_with_all_it_has(
    system: hf.ActorSystem, place: str, kind: str, step: str
) -> None:
    """Under a stream of asks and tells, with a stash, a timer, a link, a bounded mailbox and a reply that it owes."""
    await system.start(tree(place, kind))
    ref = system.ref(path(place), Traveller)
    luggage, stream = Luggage(system, ref), Stream(ref)
    await luggage.pack()
    await stream.reached(20)
    await take(system, ref, step)
    await stream.reached(20)
    await stream.stop()
    seen = await luggage.unpack()
    stream.judge(seen["added"])


class Walk:
    """Random steps through the table, some of them with a fault; what was refused is tried again at once."""

    def __init__(self, system: hf.ActorSystem, kind: str, place: str, draw: random.Random, faults: Faults) -> None:
        self._system, self._kind, self.place, self._draw, self._faults = system, kind, place, draw, faults
        self._home = place if place != "replicas" else "a task"
        self._is_far = place in (BELOW, OWN_BELOW)  # its first supervisor lives in another process
        self.ref: hf.ActorRef[Any] = system.ref(path(place), Traveller)
        self.steps: list[str] = []

    async def go(self, count: int, stream: Stream) -> None:
        for _ in range(count):
            await self._step(stream)
            await stream.reached(5)

    async def _step(self, stream: Stream) -> None:
        options = [
            step for place, kind, step in (cell.values for cell in cells()) if (place, kind) == (self.place, self._kind)
        ]
        step = self._draw.choice(options)
        fault = self._draw.choice(("none", "given up", "killed"))
        self.steps.append(f"{step} ({fault})")
        if fault == "given up":
            self._faults.give_up = True
        taking = asyncio.ensure_future(take(self._system, self.ref, step))
        if fault == "killed" and self._kind == "recorded" and self.place in ("a process", OWN_BELOW):
            await self._at_some_instant()
            self._kill()
        elif fault == "killed" and self.place == "replicas" and step == "move":
            await self._at_some_instant()
            self._kill_replica()
        try:
            await taking
        except (hf.errors.CannotMove, hf.TransactionFailed):
            assert fault != "none"
            await take(self._system, self.ref, step)
        self._faults.give_up = False
        task, process = (BELOW, OWN_BELOW) if self._is_below else ("a task", "a process")
        places = {"task": task, "process": process, "protect": "replicas", "unprotect": self._home}
        if step in ("task", "process"):
            self._home = places[step]  # Also of one that is protected: it lives there behind its mechanism.
        if step == "move" and self._is_far:  # Its other supervisor is in the root's process.
            other = {BELOW: "a task", OWN_BELOW: "a process", "a task": BELOW, "a process": OWN_BELOW}
            self._home = other[self._home]
            if self.place != "replicas":
                self.place = self._home
        if step != "move" and (self.place != "replicas" or step == "unprotect"):
            self.place = places[step]

    @property
    def _is_below(self) -> bool:
        return self._home in (BELOW, OWN_BELOW)

    async def _at_some_instant(self) -> None:
        for _ in range(self._draw.randrange(40)):
            await asyncio.sleep(0)

    def _kill_replica(self) -> None:
        """End one of the two, if the other one could go on alone."""
        place: Any = self.ref._cell.host.place
        replicas = place.group.replicas
        if replicas.whole_since()[0]:
            worker = replicas.worker_of(self._draw.choice(sorted(replicas.membership.names)))
            os.kill(worker.pid, signal.SIGKILL)

    def _kill(self) -> None:
        try:
            pid = self._system.pid_of(self.ref)
        except hf.errors.NoSuchActor:
            return  # It lives nowhere just now.
        if pid != os.getpid():
            os.kill(pid, signal.SIGKILL)


class Faults:
    """Ends an attempt at the instant at which the old life is at rest."""

    def __init__(self) -> None:
        self.give_up = False

    def at_rest(self, move: Move) -> None:
        if self.give_up:
            self.give_up = False
            move.give_up("the time is over")


@pytest.fixture
def faults(monkeypatch: pytest.MonkeyPatch) -> Faults:
    faults, at_rest = Faults(), Move.at_rest

    def struck(move: Move) -> None:
        at_rest(move)
        faults.at_rest(move)

    monkeypatch.setattr(Move, "at_rest", struck)
    return faults


@pytest.mark.parametrize("seed", range(6 * TIMES))
async def test_random_walks_lose_double_and_reorder_nothing(system: hf.ActorSystem, faults: Faults, seed: int) -> None:
    draw = random.Random(seed)
    kind, place = draw.choice(list(KINDS)), draw.choice(["a task", "a process", "replicas", BELOW, OWN_BELOW])
    await system.start(tree(place, kind))
    walk = Walk(system, kind, place, draw, faults)
    luggage, stream = Luggage(system, walk.ref), Stream(walk.ref)
    print(f"seed {seed}: {kind}, from {place}")
    await luggage.pack()
    try:
        await walk.go(5, stream)
    finally:
        print(f"seed {seed}: {' '.join(walk.steps)}")
    await stream.stop()
    seen = await luggage.unpack()
    stream.judge(seen["added"])
