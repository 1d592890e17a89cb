"""What does it cost an ask that the runtime's own knowledge is evidence for diagnosis?

Baseline: the same system, asked in the same way, without diagnosis. Beside the actor that is asked there are a hundred
others; they are looked at each 100 ms, too.
Command: python benchmarks/bench_evidence.py [--quick]
"""

from __future__ import annotations

import asyncio

from harness import Run, ask_all, main
from workload import Ping, Responder

import holdfast as hf
from holdfast import diagnosis

PING = Ping()
OTHERS = 100
SETTLED = 1.0
"""Seconds after which the model is made and all observers look."""


async def _rate(run: Run, *, is_watched: bool) -> float:
    count = run.size(200_000)
    async with hf.ActorSystem("bench", log=False) as system:
        children = [hf.child(f"a{number}", hf.start(Responder)) for number in range(OTHERS)]
        await system.start(hf.supervisor("all", children=children))
        if is_watched:
            await diagnosis.watch(system, seconds=0.1)
            await asyncio.sleep(SETTLED)
        ref = system.ref("/bench/all/a0", Responder)
        return (await ask_all(ref.ask, PING, count, outstanding=100)).rate


async def ask_while_watched(run: Run) -> None:
    async def ours() -> float:
        return await _rate(run, is_watched=True)

    async def limit() -> float:
        return await _rate(run, is_watched=False)

    await run.compare("ask, 100 outstanding, while diagnosis looks", ours, limit, unit="1/s", target=0.97)


if __name__ == "__main__":
    main([ask_while_watched])
