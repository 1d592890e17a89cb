"""Moves under load, and with processes killed on the way: nothing lost, nothing doubled, each sender's order kept."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.migration.here import FromHere, ToHere
from holdfast.actors.migration.move import Move
from holdfast.actors.migration.worker import FromOwnWorker, ToWorker
from holdfast.actors.process.worker_pool import Worker
from holdfast.checkpoint.places.recorded_moves import (
    FromRecordedHere,
    FromRecordedWorker,
    ToRecordedHere,
    ToRecordedWorker,
)
from tests.control.movers import Count, Ledger, Note, Seen, Slow

pytestmark = pytest.mark.pairs

OTHER: dict[str, Any] = {"task": "process", "process": "task"}
KINDS = {  # No message ends its process here: a move that meets a death tries again, and is struck again.
    "plain": None,
    "recorded": hf.hybrid(interval=0.05, max_deliveries=1_000),
}


class Load:
    """Senders that number what they send."""

    def __init__(self, ref: hf.ActorRef[Any], chance: random.Random, *, is_recorded: bool = True) -> None:
        self._ref, self._chance, self._is_recorded = ref, chance, is_recorded
        self._is_over = False
        self.sent: dict[str, int] = {}
        self._tasks = [asyncio.create_task(self._run(f"sender{i}", asks=i % 2 == 0)) for i in range(4)]

    async def _run(self, name: str, *, asks: bool) -> None:
        self.sent[name] = 0
        while not self._is_over:
            n = self.sent[name] = self.sent[name] + 1
            if asks:
                try:
                    assert await self._ref.ask(Count(name, n), 30.0) == n
                except hf.AskFailed:
                    assert not self._is_recorded
            else:
                self._ref.tell(Note(name, n))
            await asyncio.sleep(self._chance.choice((0.0, 0.0, 0.001)))

    async def over(self) -> dict[str, list[int]]:
        """Stop, and tell what should have been seen."""
        self._is_over = True
        await asyncio.gather(*self._tasks)
        return {name: list(range(1, n + 1)) for name, n in self.sent.items()}


@pytest.mark.parametrize("kind", [Ledger, Slow])
@pytest.mark.parametrize("name", list(KINDS))
async def test_moves_under_load_lose_nothing(system: hf.ActorSystem, name: str, kind: type[Ledger]) -> None:
    seed = random.randrange(2**32)
    print("seed", seed)
    one = await system.start(hf.child("one", hf.start(kind), recovery=KINDS[name]))
    load = Load(one, random.Random(seed))
    for number in range(16):
        await system.set_isolation(one, "task" if number % 2 else "process", timeout=30.0)
    expected = await load.over()
    assert await one.ask(Seen()) == expected


@pytest.mark.parametrize("here", ["task", "process"])
@pytest.mark.parametrize("step", ["prepare", "quiesce", "begin", "run"])
@pytest.mark.parametrize("name", list(KINDS))
async def test_a_process_killed_at_any_step_of_a_move_costs_nothing(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, here: Any, step: str, name: str
) -> None:
    """The old or the new one, at a seeded instant of each step: the actor lives in one place.

    A recorded one has handled all messages once. One without recovery may have lost what such a death costs it anyway:
    its state, and the messages that were begun; it has handled none twice, and it goes on.
    """
    seed = random.randrange(2**32)
    print("seed", seed)
    chance = random.Random(seed)
    one = await system.start(hf.child("one", hf.start(Ledger), recovery=KINDS[name], isolation=here))
    load = Load(one, chance, is_recorded=name == "recorded")
    for _ in range(4):
        place = "task" if system.pid_of(one) == os.getpid() else "process"
        struck = strike_at(monkeypatch, step, chance.choice((0, 1, 2, 3, 5, 8, 13)))
        try:
            await system.set_isolation(one, OTHER[place], timeout=10.0)
        except (hf.errors.CannotMove, hf.AskFailed) as error:
            print("not moved:", error)
        monkeypatch.undo()
        await asyncio.gather(*struck)
        await one.ask(Seen(), 30.0)  # It lives again.
    expected = await load.over()
    seen = await one.ask(Seen(), 30.0)
    if name == "recorded":
        assert seen == expected
    for numbers in seen.values():
        assert numbers == sorted(set(numbers))


def strike_at(monkeypatch: pytest.MonkeyPatch, step: str, ticks: int) -> list[asyncio.Task[None]]:
    """SIGKILL the process of a move some ticks of the loop after one of its steps has begun ("run": has ended)."""
    strikes: list[asyncio.Task[None]] = []

    async def strike(side: Any) -> None:
        for _ in range(ticks):
            await asyncio.sleep(0)
        move: Move = side if isinstance(side, Move) else side.move
        worker: Worker | None = getattr(move.leaving, "worker", None) or getattr(move.entering, "worker", None)
        if worker is not None and worker.is_alive():
            os.kill(worker.pid, signal.SIGKILL)

    def watched(plain: Callable[[Any], Awaitable[None]]) -> Callable[[Any], Awaitable[None]]:
        async def struck(side: Any) -> None:
            if step != "run":
                strikes.append(asyncio.create_task(strike(side)))
            await plain(side)
            if step == "run":
                strikes.append(asyncio.create_task(strike(side)))

        return struck

    leaving = (FromHere, FromOwnWorker, FromRecordedHere, FromRecordedWorker)
    for kind in (Move, *leaving, ToHere, ToWorker, ToRecordedHere, ToRecordedWorker):
        if step in vars(kind):
            monkeypatch.setattr(kind, step, watched(vars(kind)[step]))
    return strikes
