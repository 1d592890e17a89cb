"""How long does a live actor stand still when it is moved between a task and a process, and is anything lost?

Several senders tell and ask without a break, each numbering its messages, while the actor is moved to and fro; in the
end it says what it has got from whom. `large`: how long the root's loop stands still while a large state changes its
place, for all others in the root.
Baseline: none; the figures are absolute.
Command: python benchmarks/bench_move.py [--quick]
"""

from __future__ import annotations

import asyncio
import tempfile
from typing import Any

import numpy as np
from harness import Run, main

import holdfast as hf

TELLERS, ASKERS = 3, 3
BURST = 5


class Note(hf.Message):
    """Told, in sequence."""

    sender: int
    n: int


class Count(hf.Message[int]):
    """Asked, in sequence."""

    sender: int
    n: int


class Sums(hf.Message[list[list[int]]]):
    """What came from each sender: the last number, how many, and how many were out of order."""


class Ledger(hf.Actor):
    """Keeps books of sequences."""

    def __init__(self) -> None:
        self.last = [0] * (TELLERS + ASKERS)
        self.count = [0] * (TELLERS + ASKERS)
        self.wrong = [0] * (TELLERS + ASKERS)

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self._take(message.sender, message.n)

    @hf.on(Count)
    def answer(self, message: Count) -> int:
        self._take(message.sender, message.n)
        return message.n

    def _take(self, sender: int, n: int) -> None:
        self.wrong[sender] += n <= self.last[sender]
        self.last[sender] = n
        self.count[sender] += 1

    @hf.on(Sums)
    def sums(self, message: Sums) -> list[list[int]]:
        return [list(one) for one in zip(self.last, self.count, self.wrong, strict=True)]


class Grid(hf.Actor):
    """A map of so many megabytes."""

    def __init__(self, megabytes: int) -> None:
        self.cells = np.arange(megabytes * 250_000, dtype=np.float32)


class Senders:
    """Send until they are told to stop."""

    def __init__(self, ref: hf.ActorRef[Ledger]) -> None:
        self._ref = ref
        self.is_over = False
        self.sent = [0] * (TELLERS + ASKERS)
        self.failed = 0
        self._tasks = [asyncio.create_task(self._tell(i)) for i in range(TELLERS)]
        self._tasks += [asyncio.create_task(self._ask(TELLERS + i)) for i in range(ASKERS)]

    async def _tell(self, sender: int) -> None:
        while not self.is_over:
            for _ in range(BURST):
                self.sent[sender] += 1
                self._ref.tell(Note(sender, self.sent[sender]))
            await asyncio.sleep(0.001)

    async def _ask(self, sender: int) -> None:
        while not self.is_over:
            self.sent[sender] += 1
            try:
                self.failed += await self._ref.ask(Count(sender, self.sent[sender]), 30.0) != self.sent[sender]
            except hf.HoldfastError:
                self.failed += 1

    async def over(self) -> None:
        self.is_over = True
        await asyncio.gather(*self._tasks)


async def _moves(run: Run, name: str, recovery: Any) -> None:
    count = run.size(1000)
    async with hf.ActorSystem("bench", log=False) as system:
        ref = await system.start(hf.child("ledger", hf.start(Ledger), recovery=recovery))
        senders = Senders(ref)
        pauses: list[float] = []
        with system.events() as stream:
            for number in range(count):
                await system.set_isolation(ref, "task" if number % 2 else "process", timeout=30.0)
                pauses += [event.pause_seconds for event in stream.take() if isinstance(event, hf.events.Moved)]
        await senders.over()
        sums = await ref.ask(Sums(), 30.0)
    lost = doubled = reordered = 0
    for sent, (_, got, wrong) in zip(senders.sent, sums, strict=True):
        lost, doubled, reordered = lost + max(0, sent - got), doubled + max(0, got - sent), reordered + wrong
    messages = sum(senders.sent)
    run.bound(f"{name}: moves not made, of {count}", count - len(pauses), unit="moves", target=0)
    for what, value in (
        ("lost", lost),
        ("doubled", doubled),
        ("out of order", reordered),
        ("asks failed", senders.failed),
    ):
        run.bound(f"{name}: {what}, of {messages:,} messages", value, unit="messages", target=0)
    pauses.sort()
    for what, at, target in (("p50", 0.5, 5.0), ("p99", 0.99, 20.0), ("longest", 1.0, 100.0)):
        pause = pauses[min(len(pauses) - 1, int(at * len(pauses)))] * 1e3
        run.bound(f"{name}: {what} pause of {count} moves under load", pause, unit="ms", target=target)


async def plain(run: Run) -> None:
    await _moves(run, "plain actor", None)


async def recorded(run: Run) -> None:
    await _moves(run, "recorded actor", hf.hybrid())


async def large(run: Run) -> None:
    """How long the root's loop runs nobody else while an actor with a large state changes its place."""
    for megabytes in (1, 5, 20, 80):
        for name in ("plain", "recorded", "stored"):
            gaps: dict[str, list[float]] = {}
            for _ in range(run.n):
                with tempfile.TemporaryDirectory() as folder:
                    store = f"sqlite:{folder}/bench.db" if name == "stored" else None
                    await _gaps(megabytes, None if name == "plain" else hf.hybrid(), store, gaps)
            for way, found in gaps.items():
                job = f"{name} actor of {megabytes} MB, {way}: longest gap of the root's loop, median of {len(found)}"
                run.bound(job, sorted(found)[len(found) // 2] * 1e3, unit="ms", target=20.0 + 30.0 * megabytes)


async def _gaps(megabytes: int, recovery: Any, store: str | None, gaps: dict[str, list[float]]) -> None:
    async with hf.ActorSystem("bench", store=store, log=False) as system:
        ref = await system.start(hf.child("grid", hf.start(Grid, megabytes), recovery=recovery))
        await system.start(hf.supervisor("far", isolation="process", children=[]))
        ways: dict[str, tuple[Any, ...]] = {
            "from a task to a process": ("isolation", "process"),
            "from a process to a task": ("isolation", "task"),
            "to a supervisor in a process": ("move", "/bench/far"),
            "back from there": ("move", "/bench"),
        }
        for way, (step, to) in ways.items():
            await asyncio.sleep(0.2)
            ticker = asyncio.create_task(_longest_gap())
            await asyncio.sleep(0.05)
            async with system.transaction(timeout=60.0) as change:
                getattr(change, step)(ref, to)
            await asyncio.sleep(0.05)
            ticker.cancel()
            gaps.setdefault(way, []).append(await ticker)


async def _longest_gap() -> float:
    """Until it is cancelled: the longest time beyond a millisecond between two ticks."""
    loop, longest = asyncio.get_running_loop(), 0.0
    try:
        while True:
            before = loop.time()
            await asyncio.sleep(0.001)
            longest = max(longest, loop.time() - before - 0.001)
    except asyncio.CancelledError:
        return longest


if __name__ == "__main__":
    main([plain, recorded, large])
