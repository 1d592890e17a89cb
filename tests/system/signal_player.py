"""A program for `test_signals.py`, which sends it signals: python signal_player.py STORE.

It says "up" when all its actors are, and makes them work until it is told to end; its actors end within `BOUND`.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys

import holdfast as hf
from holdfast.ftm.mechanisms.pbr import PBR

SHUTDOWN = 1.0
BOUND = 8 * (SHUTDOWN + 1.0) + 5.0
"""Seconds in which the program ends: for each leaf its shutdown limit and the grace of a kill, and 5 s of slack."""


class Add(hf.Message[int]):
    to: str = ""


class Adder(hf.Actor):
    """Counts, and has somebody else count."""

    def __init__(self) -> None:
        self.total = 0

    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(0.01)

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        self.total += 1
        if message.to:
            await self.ctx.find(message.to, Adder).ask(Add())
        return self.total

    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(0.01)


def adder(id: str, **options: object) -> hf.ChildSpec:
    return hf.child(id, hf.start(Adder), shutdown=SHUTDOWN, **options)  # type: ignore[arg-type]


async def work(system: hf.ActorSystem, path: str, other: str) -> None:
    """Ask one after the other; some of it fails while all is being stopped."""
    while True:
        with contextlib.suppress(hf.HoldfastError):
            await system.ref(path, Adder).ask(Add(other), timeout=1.0)
        await asyncio.sleep(0.001)


def tell_tasks() -> None:
    """Say where everybody waits, if the program does not end."""
    for task in asyncio.all_tasks():
        task.print_stack()


async def main(store: str) -> None:
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, tell_tasks)
    print("begun", flush=True)
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        await system.start(adder("task"))
        await system.start(adder("recorded", recovery=hf.hybrid()))
        await system.start(adder("process", isolation="process"))
        below = [adder("plain"), adder("recorded", recovery=hf.hybrid()), adder("late")]
        await system.start(hf.supervisor("there", children=below, isolation="process"))
        await system.start(adder("protected", mechanism=PBR(), recovery=hf.hybrid()))
        paths = ("task", "recorded", "process", "there/plain", "there/recorded", "there/late", "protected")
        async with asyncio.TaskGroup() as group:
            for one, other in zip(paths, (*paths[1:], paths[0]), strict=True):
                group.create_task(work(system, f"/app/{one}", f"/app/{other}"))
            print("up", flush=True)


if __name__ == "__main__":
    hf.run(main(sys.argv[1]))
