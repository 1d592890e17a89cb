"""A root that is killed while its actors run random programs of effects and waits, run by `test_campaign.py`:

python -m tests.effects.effect_player STORE WORLD DURABILITY [N ...]

Worker w gets the numbers from the w-th N on; what was accepted is said on stdout. Each number is a program of its own,
see `program`. Every effect writes a line into the file WORLD, and now and then ends its process there. Without any N
the workers only finish what they have, and say what they have seen.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import sys
from typing import Any

import holdfast as hf

WORKERS = ("task", "process", "process")
FATAL = 0.01
"""How often an effect ends its process."""


class Work(hf.Message[int]):
    n: int


class Ring(hf.Message): ...


class Ready(hf.Message): ...


class All(hf.Message[list[tuple[int, list[str]]]]): ...


def program(worker: int, n: int) -> list[str]:
    """The steps of a number: "e", "t", "o" are effects, async, in a thread, at most once; "s", "w", "g" are waits.

    "g" is a sleep beside two effects.
    """
    draw = random.Random(f"{worker} {n}")
    return draw.choices("etoswg", weights=(4, 2, 3, 2, 1, 1), k=draw.randint(1, 6))


def note(world: str, line: str, may_die: bool) -> str:
    """Something happens in the world."""
    descriptor = os.open(world, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(descriptor, f"{line}\n".encode())
    os.close(descriptor)
    if may_die and random.random() < FATAL:
        os.kill(os.getpid(), signal.SIGKILL)
    return line.split()[2]


async def note_async(world: str, line: str, may_die: bool) -> str:
    """The same, awaited."""
    await asyncio.sleep(random.choice((0.0, 0.001)))
    return note(world, line, may_die)


class Worker(hf.Actor):
    def __init__(self, worker: int, world: str) -> None:
        self.worker, self.world = worker, world
        self.done: list[tuple[int, list[str]]] = []

    def effect(self, n: int, step: str, how: str) -> asyncio.Future[str]:
        line = f"{self.worker} {n} {step} {self.ctx.message_id}"
        is_process = WORKERS[self.worker] == "process"
        if how == "t":
            return self.ctx.effect(note, self.world, line, is_process, key=step)
        return self.ctx.effect(note_async, self.world, line, is_process, key=step, at_most_once=how == "o")

    async def outcome(self, effect: asyncio.Future[str]) -> str:
        try:
            return await effect
        except hf.errors.EffectInDoubt:
            return "doubt"

    @hf.on(Work)
    async def work(self, message: Work) -> int:
        n, said = message.n, list[str]()
        for index, how in enumerate(program(self.worker, n)):
            if how in "eto":
                said.append(await self.outcome(self.effect(n, f"{how}{index}", how)))
            elif how == "s":
                await self.ctx.sleep(0.002)
            elif how == "w":
                await self.ctx.wait_for(Ring)
            else:
                many = [self.effect(n, f"{how}{index}{one}", "e") for one in "ab"]
                await self.ctx.sleep(0.001)
                said += await asyncio.gather(*many)
        self.done.append((n, said))
        return n

    @hf.on(Ring)
    def ring(self, message: Ring) -> None: ...

    @hf.on(Ready)
    def ready(self, message: Ready) -> None: ...

    @hf.on(All)
    def read(self, message: All) -> list[tuple[int, list[str]]]:
        return self.done


async def call(worker: int, n: int, ref: hf.ActorRef[Worker]) -> None:
    while True:
        await ref.send(Work(n))
        os.write(1, b"%d %d\n" % (worker, n))  # From here on it must not get lost.
        if n % 5 == 0:
            await ref.ask(Ready(), timeout=60.0)  # Not more than it can do.
        n += 1


async def ring(refs: list[hf.ActorRef[Worker]]) -> None:
    while True:
        for ref in refs:
            ref.tell(Ring())
        await asyncio.sleep(0.005)


async def main(store: str, world: str, durability: Any, begin: list[int]) -> None:
    system = hf.ActorSystem("app", store=f"sqlite:{store}", durability=durability, log=False, intensity=10_000)
    async with system:
        method = hf.hybrid(interval=0.05, max_deliveries=1000)
        refs = [
            await system.start(hf.child(f"w{number}", hf.start(Worker, number, world), isolation=how, recovery=method))  # type: ignore[arg-type]
            for number, how in enumerate(WORKERS)
        ]
        ringing = asyncio.create_task(ring(refs))
        if begin:
            await asyncio.gather(*[call(number, n, refs[number]) for number, n in enumerate(begin)])
        have = [await ref.ask(All(), timeout=60.0) for ref in refs]
        ringing.cancel()
        os.write(1, json.dumps(have).encode() + b"\n")


if __name__ == "__main__":
    hf.run(main(sys.argv[1], sys.argv[2], sys.argv[3], [int(word) for word in sys.argv[4:]]))
