"""What does an actor cost that does nothing: to start and stop, in memory, in CPU; and what does the import cost?

Baseline: a deque and a task that sleeps on a future (`limits.Resident`); the others are absolute figures.
Command: python benchmarks/bench_spawn.py [--quick]
"""

from __future__ import annotations

import asyncio
import gc
import os
import statistics
import subprocess
import sys
import tempfile
import time

import limits
import psutil
from harness import Run, main, resident_bytes
from workload import Idle, Ping

import holdfast as hf

BRANCHES = 100
IMPORT = "from time import perf_counter as now; began = now(); import holdfast; print((now() - began) * 1e3)"


async def spawn_and_stop(run: Run) -> None:
    count = run.size(100_000)
    async with hf.ActorSystem("bench") as system:

        async def ours() -> float:
            began = time.perf_counter()
            refs = [system.spawn(hf.start(Idle)) for _ in range(count)]
            await asyncio.sleep(0)
            for ref in refs:
                ref.stop()
            await system.stop(refs[-1])
            elapsed = time.perf_counter() - began
            for ref in refs[:: count // 10]:
                await _assert_stopped(ref)
            return count / elapsed

        async def limit() -> float:
            began = time.perf_counter()
            residents = [limits.Resident() for _ in range(count)]
            await asyncio.sleep(0)
            for resident in residents:
                resident.task.cancel()
            await asyncio.gather(*[resident.task for resident in residents], return_exceptions=True)
            return count / (time.perf_counter() - began)

        await run.compare(f"spawn and stop {count:,} actors", ours, limit, unit="1/s", target=2.0)


async def _assert_stopped(ref: hf.ActorRef[Idle]) -> None:
    try:
        await ref.ask(Ping())
    except hf.ActorStopped:
        return
    raise AssertionError(f"{ref} has not stopped")


async def idle_bytes(run: Run) -> None:
    beside_state = run.fresh("actors") - run.fresh("states")
    run.bound("memory of an idle actor beside its state", beside_state, unit="bytes", target=700)


async def actors(run: Run) -> float:
    """Bytes of an idle actor, its state included."""
    count = run.size(100_000)
    async with hf.ActorSystem("bench") as system:
        for _ in range(100):
            system.spawn(hf.start(Idle))
        await asyncio.sleep(0.1)
        gc.collect()
        before = resident_bytes()
        for _ in range(count):
            system.spawn(hf.start(Idle))
        await asyncio.sleep(0.1)
        gc.collect()
        return (resident_bytes() - before) / count


async def idle_recorded_bytes(run: Run) -> None:
    run.bound("memory of an idle recorded actor", run.fresh("recorded"), unit="bytes", target=16_384)


async def recorded(run: Run) -> float:
    """Bytes of an idle actor with recovery and a store, which has answered once, with its state."""
    count = run.size(20_000)
    template = hf.child(None, hf.start(Idle), restart="transient", recovery=hf.hybrid(interval=3600.0))
    with tempfile.TemporaryDirectory() as folder:
        async with hf.ActorSystem("bench", store=f"sqlite:{folder}/bench.db", log=False) as system:
            top = await system.start(hf.dynamic("sessions", template=template, journal=True))

            async def begin(first: int, last: int) -> None:
                for low in range(first, last, 200):
                    asked = (top.ask(hf.StartChild(id=f"{i:032x}"), 60.0) for i in range(low, min(low + 200, last)))
                    await asyncio.gather(*(ref.ask(Ping()) for ref in await asyncio.gather(*asked) if ref is not None))
                await asyncio.sleep(0.1)
                gc.collect()

            await begin(0, 100)
            before = resident_bytes()
            await begin(100, 100 + count)
            return (resident_bytes() - before) / count


class State:
    """What the user of an `Idle` would keep without actors."""

    def __init__(self) -> None:
        self.balance = 0


async def states(run: Run) -> float:
    """Bytes of such a state."""
    count = run.size(100_000)
    kept: list[State | None] = [None] * count
    gc.collect()
    before = resident_bytes()
    for i in range(count):
        kept[i] = State()
    gc.collect()
    return (resident_bytes() - before) / count


async def million(run: Run) -> None:
    count = run.size(1_000_000)
    run.bound(f"peak memory of a process with {count:,} idle actors", run.fresh("crowd"), unit="GB", target=1.2)


async def crowd(run: Run) -> float:
    """Peak memory of this process, in GB, once the first and the last of so many actors have answered."""
    count = run.size(1_000_000)
    async with hf.ActorSystem("bench") as system:
        first = last = system.spawn(hf.start(Idle))
        for _ in range(count - 1):
            last = system.spawn(hf.start(Idle))
        await first.ask(Ping())
        await last.ask(Ping())
        peak = resident_bytes("VmHWM") / 1e9
        sys.stdout.write(f"{peak}\n")
        sys.stdout.flush()
        os._exit(0)  # Stopping a million actors is not the question.


async def idle_cpu(run: Run) -> None:
    count, seconds = run.size(10_000), 2.0 if run.quick else 10.0
    branches = [
        hf.supervisor(f"branch{b}", children=[hf.child(f"leaf{i}", hf.start(Idle)) for i in range(count // BRANCHES)])
        for b in range(BRANCHES)
    ]
    async with hf.ActorSystem("bench") as system:
        await system.start(hf.supervisor("tree", children=branches))
        await asyncio.sleep(1.0)
        before = _cpu_seconds()
        await asyncio.sleep(seconds)
        used = _cpu_seconds() - before
    run.bound(f"CPU of an idle tree of {count:,}", used / seconds * 100, unit="%", target=0.5)


def _cpu_seconds() -> float:
    """CPU time of this process and of all below it."""
    me = psutil.Process()
    times = [process.cpu_times() for process in (me, *me.children(recursive=True))]
    return sum(one.user + one.system for one in times[1:]) + time.process_time()


async def import_time(run: Run) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-c", IMPORT]

    def once() -> float:
        return float(subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout)

    once()  # compiles
    median = statistics.median(once() for _ in range(run.size(20)))
    run.bound("import holdfast", median, unit="ms", target=120)


if __name__ == "__main__":
    main(
        [spawn_and_stop, idle_bytes, idle_recorded_bytes, million, idle_cpu, import_time],
        {"actors": actors, "states": states, "recorded": recorded, "crowd": crowd},
    )
