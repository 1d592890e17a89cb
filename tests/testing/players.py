"""Actors that are started in OS processes of their own. Imported there, so nothing of pytest here."""

from __future__ import annotations

import asyncio
from typing import Any

import holdfast as hf


class Add(hf.Message[int]):
    n: int


class Total(hf.Message[int]): ...


class Tell(hf.Message[None]):
    """Tell `to` something, `hops` turns later."""

    to: hf.ActorRef[Any]
    hops: int = 0


class Linger(hf.Message[int]):
    seconds: float


class Counter(hf.Actor):
    """Adds up; -1 is one too many."""

    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        if message.n < 0:
            raise ValueError("negative")
        self.total += message.n
        return self.total

    @hf.on(Total, readonly=True)
    def read(self, message: Total) -> int:
        return self.total

    @hf.on(Tell)
    def tell(self, message: Tell) -> None:
        if message.hops:
            self.ctx.ref.tell(Tell(message.to, message.hops - 1))
        else:
            message.to.tell(Add(1))

    @hf.on(Linger)
    async def linger(self, message: Linger) -> int:
        await asyncio.sleep(message.seconds)
        self.total += 1
        return self.total


class Put(hf.Message):
    items: list[int]


class Count(hf.Message[int]): ...


class Shelf(hf.Actor):
    """Counts what was put there."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Put)
    def put(self, message: Put) -> None:
        self.count += len(message.items)

    @hf.on(Count)
    def tell_count(self, message: Count) -> int:
        return self.count
