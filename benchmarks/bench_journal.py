"""What does it cost the root to journal a message for a process actor?

Baseline: the same actor without recovery. Both are told the same flood; the CPU time of the root counts, the
recording of ended turns and the snapshots of those two seconds included.
Command: python benchmarks/bench_journal.py [--quick]
"""

from __future__ import annotations

import time

from harness import Run, main, tell_one
from workload import Data, Echo, Told, start_process

import holdfast as hf

DATA = Data(b"x" * 100)


async def memory(run: Run) -> None:
    count = run.size(50_000)
    async with hf.ActorSystem("bench") as system:
        journaled = await start_process(system, "journaled", hf.start(Echo), hf.hybrid(interval=2.0))
        bare = await start_process(system, "bare", hf.start(Echo))

        async def cost(ref: hf.ActorRef[Echo]) -> float:
            before = await ref.ask(Told())
            began = time.process_time()
            await tell_one(ref, DATA, count, burst=200)
            told = await ref.ask(Told(), timeout=60.0)
            used = time.process_time() - began
            assert told == before + count
            return used / count * 1e6

        await run.added(
            "journaling a message, in memory", lambda: cost(journaled), lambda: cost(bare), unit="us", target=5.0
        )


if __name__ == "__main__":
    main([memory])
