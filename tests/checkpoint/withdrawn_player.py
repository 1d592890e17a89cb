"""A program that is killed at any moment: it says of which asks it was told that they were not handled."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import random
import sys
from pathlib import Path
from typing import Any

import holdfast as hf

METHODS: dict[str, Any] = {
    "hybrid": hf.hybrid(interval=0.1),
    "replay_only": hf.replay_only(),
    "checkpoint_only": hf.checkpoint_only(0.1),
}


class Put(hf.Message[int]):
    name: str
    seconds: float = 0.0


class Done(hf.Message[int]): ...


class Slow(hf.Actor):
    """Writes down, outside, whose turns have begun."""

    def __init__(self, ledger: str) -> None:
        self._ledger = ledger
        self.count = 0

    @hf.on(Put)
    async def put(self, message: Put) -> int:
        note(self._ledger, message.name)
        if message.seconds:
            await asyncio.sleep(message.seconds)
        self.count += 1
        return self.count

    @hf.on(Done)
    def done(self, message: Done) -> int:
        return self.count


def note(path: str, name: str) -> None:
    """Behind this no kill can take it back."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        os.write(file, f"{name}\n".encode())
    finally:
        os.close(file)


def noted(path: Path) -> set[str]:
    return set(path.read_text().split()) if path.exists() else set()


def slow(where: str, method: Any, ledger: Path | str, **options: Any) -> tuple[Any, str]:
    """The actor as a task, in a process, or below a supervisor with one; and its address."""
    recipe, more = hf.start(Slow, str(ledger)), {"recovery": method, **options}
    if where == "subtree":
        child = hf.child("slow", recipe, **more)
        top = hf.supervisor("of", children=[child], isolation="process", intensity=1000)
        return top, "/app/of/slow"
    return hf.child("slow", recipe, isolation=where, **more), "/app/slow"  # type: ignore[arg-type]


async def asks(ref: hf.ActorRef[Slow], name: str, draw: random.Random, told: str) -> None:
    with contextlib.suppress(hf.AskFailed, hf.RemoteCrash, hf.ActorStopped):
        try:
            await ref.ask(Put(name, draw.choice((0.0, 0.0, 0.01, 0.05))), timeout=draw.uniform(0.01, 0.2))
        except hf.AskTimeout as late:
            if late.handled is False:
                note(told, name)


async def main(store: str, where: str, name: str, folder: str, program: int, seed: int) -> None:
    draw = random.Random(seed)
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        spec, path = slow(where, METHODS[name], f"{folder}/begun")
        await system.start(spec)
        ref = system.ref(path, Slow)
        if seed < 0:  # The last one: all that is left is handled.
            await ref.ask(Done(), timeout=60.0)
            return
        note(f"{folder}/up", str(program))
        work: set[asyncio.Task[None]] = set()
        for number in itertools.count():
            task = asyncio.create_task(asks(ref, f"{program}.{number}", draw, f"{folder}/told"))
            work.add(task)
            task.add_done_callback(work.discard)
            if number % 40 == 39:
                ref.kill() if where == "task" else os.kill(system.pid_of(ref), 9)
            await asyncio.sleep(draw.uniform(0.0, 0.03))


if __name__ == "__main__":
    a, b, c, d, *numbers = sys.argv[1:]
    asyncio.run(main(a, b, c, d, *map(int, numbers)))
