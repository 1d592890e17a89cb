"""What does the history cost in a storm of restarts, and in the start of a crowd?

Baseline: the same with `history=False`. Nobody looks at the events, and the log is off: nothing hides the cost. A storm
lasts some seconds, as real ones do; of its first moments all events are recorded, later a hundred each second.
Times are those of the processor, so that others on the machine count less.
Command: python benchmarks/bench_history.py [--quick]
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from harness import Run, main
from workload import Boom, Fragile, Idle, Ping

import holdfast as hf

BOOM = Boom()
PING = Ping()


def _family(size: int, kind: type[hf.Actor]) -> hf.ChildSpec:
    """A supervisor that never gives up, with a window so short that it remembers hardly any restart."""
    children = [hf.child(f"child{i}", hf.start(kind)) for i in range(size)]
    return hf.supervisor("family", strategy="one_for_one", intensity=10**9, period=1e-6, children=children)


async def _storm(count: int, *, history: bool, store: str | None = None) -> float:
    """Microseconds of the processor for each crash and the start of the next life, while one follows the other."""
    async with hf.ActorSystem("bench", log=False, history=history, store=store) as system:
        await system.start(_family(1, Fragile))
        ref = system.ref("/bench/family/child0", Fragile)
        began = time.process_time()
        for _ in range(count):
            ref.tell(BOOM)
            await ref.ask(PING)
        return (time.process_time() - began) / count * 1e6


async def storm_in_memory(run: Run) -> None:
    count = run.size(200_000)

    async def ours() -> float:
        return await _storm(count, history=True)

    async def limit() -> float:
        return await _storm(count, history=False)

    await run.compare(f"each of {count:,} restarts in a storm", ours, limit, unit="us", target=0.98)


async def storm_with_store(run: Run) -> None:
    count = run.size(200_000)

    async def measured(*, history: bool) -> float:
        with tempfile.TemporaryDirectory() as folder:
            return await _storm(count, history=history, store=f"sqlite:{Path(folder) / 'bench.db'}")

    async def ours() -> float:
        return await measured(history=True)

    async def limit() -> float:
        return await measured(history=False)

    await run.compare(f"each of {count:,} restarts in a storm, with a store", ours, limit, unit="us", target=0.98)


async def start_crowd(run: Run) -> None:
    count = run.size(10_000)

    async def measured(*, history: bool) -> float:
        family = _family(count, Idle)
        async with hf.ActorSystem("bench", log=False, history=history) as system:
            began = time.process_time()
            await system.start(family)
            return (time.process_time() - began) * 1e3

    async def ours() -> float:
        return await measured(history=True)

    async def limit() -> float:
        return await measured(history=False)

    await run.compare(f"start of {count:,} children", ours, limit, unit="ms", target=0.9)


if __name__ == "__main__":
    main([storm_in_memory, storm_with_store, start_crowd])
