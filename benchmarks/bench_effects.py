"""What does an effect cost beyond its function, and a turn that waits?

Baselines: an effect beside a turn that awaits the same function itself and sends one message to another recorded actor
(`added`: one append more, where the store is durable); the waiting turns are absolute.
Command: python benchmarks/bench_effects.py [--quick]
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import tempfile
import time
from collections.abc import AsyncGenerator
from typing import Any

import psutil
from harness import Run, main

import holdfast as hf

RECOVERY = hf.hybrid(interval=1000.0)
AT_ONCE = 100


class Plain(hf.Message[int]):
    """Await the function `n` times."""

    n: int


class Effects(hf.Message[int]):
    """Have `n` effects of the function."""

    n: int


class Wait(hf.Message): ...


class Go(hf.Message): ...


class Waiting(hf.Message[int]): ...


async def nothing() -> int:
    return 1


class Worker(hf.Actor):
    @hf.on(Plain)
    async def plain(self, message: Plain) -> int:
        return sum([await nothing() for _ in range(message.n)])

    @hf.on(Effects)
    async def effects(self, message: Effects) -> int:
        return sum([await self.ctx.effect(nothing) for _ in range(message.n)])


class Flow(hf.Actor):
    @hf.on(Wait)
    async def wait(self, message: Wait) -> None:
        await self.ctx.wait_for(Go)

    @hf.on(Go)
    def go(self, message: Go) -> None: ...


async def _spent(durability: str | None, count: int) -> tuple[float, float]:
    """Microseconds for each call of the function by itself, and as an effect."""
    with tempfile.TemporaryDirectory() as folder:
        options: dict[str, Any] = {"store": f"sqlite:{folder}/app.db", "durability": durability} if durability else {}
        async with hf.ActorSystem("bench", log=False, **options) as system:
            ref = await system.start(hf.child("worker", hf.start(Worker), recovery=RECOVERY))
            spent: list[float] = []
            for message in (Plain(count), Effects(count)):
                began = time.perf_counter()
                await ref.ask(message, timeout=600.0)
                spent.append((time.perf_counter() - began) / count * 1e6)
            return spent[0], spent[1]


async def effect(run: Run) -> None:
    """In the root process, one after another in a turn."""
    for name, durability in (("memory", None), ("os", "os")):
        added = [after - before for before, after in [await _spent(durability, run.size(5000)) for _ in range(run.n)]]
        run.bound(f"an effect beyond its function, {name}", min(added), unit="us", target=30.0)


def flows(count: int) -> list[hf.ChildSpec[Any]]:
    return [hf.child(f"f{number}", hf.start(Flow), recovery=RECOVERY, shutdown=0.0) for number in range(count)]


async def _all_wait(system: hf.ActorSystem, first: int, end: int) -> None:
    """Until the homes of these know that their turns wait."""
    switches = system._homes._switches
    while not all(switches[f"/bench/flows/f{number}"].calls.rests.is_busy for number in range(first, end)):
        await asyncio.sleep(0.001)


async def waiting(run: Run) -> None:
    """Workflows that wait for a signal: memory of each beside an idle actor, and how soon all wait again.

    They begin a hundred at a time. Were it all at once, what so many messages take on their way would count, too: the
    allocator gives little of it back.
    """
    count = run.size(10_000)
    with tempfile.TemporaryDirectory() as folder:
        async with flowing(folder, count) as system:
            await system._homes.settled()
            gc.collect()
            process = psutil.Process()
            before = process.memory_info().rss
            for first in range(0, count, AT_ONCE):
                await _begin(system, first, min(first + AT_ONCE, count))
            gc.collect()
            run.bound("a waiting turn", (process.memory_info().rss - before) / count, unit="bytes", target=4096.0)
        began = time.perf_counter()
        async with flowing(folder, count) as system:
            await _all_wait(system, 0, count)
            seconds = (time.perf_counter() - began) * 10_000 / count
            run.bound("10,000 waiting turns wait again after a restart of the root", seconds, unit="s", target=3.0)


@contextlib.asynccontextmanager
async def flowing(folder: str, count: int) -> AsyncGenerator[hf.ActorSystem, None]:
    async with hf.ActorSystem("bench", store=f"sqlite:{folder}/app.db", durability="os", log=False) as system:
        await system.start(hf.supervisor("flows", children=flows(count)))
        yield system


async def _begin(system: hf.ActorSystem, first: int, end: int) -> None:
    for number in range(first, end):
        system.ref(f"/bench/flows/f{number}", Flow).tell(Wait())
    await _all_wait(system, first, end)
    await system._homes.settled()


if __name__ == "__main__":
    main([effect, waiting])
