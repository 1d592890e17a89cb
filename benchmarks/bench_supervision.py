"""What does supervision cost in a crowd: its start, the restart of a whole group, an answer in the worst hour?

Baseline: actors that are spawned without a supervisor; for growth, the library itself with a tenth of the children.
Command: python benchmarks/bench_supervision.py [--quick]
"""

from __future__ import annotations

import asyncio
import statistics
import time

from harness import Run, main
from workload import Boom, Doomed, Fragile, Idle, Ping

import holdfast as hf
from holdfast.supervision.admin import CountChildren
from holdfast.supervision.spec import Strategy

BOOM = Boom()
PING = Ping()
OUTSTANDING = 10  # admin calls of one sender on the way
EVERY = 0.005  # seconds between two bursts of admin calls


def _family(size: int, kind: type[hf.Actor], strategy: Strategy = "one_for_one") -> hf.ChildSpec:
    """A supervisor that never gives up, with a window so short that it remembers hardly any restart."""
    children = [hf.child(f"child{i}", hf.start(kind)) for i in range(size)]
    return hf.supervisor("family", strategy=strategy, intensity=1_000_000, period=1e-6, children=children)


async def group_restart(run: Run) -> None:
    crowd = run.size(10_000)
    few = crowd // 10

    async def cost(size: int) -> float:
        """Microseconds for each child that is stopped and started again because the first one crashes."""
        rounds = 3 * max(1, crowd // size)
        async with hf.ActorSystem("bench", log=False) as system:
            await system.start(_family(size, Fragile, "one_for_all"))
            first = system.ref("/bench/family/child0", Fragile)
            last = system.ref(f"/bench/family/child{size - 1}", Fragile)
            await last.ask(PING)
            began = time.perf_counter()
            for life in range(2, rounds + 2):
                first.tell(BOOM)
                await first.ask(PING, timeout=60.0)
                await last.ask(PING, timeout=60.0)  # Children start in order: it is the last one up.
                assert last._cell.life == life
            return (time.perf_counter() - began) / rounds / size * 1e6

    job = f"one_for_all restart of {crowd:,} children, each, beside {few:,}"
    await run.compare(job, lambda: cost(crowd), lambda: cost(few), unit="us", target=0.5)


async def start_crowd(run: Run) -> None:
    count = run.size(10_000)

    async def ours() -> float:
        family = _family(count, Idle)
        async with hf.ActorSystem("bench", log=False) as system:
            began = time.perf_counter()
            await system.start(family)
            return (time.perf_counter() - began) * 1e3

    async def limit() -> float:
        async with hf.ActorSystem("bench", log=False) as system:
            began = time.perf_counter()
            for i in range(count):
                system.spawn(hf.start(Idle), f"child{i}")
            await system._node.settled()
            return (time.perf_counter() - began) * 1e3

    await run.compare(f"start of {count:,} children, beside spawning them", ours, limit, unit="ms", target=1 / 3)


async def admin_under_crashes(run: Run) -> None:
    crowd, seconds = run.size(1_000), 2.0 if run.quick else 10.0
    children = [hf.child(f"child{i}", hf.start(Doomed), backoff=hf.Backoff()) for i in range(crowd)]
    family = hf.supervisor("family", strategy="one_for_one", intensity=10**9, period=1.0, children=children)
    async with hf.ActorSystem("bench", log=False) as system:
        supervisor = await system.start(family)
        seen: list[float] = []
        answered: list[int] = []

        async def call(number: int) -> None:
            asked = time.perf_counter()
            counts = await supervisor.ask(CountChildren())
            assert counts.specs == crowd
            seen.append(time.perf_counter() - asked)
            answered.append(number)

        end = time.perf_counter() + seconds
        numbers = 0
        while time.perf_counter() < end:
            await asyncio.gather(*[call(numbers + i) for i in range(OUTSTANDING)])
            numbers += OUTSTANDING
            await asyncio.sleep(EVERY)
        cells = supervisor._cell.children or {}
        restarts = sum(cell.life - 1 for cell in cells.values())
        assert restarts > crowd, restarts
        assert answered == sorted(answered), "admin calls were answered out of order"
        p99 = statistics.quantiles(seen, n=100)[98] * 1e3
        print(f"# {len(seen):,} calls, {restarts:,} restarts, median {statistics.median(seen) * 1e3:.2f} ms")
        run.bound(f"an admin call while {crowd:,} children crash-loop, p99", p99, unit="ms", target=20.0)


if __name__ == "__main__":
    main([group_restart, start_crowd, admin_under_crashes])
