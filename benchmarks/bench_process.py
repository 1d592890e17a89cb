"""What does it cost that an actor has an OS process of its own: its messages, its start, its recovery?

Baseline: msgpack frames over a Unix socket between two processes, writes coalesced (`limits.Client`); a bare fork
server (`limits.ForkServer`).
Command: python benchmarks/bench_process.py [--quick]
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import os
import signal
import statistics
import time
from collections.abc import AsyncGenerator

import limits
from harness import Run, ask_all, compare_asks, main, tell_one
from workload import Data, Drive, Driver, Echo, EchoData, Told, start_process

import holdfast as hf

BYTES = b"x" * 100
DATA = Data(BYTES)
ECHO = EchoData(BYTES)
BURST = 200
MEBIBYTE = 1 << 20
TUNED_MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": str(64 * MEBIBYTE),
    "MALLOC_TRIM_THRESHOLD_": str(128 * MEBIBYTE),
    "MALLOC_TOP_PAD_": str(16 * MEBIBYTE),
}
PAUSE = 0.03  # seconds for the process before to end, so that it does not compete with the next


@contextlib.asynccontextmanager
async def _echoes() -> AsyncGenerator[tuple[hf.ActorSystem, hf.ActorRef[Echo], limits.Client], None]:
    """An echo in a process, and the limit's."""
    async with hf.ActorSystem("bench") as system, limits.echo_process() as client:
        ref = await start_process(system, "echo", hf.start(Echo))
        await ask_all(ref.ask, ECHO, 1000)
        await ask_all(client.ask, BYTES, 1000)
        yield system, ref, client


async def ask_one(run: Run) -> None:
    await _ask(run, 1, run.size(10_000), 0.7)


async def ask_hundred(run: Run) -> None:
    await _ask(run, 100, run.size(20_000), 0.4)


async def _ask(run: Run, outstanding: int, count: int, target: float) -> None:
    async with _echoes() as (_, ref, client):
        job, ours, limit = f"ask 100 B, {outstanding} outstanding", (ref.ask, ECHO), (client.ask, BYTES)
        await compare_asks(run, job, ours, limit, count, outstanding=outstanding, target=target)


async def tell(run: Run) -> None:
    count = run.size(100_000)
    async with _echoes() as (_, ref, client):

        async def ours() -> float:
            before = await ref.ask(Told())
            began = time.perf_counter()
            await tell_one(ref, DATA, count, burst=BURST)
            told = await ref.ask(Told(), timeout=60.0)
            elapsed = time.perf_counter() - began
            assert told == before + count
            return count / elapsed

        async def limit() -> float:
            before: int = await client.ask(b"", limits.COUNT)
            began = time.perf_counter()
            await tell_one(client, BYTES, count, burst=BURST)
            told: int = await client.ask(b"", limits.COUNT)
            elapsed = time.perf_counter() - began
            assert told == before + count
            return count / elapsed

        await run.compare("tell 100 B", ours, limit, unit="1/s", target=0.4)


async def ask_sibling(run: Run) -> None:
    count = run.size(10_000)
    async with _echoes() as (system, ref, client):
        driver = await start_process(system, "driver", hf.start(Driver))
        await driver.ask(Drive(ref, BYTES, 1000), timeout=60.0)

        async def ours() -> float:
            return await driver.ask(Drive(ref, BYTES, count), timeout=60.0) * 1e6

        async def limit() -> float:
            return (await ask_all(client.ask, BYTES, count)).p50 * 1e6

        await run.compare("ask 100 B, child to child through the root", ours, limit, unit="us", target=0.35)


async def array(run: Run) -> None:
    """A root started as users start it; one whose malloc is tuned from outside, as the limit's processes are."""
    roots: list[tuple[str, dict[str, str]]] = [("1 MiB array", {}), ("1 MiB array, root tuned too", TUNED_MALLOC)]
    for job, environment in roots:
        await run.compare(
            f"ask {job}, there and back",
            functools.partial(run.fresh, "array_ours", environment),
            functools.partial(run.fresh, "array_limit", TUNED_MALLOC),
            unit="us",
            target=0.8,
        )


async def array_ours(run: Run) -> float:
    """Median latency in us."""
    import numpy as np
    from workload_array import Mirror, Picture

    async with hf.ActorSystem("bench") as system:
        ref = await start_process(system, "mirror", hf.start(Mirror))
        picture = Picture(np.ones(MEBIBYTE, dtype=np.uint8))
        reply = await ref.ask(picture)
        assert reply.dtype == np.uint8
        assert reply.shape == (MEBIBYTE,)
        await ask_all(ref.ask, picture, 20)
        return (await ask_all(ref.ask, picture, run.size(400))).p50 * 1e6


async def array_limit(run: Run) -> float:
    """Median latency in us; the reply is left as bytes."""
    import numpy as np

    async with limits.echo_process() as client:
        pixels = np.ones(MEBIBYTE, dtype=np.uint8).data
        await ask_all(client.ask, pixels, 20)
        return (await ask_all(client.ask, pixels, run.size(400))).p50 * 1e6


async def start(run: Run) -> None:
    times, numbers = 3 if run.quick else 10, itertools.count()
    with limits.ForkServer() as forks:
        async with hf.ActorSystem("bench") as system:

            async def ours() -> float:
                seen: list[float] = []
                for _ in range(times):
                    await asyncio.sleep(PAUSE)
                    began = time.perf_counter()
                    ref = await start_process(system, f"echo{next(numbers)}", hf.start(Echo))
                    await ref.ask(ECHO)
                    seen.append(time.perf_counter() - began)
                    await system.stop(ref)
                return statistics.median(seen) * 1e3

            async def limit() -> float:
                seen: list[float] = []
                for _ in range(times):
                    await asyncio.sleep(PAUSE)
                    began = time.perf_counter()
                    _, client = await forks.start()
                    seen.append(time.perf_counter() - began)
                    client.transport.abort()
                    await client.closed
                return statistics.median(seen) * 1e3

            await ours()  # The fork server is started with the first process.
            await limit()
            await run.compare("a process spawned until its first answer", ours, limit, unit="ms", target=0.5)


async def first(run: Run) -> None:
    """What the first process of a program costs, its fork server included; both programs are new ones each time."""

    def ours() -> float:
        return run.fresh("first_ours", {"PYTHONDONTWRITEBYTECODE": ""})

    def limit() -> float:
        return run.fresh("first_limit")

    await run.compare("the first process until its first answer", ours, limit, unit="ms", target=0.3)
    run.bound(
        "the first process until its first answer, absolute", min(ours() for _ in range(3)), unit="ms", target=300
    )


async def first_ours(run: Run) -> float:
    """Milliseconds."""
    async with hf.ActorSystem("bench", log=False) as system:
        began = time.perf_counter()
        ref = await start_process(system, "echo", hf.start(Echo))
        await ref.ask(ECHO)
        return (time.perf_counter() - began) * 1e3


async def first_limit(run: Run) -> float:
    """Milliseconds until a bare process of the fork server of `multiprocessing` has answered."""
    return limits.first_process() * 1e3


async def recover(run: Run) -> None:
    times, queued = 3 if run.quick else 10, 10
    vault = hf.supervisor(
        "vault",
        intensity=1_000_000,
        children=[hf.child("echo", hf.start(Echo), isolation="process", recovery=hf.hybrid(interval=2.0))],
    )
    with limits.ForkServer() as forks:
        async with hf.ActorSystem("bench", log=False) as system:
            await system.start(vault)
            ref = system.ref("/bench/vault/echo", Echo)
            pid, client = await forks.start()

            async def ours() -> float:
                seen: list[float] = []
                for _ in range(times):
                    before = await ref.ask(Told())
                    await tell_one(ref, DATA, queued)  # state
                    assert await ref.ask(Told()) == before + queued
                    await asyncio.sleep(PAUSE)
                    process = system.pid_of(ref)
                    assert process != os.getpid()
                    began = time.perf_counter()
                    os.kill(process, signal.SIGKILL)
                    await tell_one(ref, DATA, queued)  # mailbox
                    told = await ref.ask(Told())
                    seen.append(time.perf_counter() - began)
                    assert told == before + 2 * queued
                    assert system.pid_of(ref) != process
                return statistics.median(seen) * 1e3

            async def limit() -> float:
                nonlocal pid, client
                seen: list[float] = []
                for _ in range(times):
                    await asyncio.sleep(PAUSE)
                    began = time.perf_counter()
                    pid, client = await forks.recover(pid, client)
                    seen.append(time.perf_counter() - began)
                return statistics.median(seen) * 1e3

            await run.compare("SIGKILL until it answers with state and mailbox", ours, limit, unit="ms", target=0.33)
            client.transport.abort()
            await client.closed


if __name__ == "__main__":
    main(
        [ask_one, ask_hundred, tell, ask_sibling, array, start, first, recover],
        {
            "array_ours": array_ours,
            "array_limit": array_limit,
            "first_ours": first_ours,
            "first_limit": first_limit,
        },
    )
