"""What does a restart cost in one process, and what do messages and restarts cost in a crowd?

Nobody looks at the reports: the log is off, as writing a line costs more than a restart.
Baseline: a task that keeps the error and builds a new object and a new task (`limits.Restarted`); for growth, the
library itself among 10 actors.
Command: python benchmarks/bench_restart.py [--quick]
"""

from __future__ import annotations

import asyncio
import itertools
import random
import time

import limits
from harness import BURST, Gate, Run, main
from workload import Boom, Counter, Fragile, Ping, Tick

import holdfast as hf

BOOM = Boom()
PING = Ping()
TICK = Tick()


def _family(size: int) -> hf.ChildSpec:
    """A supervisor that never gives up, with a window so short that it remembers hardly any restart."""
    return hf.supervisor(
        "family",
        strategy="one_for_one",
        intensity=1_000_000,
        period=1e-6,
        children=[hf.child(f"child{i}", hf.start(Fragile)) for i in range(size)],
    )


async def restart(run: Run) -> None:
    count = run.size(20_000)
    async with hf.ActorSystem("bench", log=False) as system:
        await system.start(_family(1))
        ref = system.ref("/bench/family/child0", Fragile)
        restarted = limits.Restarted()

        async def ours() -> float:
            handled = 0
            began = time.perf_counter()
            for _ in range(count):
                ref.tell(BOOM)
                handled = await ref.ask(PING)
            elapsed = time.perf_counter() - began
            assert handled == 1
            return elapsed / count * 1e6

        async def limit() -> float:
            began = time.perf_counter()
            for _ in range(count):
                restarted.tell(limits.Boom)
                await restarted.ask(PING)
            return (time.perf_counter() - began) / count * 1e6

        await run.compare("a crash told, until the next life answers", ours, limit, unit="us", target=0.4)
        restarted.task.cancel()


async def message_growth(run: Run) -> None:
    crowd, count = run.size(100_000), run.size(200_000)

    async def cost(size: int) -> float:
        """Microseconds for each of `count` messages in turns over `size` actors, each idle when its message comes."""
        async with hf.ActorSystem("bench", log=False) as system:
            gate = Gate(size)
            refs = [system.spawn(hf.start(Counter, gate, 1 + count // size)) for _ in range(size)]
            for ref in refs:  # The first message makes the queue, the first turn the context.
                ref.tell(TICK)
            await system._node.settled()
            around, length = itertools.cycle(refs), min(size, BURST)
            bursts = [list(itertools.islice(around, length)) for _ in range(count // length)]
            began = time.perf_counter()
            for burst in bursts:
                for ref in burst:
                    ref.tell(TICK)
                await asyncio.sleep(0)
            await gate.done
            return (time.perf_counter() - began) / count * 1e6

    job = f"a message among {crowd:,} actors, beside 10"
    await run.compare(job, lambda: cost(crowd), lambda: cost(10), unit="us", target=0.5)


async def restart_growth(run: Run) -> None:
    crowd, count = run.size(10_000), run.size(5_000)

    async def cost(size: int) -> float:
        """Microseconds for each restart of one of `size` siblings, taken at random."""
        chance = random.Random(run.seed)
        async with hf.ActorSystem("bench", log=False) as system:
            await system.start(_family(size))
            refs = [system.ref(f"/bench/family/child{i}", Fragile) for i in range(size)]
            victims = chance.choices(refs, k=count)
            began = time.perf_counter()
            for ref in victims:
                ref.tell(BOOM)
                await ref.ask(PING)
            return (time.perf_counter() - began) / count * 1e6

    job = f"a restart among {crowd:,} siblings, beside 10"
    await run.compare(job, lambda: cost(crowd), lambda: cost(10), unit="us", target=0.5)


if __name__ == "__main__":
    main([restart, message_growth, restart_growth])
