"""What does a message cost between actors of one process?

Baseline: a deque per actor, one `call_soon` per burst, a plain function as the handler (`limits.Mailbox`).
Command: python benchmarks/bench_message.py [--quick]
"""

from __future__ import annotations

import time

import limits
from harness import Gate, Run, compare_asks, main, tell_one, tell_round
from workload import AsyncCounter, Counter, Ping, Responder, Tick

import holdfast as hf

TICK = Tick()
PING = Ping()
RECEIVERS = 1000


async def tell_plain(run: Run) -> None:
    await _tell(run, "tell 1 to 1, plain handlers", Counter, target=0.5)


async def tell_async(run: Run) -> None:
    await _tell(run, "tell 1 to 1, async handlers", AsyncCounter, target=0.2)


async def _tell(run: Run, job: str, kind: type[Counter | AsyncCounter], target: float) -> None:
    count = run.size(200_000)
    async with hf.ActorSystem("bench") as system:

        async def ours() -> float:
            gate = Gate()
            ref = system.spawn(hf.start(kind, gate, count))
            began = time.perf_counter()
            await tell_one(ref, TICK, count)
            await gate.done
            elapsed = time.perf_counter() - began
            await system.stop(ref)
            return count / elapsed

        async def limit() -> float:
            gate = Gate()
            mailbox = limits.Mailbox(gate)
            mailbox.left = count
            began = time.perf_counter()
            await tell_one(mailbox, TICK, count)
            await gate.done
            return count / (time.perf_counter() - began)

        await run.compare(job, ours, limit, unit="1/s", target=target)


async def fan_out_plain(run: Run) -> None:
    await _fan_out(run, f"fan-out to {RECEIVERS:,}, plain handlers", Counter, target=1.1)


async def fan_out_async(run: Run) -> None:
    await _fan_out(run, f"fan-out to {RECEIVERS:,}, async handlers", AsyncCounter, target=0.7)


async def _fan_out(run: Run, job: str, kind: type[Counter | AsyncCounter], target: float) -> None:
    rounds = run.size(200)
    async with hf.ActorSystem("bench") as system:

        async def ours() -> float:
            gate = Gate(RECEIVERS)
            refs = [system.spawn(hf.start(kind, gate, rounds)) for _ in range(RECEIVERS)]
            began = time.perf_counter()
            await tell_round(refs, TICK, rounds)
            await gate.done
            elapsed = time.perf_counter() - began
            for ref in refs:
                await system.stop(ref)
            return rounds * RECEIVERS / elapsed

        async def limit() -> float:
            gate = Gate(RECEIVERS)
            mailboxes = [limits.Mailbox(gate) for _ in range(RECEIVERS)]
            for mailbox in mailboxes:
                mailbox.left = rounds
            began = time.perf_counter()
            await tell_round(mailboxes, TICK, rounds)
            await gate.done
            return rounds * RECEIVERS / (time.perf_counter() - began)

        await run.compare(job, ours, limit, unit="1/s", target=target)


async def ask_one(run: Run) -> None:
    await _ask(run, 1, 0.6)


async def ask_hundred(run: Run) -> None:
    await _ask(run, 100, 0.5)


async def _ask(run: Run, outstanding: int, target: float) -> None:
    async with hf.ActorSystem("bench") as system:
        ours = system.spawn(hf.start(Responder)).ask, PING
        limit = limits.Mailbox(Gate()).ask, PING
        job, count = f"ask, {outstanding} outstanding, default deadline", run.size(50_000)
        await compare_asks(run, job, ours, limit, count, outstanding=outstanding, target=target)


if __name__ == "__main__":
    main([tell_plain, tell_async, fan_out_plain, fan_out_async, ask_one, ask_hundred])
