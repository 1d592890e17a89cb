"""Actors that say something to others that were stopped before them, and accounts that pay each other."""

from __future__ import annotations

from typing import Any

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Note, gate

TOPIC = "/between"


class Speaker(Doer):
    """Also publishes, and asks with a long time limit."""

    async def step(self, verb: str, arg: str, peer: hf.ActorRef[Any] | None) -> Any:
        match verb:
            case "publish":
                await self.ctx.publish(TOPIC, Note(arg))
            case "wait" if peer is not None:
                self.seen.append(f"{arg}:{await peer.ask(Note(arg), timeout=600.0)}")
            case "both" if peer is not None:
                asked = peer.ask(Note(arg), timeout=600.0)
                await self.ctx.effect(gate, arg)
                self.seen.append(f"{arg}:{await asked}")
            case "promise" if peer is not None:
                self.seen.append(f"promised:{await peer.ask(Do(['later']), timeout=60.0)}")
            case _:
                return await super().step(verb, arg, peer)
        return None


class Listener(Speaker):
    """Hears what is published as well."""

    @hf.subscribe(TOPIC)
    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.seen.append(message.text)
        return len(self.seen)


class Pay(hf.Message):
    number: int
    to: str
    how: str


class Take(hf.Message[int]):
    number: int


class Book(hf.Message[tuple[list[int], list[int], int]]): ...


class Account(hf.Actor):
    """Pays one coin for each order, and knows by number what it has paid and got."""

    def __init__(self) -> None:
        self.coins = 100
        self.paid: list[int] = []
        self.got: list[int] = []

    @hf.on(Pay)
    async def pay(self, message: Pay) -> None:
        to = self.ctx.find(message.to, Account)
        self.coins -= 1
        match message.how:
            case "tell":
                to.tell(Take(message.number))
            case "send":
                await to.send(Take(message.number))
            case "first":
                await self.ctx.sleep(0.002)
                await to.ask(Take(message.number), timeout=60.0)
            case _:
                await to.ask(Take(message.number), timeout=60.0)
        self.paid.append(message.number)

    @hf.on(Take)
    def take(self, message: Take) -> int:
        self.coins += 1
        self.got.append(message.number)
        return self.coins

    @hf.on(Book, readonly=True)
    def book(self, message: Book) -> tuple[list[int], list[int], int]:
        return list(self.paid), list(self.got), self.coins
