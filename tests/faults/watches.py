"""A program that can watch no more descriptors: it starts what it can, and goes on when that has passed."""

from __future__ import annotations

import asyncio
import os
import sys

import holdfast as hf
from tests.actors.process.waiting import until
from tests.faults.ledgers import Enter, Ledger, be_bounded

KINDS = ("process", "program")


async def attempt(system: hf.ActorSystem, kind: str, number: int) -> None:
    """Start a child, and say what came of it."""
    name = f"{kind}{number}"
    try:
        if kind == "program":
            await system.start(hf.supervision.program(["sleep", "600"], id=name))
        else:
            ledger = await system.start(hf.child(name, hf.start(Ledger), isolation="process"))
            assert await ledger.ask(Enter(number), timeout=60.0) == number
        print(f"{name} started", flush=True)
    except hf.HoldfastError as error:
        print(f"{name} {type(error).__name__}: {error}", flush=True)


def wait_for_word() -> None:
    """Nothing goes on until whoever runs us says so."""
    os.write(1, b"ready\n")
    sys.stdin.buffer.readline()


async def work(*, is_first: bool) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        first = await system.start(hf.child("first", hf.start(Ledger), isolation="task" if is_first else "process"))
        if not is_first:
            await until(lambda: bool(system._workers._ready))
            await asyncio.sleep(0.01)  # The loop has begun to watch all that was there.
        wait_for_word()
        for number in range(3):
            for kind in KINDS if is_first else reversed(KINDS):  # The first to be refused is always another.
                await attempt(system, kind, number)
        assert await first.ask(Enter(1), timeout=60.0) == 1
        wait_for_word()
        for kind in KINDS:
            await attempt(system, kind, 3)


def main() -> None:
    be_bounded()
    loop, process = sys.argv[1:]
    (hf.run if loop == "uvloop" else asyncio.run)(work(is_first=process == "first"))
