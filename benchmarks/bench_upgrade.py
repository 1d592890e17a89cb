"""How fast does `holdfast check-upgrade` handle recorded turns again?

Baseline: the same handlers, called in a loop by themselves. All that the command does counts: the copy of the store,
the new process, its imports, reading the journal, and the comparison. Both in processor time, of all processes.
Command: python benchmarks/bench_upgrade.py [--quick]
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import tempfile

from harness import Run, main

import holdfast as hf
from holdfast.system.upgrade import check_upgrade

TURNS = 100_000
PAYLOAD = b"x" * 100_000


class Short(hf.Message[int]):
    n: int


class Long(hf.Message[int]):
    n: int


class Worker(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Short)
    def short(self, message: Short) -> int:
        self.total += message.n
        return self.total

    @hf.on(Long)
    def long(self, message: Long) -> int:
        """Work for some 50 us."""
        self.total += hashlib.sha256(PAYLOAD[: 83_000 + message.n % 100]).digest()[0]
        return self.total


tree = hf.child("worker", hf.start(Worker), recovery=hf.replay_only())


async def _recorded(store: str, kind: type[Short] | type[Long], count: int) -> None:
    async with hf.ActorSystem("bench", store=f"sqlite:{store}", log=False) as system:
        worker = await system.start(tree)
        for first in range(0, count, 1000):
            await asyncio.gather(*(worker.ask(kind(n), timeout=600.0) for n in range(first, min(first + 1000, count))))


def _by_themselves(kind: type[Short] | type[Long], count: int) -> float:
    """Seconds that the handlers take by themselves."""
    worker, messages = Worker.__new__(Worker), [kind(n) for n in range(count)]
    worker.total = 0
    handler = Worker.short if kind is Short else Worker.long
    began = _spent()
    for message in messages:
        handler(worker, message)  # type: ignore[arg-type]  # each handler gets its own kind
    return _spent() - began


def _spent() -> float:
    """Seconds of processor time, of this process and of those that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _checked(store: str, count: int) -> float:
    """Seconds that the check takes."""
    began = _spent()
    (found,) = check_upgrade(store, f"{__file__}:tree").addresses
    assert (found.verdict, found.turns) == ("fine", count + 1), found
    return _spent() - began


async def upgrade(run: Run) -> None:
    """Asks with replies: handlers that take some 50 us, and handlers that take nothing."""
    count = run.size(TURNS)
    with tempfile.TemporaryDirectory() as folder:

        async def ours() -> float:
            return await asyncio.to_thread(_checked, f"{folder}/long.db", count)

        async def limit() -> float:
            return _by_themselves(Long, count)

        await _recorded(f"{folder}/long.db", Long, count)
        await run.compare("a check beside its handlers by themselves, 50 us each", ours, limit, unit="s", target=0.7)
        await _recorded(f"{folder}/short.db", Short, count)
        took = [await asyncio.to_thread(_checked, f"{folder}/short.db", count) for _ in range(run.n)]
        run.bound("a checked turn beyond its handler", min(took) / count * 1e6, unit="us", target=30.0)


if __name__ == "__main__":
    main([upgrade])
