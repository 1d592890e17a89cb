"""Actors whose processes end with their fork server. Imported in those, so nothing of pytest here."""

from __future__ import annotations

import asyncio
import os
import time
from pathlib import Path

import holdfast as hf


class Add(hf.Message[int]):
    n: int = 1


class Life(hf.Message[int]):
    """Which life answers."""


class Linger(hf.Message[int]):
    """Does not end before the file is there; says so by another one when it has begun."""

    begun: str
    gate: str


class Eat(hf.Message):
    """Takes memory until there is none left."""


class Counter(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total

    @hf.on(Life)
    def life(self, message: Life) -> int:
        return self.ctx.life

    @hf.on(Linger)
    async def linger(self, message: Linger) -> int:
        with Path(message.begun).open("a") as file:
            file.write("begun\n")
        while not os.path.exists(message.gate):
            await asyncio.sleep(0.005)
        self.total += 1
        return self.total

    @hf.on(Eat)
    def eat(self, message: Eat) -> None:
        raise MemoryError("nothing left")


class SlowToReturn(hf.Actor):
    """Its later lives begin when the file is there, and say in a folder that they wait for that."""

    def __init__(self, gate: str, waiting: str) -> None:
        self.gate, self.waiting = gate, waiting

    async def on_start(self, restored: bool) -> None:
        if self.ctx.life > 1:
            Path(self.waiting, f"{self.ctx.path.rpartition('/')[2]}-{self.ctx.life}").touch()
            while not os.path.exists(self.gate):
                await asyncio.sleep(0.005)

    @hf.on(Life)
    def life(self, message: Life) -> int:
        return self.ctx.life


class Tally(hf.Message[int]):
    """The number of the message is the answer, if none was lost and none handled twice."""

    number: int


class Taken(hf.Message[list[int]]): ...


class Keeping(hf.Actor):
    """Keeps all numbers that it has been asked."""

    def __init__(self) -> None:
        self.numbers: list[int] = []

    @hf.on(Taken, readonly=True)
    def taken(self, message: Taken) -> list[int]:
        return self.numbers


class Tallying(Keeping):
    @hf.on(Tally)
    def tally(self, message: Tally) -> int:
        self.numbers.append(message.number)
        return len(self.numbers)


def double(number: int) -> int:
    return 2 * number


class Effecting(Keeping):
    """Has a part of each turn done by a process for effects."""

    @hf.on(Tally)
    async def tally(self, message: Tally) -> int:
        doubled = await self.ctx.effect(double, message.number, key=str(message.number), isolation="process")
        self.numbers.append(doubled // 2)
        return len(self.numbers)


class Stray(hf.Message[int]):
    """Leaves a process behind that has its socket open until the file is there."""

    gate: str


class Leaving(Counter):
    @hf.on(Stray)
    def stray(self, message: Stray) -> int:
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.setsid()
            os.write(writing, b".")
            while not os.path.exists(message.gate):
                time.sleep(0.01)
            os._exit(0)
        os.read(reading, 1)
        return pid
