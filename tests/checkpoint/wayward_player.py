"""Actors whose turn in hand goes another way when the next life runs it again."""

from __future__ import annotations

from pathlib import Path

import holdfast as hf
from tests.checkpoint.players import Note, gate


class Order(hf.Message[str]):
    item: str
    peer: hf.ActorRef[hf.Actor]


class Approved(hf.Message):
    by: str


class Look(hf.Message[list[str]]): ...


async def reserve(item: str) -> str:
    return f"reserved {item}"


async def reserve_goods(item: str) -> str:
    return f"reserved {item}"


class Wayward(hf.Actor):
    """Says what a file holds, which no record has, and waits; `how` is the version of its code."""

    def __init__(self, world: str, how: str) -> None:
        self.log: list[str] = []
        self._world, self._how = world, how

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> list[str]:
        return list(self.log)

    @hf.on(Approved)
    def late(self, message: Approved) -> None: ...

    @hf.on(Order)
    async def order(self, message: Order) -> str:
        how = self._how
        if how == "nothing":
            return "at once"
        if how == "late":  # It goes the same way as far as nobody can tell when it will go on.
            message.peer.tell(Note("begun"))
            await self.ctx.flush()
            await gate(f"{self._world}.gate")
        message.peer.tell(Note(Path(self._world).read_text()))
        if how == "a timer":
            self.ctx.tell_after(50.0, Approved("timer"))
        if how != "no effect":
            done = await self.ctx.effect(reserve_goods if how == "another effect" else reserve, message.item)
            self.log.append(done)
        if how == "one more effect":
            await self.ctx.effect(reserve, "more", key="second")
        if how == "sleeps":
            await self.ctx.sleep(3600.0)
        approved = await self.ctx.wait_for(Approved)
        self.log.append(f"approved by {approved.by}")
        return self.log[-1]
