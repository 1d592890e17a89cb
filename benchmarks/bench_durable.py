"""What does it cost to have accepted messages outlive the root, or the machine?

Baselines: for fsync an append-only file with one write and one fdatasync for all that has come meanwhile
(`limits.GroupCommit`), both with 100 callers that wait for each acceptance; the others are absolute.
Command: python benchmarks/bench_durable.py [--quick]
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
from workload import Data, Echo, Told

import holdfast as hf

DATA = Data(b"x" * 100)
CALLERS = 100
CHILDREN = 1000


@contextlib.asynccontextmanager
async def running(
    folder: str, durability: Any, key: bytes | None = None
) -> AsyncGenerator[tuple[hf.ActorSystem, hf.ActorRef[Echo]], None]:
    store = f"sqlite:{folder}/{durability}{'' if key is None else '-encrypted'}.db"
    async with hf.ActorSystem("bench", store=store, store_key=key, durability=durability, log=False) as system:
        recovery = hf.hybrid(interval=1000.0)
        yield system, await system.start(hf.child("echo", hf.start(Echo), recovery=recovery))


async def os_level(run: Run) -> None:
    """Pipelined: a flood of tells, until the last one is written. Their turns come later, and are not counted."""
    count = run.size(50_000)
    with tempfile.TemporaryDirectory() as folder:
        async with running(folder, "os") as (system, echo):
            spent: list[float] = []
            for _ in range(run.n):
                await system.suspend(echo)
                began = time.perf_counter()
                for i in range(count):
                    echo.tell(DATA)
                    if not i % BURST:
                        await asyncio.sleep(0)
                await system._homes.settled()
                spent.append((time.perf_counter() - began) / count * 1e6)
                await system.resume(echo)
                await echo.ask(Told(), timeout=600.0)
            run.bound("an admission that outlives the root, pipelined", min(spent), unit="us", target=10.0)


async def fsync(run: Run) -> None:
    """Each waits until its message would outlive the machine."""
    count = run.size(20_000)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:  # /tmp may be in memory.
        commit = limits.GroupCommit(f"{folder}/limit")
        async with running(folder, "fsync") as (system, echo):

            async def ours() -> float:
                await system.suspend(echo)  # The limit handles nothing.
                accepted = await rate(lambda: echo.send(DATA), CALLERS, count)
                await system.resume(echo)
                await echo.ask(Told(), timeout=600.0)
                return accepted

            await run.compare(
                "admissions that outlive the machine, 100 callers",
                ours,
                lambda: rate(lambda: commit.append(DATA.data), CALLERS, count),
                unit="msg/s",
                target=0.8,
            )
        commit.close()


async def os_turns(run: Run) -> None:
    """The same flood, until the end of the last turn is written, too: what a recorded message costs in all."""
    count = run.size(20_000)
    with tempfile.TemporaryDirectory() as folder:
        async with running(folder, "os") as (system, echo):
            spent = [await _turns(system, echo, count) for _ in range(run.n)]
            run.bound("a whole turn that outlives the root, pipelined", min(spent), unit="us", target=25.0)


async def _turns(system: hf.ActorSystem, echo: hf.ActorRef[Echo], count: int) -> float:
    """Microseconds of a whole turn, in a flood of them."""
    began = time.perf_counter()
    for i in range(count):
        echo.tell(DATA)
        if not i % BURST:
            await asyncio.sleep(0)
    await echo.ask(Told(), timeout=600.0)
    await system._homes.settled()
    return (time.perf_counter() - began) / count * 1e6


async def encrypted_turns(run: Run) -> None:
    """The same turns in a store with a key, beside one without."""
    count = run.size(20_000)
    with tempfile.TemporaryDirectory() as folder:
        async with running(folder, "os") as plain, running(folder, "os", bytes(32)) as encrypted:
            await run.compare(
                "whole turns in an encrypted store, beside a plain one",
                lambda: _turns(*encrypted, count),
                lambda: _turns(*plain, count),
                unit="us",
                target=0.7,
            )


async def fsync_turns(run: Run) -> None:
    """Each caller asks and waits for the reply, which leaves when message and turn would outlive the machine."""
    count = run.size(10_000)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:  # /tmp may be in memory.
        commit = limits.GroupCommit(f"{folder}/limit")
        async with running(folder, "fsync") as (_, echo):

            async def twice() -> None:
                await commit.append(DATA.data)  # the message
                await commit.append(DATA.data)  # the end of its turn

            await run.compare(
                "whole asks that outlive the machine, 100 callers",
                lambda: rate(lambda: echo.ask(DATA, timeout=600.0), CALLERS, count),
                lambda: rate(twice, CALLERS, count),
                unit="msg/s",
                target=0.2,
            )
        commit.close()


async def restart(run: Run) -> None:
    """A tree of recorded tasks, each with a snapshot and ten messages since, comes back from its store."""
    children = run.size(CHILDREN)

    def tree() -> hf.ChildSpec:
        recovery = hf.hybrid(interval=1000.0)
        return hf.supervisor(
            "tree", children=[hf.child(f"c{n}", hf.start(Echo), recovery=recovery) for n in range(children)]
        )

    with tempfile.TemporaryDirectory() as folder:
        store, spent = f"sqlite:{folder}/tree.db", []
        for life in range(1 + run.n):
            began = time.perf_counter()
            async with hf.ActorSystem("bench", store=store, log=False) as system:
                await system.start(tree())
                if life:
                    spent.append(time.perf_counter() - began)
                refs = [system.ref(f"/bench/tree/c{n}", Echo) for n in range(children)]
                for ref in refs:
                    for _ in range(10):
                        ref.tell(DATA)
                counts = await asyncio.gather(*[ref.ask(Told(), timeout=60.0) for ref in refs])
                assert set(counts) == {10 * (life + 1)}
        run.bound(f"a tree of {children} recorded tasks back from SQLite", min(spent), unit="s", target=2.0)


if __name__ == "__main__":
    main([os_level, os_turns, encrypted_turns, fsync, fsync_turns, restart])
