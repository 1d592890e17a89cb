"""How long does a snapshot of 100 MB hold up an actor's turns, and how much does it write?

The state is one numpy array. In a window of a second a snapshot is asked for, and meanwhile the actor is asked small
things without a break and once has all of its array, or a tenth of it, rewritten. Delay: the longest ask of the window.
Baseline: the same window without a snapshot; "added" is the longest of all rounds less the baseline's median.
Command: python benchmarks/bench_snapshot.py [--quick]
"""

from __future__ import annotations

import asyncio
import statistics
import time
from typing import Any

import numpy as np
from harness import Run, main

import holdfast as hf

BYTES = 100_000_000
WINDOW = 1.0


class Rewrite(hf.Message[int]):
    """Change the first `cells` cells."""

    cells: int


class Ping(hf.Message[int]):
    """Something small."""


class Grid(hf.Actor):
    """A large state."""

    def __init__(self, size: int) -> None:
        self.cells = np.zeros(size // 8)
        self.turns = 0

    @hf.on(Rewrite)
    def rewrite(self, message: Rewrite) -> int:
        self.cells[: message.cells] += 1.0
        self.turns += 1
        return self.turns

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        self.turns += 1
        return self.turns


async def _window(system: hf.ActorSystem, ref: hf.ActorRef[Grid], cells: int, *, is_saved: bool) -> float:
    """The longest ask, in milliseconds."""
    wish = asyncio.ensure_future(system.checkpoint(ref, timeout=60.0)) if is_saved else None
    longest, end, is_rewritten = 0.0, time.perf_counter() + WINDOW, False
    while time.perf_counter() < end or (wish is not None and not wish.done()):
        began = time.perf_counter()
        await ref.ask(Ping(), timeout=60.0)
        if not is_rewritten:
            is_rewritten = True
            await ref.ask(Rewrite(cells), timeout=60.0)
        longest = max(longest, time.perf_counter() - began)
        await asyncio.sleep(0.001)
    if wish is not None:
        await wish
        deadline = time.perf_counter() + WINDOW
        while time.perf_counter() < deadline:
            began = time.perf_counter()
            await ref.ask(Ping(), timeout=60.0)
            longest = max(longest, time.perf_counter() - began)
            await asyncio.sleep(0.001)
    return longest * 1e3


async def _measure(run: Run, isolation: Any, share: float, target: float) -> None:
    size = run.size(BYTES) if run.quick else BYTES
    cells = int(size // 8 * share)
    async with hf.ActorSystem("bench", log=False) as system:
        spec = hf.child("grid", hf.start(Grid, size), isolation=isolation, recovery=hf.hybrid(interval=3600.0))
        ref = await system.start(spec)
        await ref.ask(Rewrite(size // 8), timeout=60.0)
        await system.checkpoint(ref, timeout=60.0)
        plain: list[float] = []
        saved: list[float] = []
        with system.events() as stream:
            for _ in range(run.n):
                await ref.ask(Rewrite(cells), timeout=60.0)
                plain.append(await _window(system, ref, cells, is_saved=False))
                await ref.ask(Rewrite(cells), timeout=60.0)
                saved.append(await _window(system, ref, cells, is_saved=True))
            taken = [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)]
    what = f"{size // 1_000_000} MB in a {isolation}, {share:.0%} rewritten"
    run.bound(f"{what}: longest added delay", max(saved) - statistics.median(plain), unit="ms", target=target)
    run.bound(f"{what}: longest pause", max(one.pause for one in taken) * 1e3, unit="ms", target=target)
    written = max(one.written_bytes for one in taken)
    run.bound(f"{what}: written", written / size, unit="of the state", target=share + 0.01 + 1e6 / size)


async def task_all(run: Run) -> None:
    await _measure(run, "task", 1.0, 150.0)


async def task_tenth(run: Run) -> None:
    await _measure(run, "task", 0.1, 20.0)


async def process_all(run: Run) -> None:
    await _measure(run, "process", 1.0, 150.0)


async def process_tenth(run: Run) -> None:
    await _measure(run, "process", 0.1, 20.0)


if __name__ == "__main__":
    main([task_all, task_tenth, process_all, process_tenth])
