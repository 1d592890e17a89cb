"""Actors whose processes end with their fork server. Imported in those, so nothing of pytest here."""

from __future__ import annotations

import asyncio
import os
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
