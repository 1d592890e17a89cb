"""What does a recorded turn cost, all of it: message, handler, reply, and the two records of them?

Baseline: a hand-written loop on SQLite (`limits.SqliteLoop`): it takes what has come in this tick, runs the handlers,
puts one row for each into a table, commits once, and answers. It remembers as much, and can do nothing else.
Command: python benchmarks/bench_turns.py [--quick]
"""

from __future__ import annotations

import asyncio
import contextlib
import tempfile
import time
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import limits
from harness import BURST, Run, main, rate
from workload import Data, Echo, EchoData, Told

import holdfast as hf

BODY = b"x" * 100
ASKED, TOLD = EchoData(BODY), Data(BODY)
CALLERS = 100


@contextlib.asynccontextmanager
async def running(folder: str, durability: Any) -> AsyncGenerator[hf.ActorRef[Echo]]:
    store = None if durability == "memory" else f"sqlite:{folder}/{durability}.db"
    async with hf.ActorSystem("bench", store=store, durability=durability, log=False) as system:
        yield await system.start(hf.child("echo", hf.start(Echo), recovery=hf.hybrid(interval=1.0)))


async def _asks(run: Run, durability: Any, callers: int, count: int, target: float) -> None:
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:  # /tmp may be in memory.
        limit = limits.SqliteLoop(f"{folder}/limit.db", is_synced=durability == "fsync")
        async with running(folder, durability) as echo:
            await run.compare(
                f"recorded ask, {durability}, {callers} outstanding",
                lambda: rate(lambda: echo.ask(ASKED, timeout=600.0), callers, count),
                lambda: rate(lambda: limit.ask(BODY), callers, count),
                unit="turns/s",
                target=target,
            )
        limit.close()


async def asks(run: Run) -> None:
    for durability, size in (("os", 20_000), ("fsync", 5_000)):
        await _asks(run, durability, 1, run.size(size), 0.5)
        await _asks(run, durability, CALLERS, run.size(2 * size), 0.35)


async def _tell(echo: hf.ActorRef[Echo], count: int) -> float:
    """Processor time of a tell and its turn, in us, until its end is written."""
    began = time.process_time()
    for i in range(count):
        echo.tell(TOLD)
        if not i % BURST:
            await asyncio.sleep(0)
    await echo.ask(Told(), timeout=600.0)
    return (time.process_time() - began) / count * 1e6


async def tells(run: Run) -> None:
    """Processor time of whole turns in the root."""
    count = run.size(50_000)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        for durability, target in (("memory", 3.0), ("os", 8.0)):
            async with running(folder, durability) as echo:
                spent = [await _tell(echo, count) for _ in range(run.n)]
                run.bound(f"recorded tell, {durability}, processor time", min(spent), unit="us", target=target)
        limit = limits.SqliteLoop(f"{folder}/limit.db", is_synced=True)

        async def theirs() -> float:
            began = time.process_time()
            for i in range(count):
                limit.tell(BODY)
                if not i % BURST:
                    await asyncio.sleep(0)
            await limit.ask(BODY)
            return (time.process_time() - began) / count * 1e6

        async with running(folder, "fsync") as echo:
            await run.compare(
                "recorded tell, fsync, processor time", lambda: _tell(echo, count), theirs, unit="us", target=0.5
            )
        limit.close()


def _written() -> int:
    """Bytes that this process has handed to the kernel in writes."""
    io = Path("/proc/self/io").read_text()
    return int(io.split("wchar:")[1].split()[0])


async def written(run: Run) -> None:
    """Bytes written for each recorded turn, snapshots included, beside three times its payload and 100."""
    count = run.size(20_000)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        for durability in ("os", "fsync"):
            async with running(folder, durability) as echo:
                await echo.ask(ASKED)
                began = _written()
                await rate(lambda: echo.ask(ASKED, timeout=600.0), CALLERS, count)  # it is awaited here
                each = (_written() - began) / count
                run.bound(f"bytes written per turn, {durability}", each, unit="bytes", target=3 * len(BODY) + 100)


if __name__ == "__main__":
    main([asks, tells, written])
