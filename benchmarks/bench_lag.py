"""How late are the host program's own callbacks while the system is saturated?

Baseline: the same loop with the system idle. A ticker sleeps a millisecond at a time and notes how late it wakes.
Command: python benchmarks/bench_lag.py [--quick]
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from harness import Gate, Run, main
from workload import AsyncCounter, Tick

import holdfast as hf

TICK_SECONDS = 0.001
RELAYS = 100
TOKENS = 1000
TICK = Tick()


class Token(hf.Message):
    """Passed on for ever."""


TOKEN = Token()


class Join(hf.Message):
    """Whom to pass tokens to."""

    next: hf.ActorRef[hf.Actor]


class Relay(hf.Actor):
    """Keeps its neighbour busy."""

    def __init__(self) -> None:
        self.next: hf.ActorRef[hf.Actor] | None = None

    @hf.on(Join)
    def join(self, message: Join) -> None:
        self.next = message.next

    @hf.on(Token)
    def relay(self, message: Token) -> None:
        assert self.next is not None
        self.next.tell(message)


class AsyncRelay(hf.Actor):
    """The same with coroutine functions."""

    def __init__(self) -> None:
        self.next: hf.ActorRef[hf.Actor] | None = None

    @hf.on(Join)
    async def join(self, message: Join) -> None:
        self.next = message.next

    @hf.on(Token)
    async def relay(self, message: Token) -> None:
        assert self.next is not None
        self.next.tell(message)


async def lag_p99(until: Callable[[], bool]) -> float:
    """99th percentile of the ticker's lateness, in ms; not on the loop's clock, which stands still within a tick."""
    late: list[float] = []
    while not until():
        slept = time.perf_counter()
        await asyncio.sleep(TICK_SECONDS)
        late.append(time.perf_counter() - slept - TICK_SECONDS)
    return sorted(late)[int(len(late) * 0.99)] * 1e3


def _after(seconds: float) -> Callable[[], bool]:
    end = time.perf_counter() + seconds
    return lambda: time.perf_counter() >= end


async def ring_plain(run: Run) -> None:
    await _ring(run, f"lag added by {TOKENS:,} messages in circulation, plain handlers", Relay)


async def ring_async(run: Run) -> None:
    await _ring(run, f"lag added by {TOKENS:,} messages in circulation, async handlers", AsyncRelay)


async def _ring(run: Run, job: str, kind: type[Relay | AsyncRelay]) -> None:
    seconds = 0.5 if run.quick else 3.0

    async def saturated() -> float:
        async with hf.ActorSystem("bench", log=False) as system:
            refs = [system.spawn(hf.start(kind)) for _ in range(RELAYS)]
            for ref, neighbour in zip(refs, refs[1:] + refs[:1], strict=True):
                ref.tell(Join(neighbour))
            for i in range(TOKENS):
                refs[i % RELAYS].tell(TOKEN)
            await asyncio.sleep(0.01)
            return await lag_p99(_after(seconds))

    async def idle() -> float:
        async with hf.ActorSystem("bench", log=False):
            return await lag_p99(_after(seconds))

    await run.added(job, saturated, idle, unit="ms", target=2.0)


async def backlog(run: Run) -> None:
    """A run loop that empties a mailbox in one go stops its host for as long as that takes."""
    count = run.size(2_000_000)

    async def saturated() -> float:
        async with hf.ActorSystem("bench", log=False) as system:
            gate = Gate()
            ref = system.spawn(hf.start(AsyncCounter, gate, count))
            for _ in range(count):
                ref.tell(TICK)
            return await lag_p99(gate.done.done)

    async def idle() -> float:
        async with hf.ActorSystem("bench", log=False):
            return await lag_p99(_after(1.0))

    await run.added(f"lag added by {count:,} messages queued for one actor", saturated, idle, unit="ms", target=2.0)


if __name__ == "__main__":
    main([ring_plain, ring_async, backlog])
