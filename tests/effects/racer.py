"""An actor whose turns race an effect against a message, and give up what they do not want any more."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from pathlib import Path
from typing import Any

import holdfast as hf
from tests.effects.clerk import IN_TIME, note

__all__ = ["IN_TIME", "Cancel", "Look", "Other", "Race", "Racer", "Start", "racer"]


class Race(hf.Message[str]):
    """Pay, and be cancelled: what comes first counts. `world` is a folder: see `wait_in`."""

    world: str
    at_most_once: bool = False


class GiveUp(hf.Message[str]):
    """Give up to wait for a Cancel, in one of several ways, and wait for it once more behind what `world` says."""

    world: str
    how: str


class Leave(hf.Message[str]):
    """End the turn, and have waited for a Cancel without awaiting it."""


class Tire(hf.Message[str]):
    """Lose patience with a payment, say so, and wait on."""

    world: str


class Two(hf.Message[str]):
    """Have two effects at once."""

    world: str


class Both(hf.Message[str]):
    """Ask two actors, and say who was first; it goes on when `world` says so."""

    world: str
    actors: list[hf.ActorRef[Any]]


class Start(hf.Message[str]):
    """Answer when `world` says so."""

    world: str
    word: str


class Cancel(hf.Message):
    word: str = ""


class Other(hf.Message):
    word: str = ""


class Look(hf.Message[list[str]]): ...


WORDS = ["one", "two"]
"""What effects `Two` has; a test changes that between two lives."""


async def wait_in(world: str, word: str) -> str:
    """An effect: it says that it was begun, and ends when there is a file of that name."""
    note(f"{world}/begun", word)
    while not Path(world, word).exists():
        await asyncio.sleep(0.001)
    note(f"{world}/ended", word)
    return word


def let(world: str | Path, word: str) -> None:
    """Have what is waited for there come."""
    Path(world, word).touch()


class Racer(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[str] = []

    @hf.on(Race)
    async def race(self, message: Race) -> str:
        paid = self.ctx.effect(wait_in, message.world, "paid", key="x", at_most_once=message.at_most_once)
        cancel = self.ctx.wait_for(Cancel)
        both: list[asyncio.Future[Any]] = [paid, cancel]
        done, rest = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        for one in rest:
            one.cancel()
        said = [str(one.result()) for one in (paid, cancel) if one in done]
        said.append(await self.ctx.effect(wait_in, message.world, "then " + " ".join(map(str, said)), key="x"))
        await self.ctx.effect(wait_in, message.world, "end", key="x")
        self.seen += said
        return ", ".join(said)

    @hf.on(GiveUp)
    async def give_up(self, message: GiveUp) -> str:
        await self.given_up(message.how)
        await self.ctx.effect(wait_in, message.world, "again")
        try:
            return f"had {(await self.ctx.wait_for(Cancel, timeout=0.5)).word}"
        except hf.errors.WaitTimeout:
            return "had nothing"

    async def given_up(self, how: str) -> None:
        try:
            match how:
                case "timeout":
                    async with asyncio.timeout(0.05):
                        await self.ctx.wait_for(Cancel)
                case "wait_for":
                    await asyncio.wait_for(self.ctx.wait_for(Cancel), 0.05)
                case "gather":
                    async with asyncio.timeout(0.05):
                        await asyncio.gather(self.ctx.wait_for(Cancel), self.ctx.sleep(9.0))
                case "group":
                    async with asyncio.timeout(0.05), asyncio.TaskGroup() as tasks:
                        tasks.create_task(awaited(self.ctx.wait_for(Cancel)))
                case "first":
                    both: list[asyncio.Future[Any]] = [self.ctx.wait_for(Cancel), self.ctx.sleep(0.05)]
                    done, rest = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
                    assert len(done) == len(rest) == 1
                    rest.pop().cancel()
                case _:
                    self.ctx.wait_for(Cancel).cancel()
        except TimeoutError:
            pass

    @hf.on(Leave)
    def leave(self, message: Leave) -> str:
        self.ctx.wait_for(Cancel)
        return "left"

    @hf.on(Tire)
    async def tire(self, message: Tire) -> str:
        paid = self.ctx.effect(wait_in, message.world, "paid")
        done, _ = await asyncio.wait([paid], timeout=0.05)
        if not done:
            await self.ctx.effect(wait_in, message.world, "tired")
        await self.ctx.effect(wait_in, message.world, "end")
        return f"{await paid} {len(done)}"

    @hf.on(Two)
    async def two(self, message: Two) -> str:
        effects = [self.ctx.effect(wait_in, message.world, word, key=word) for word in WORDS]
        for one in reversed(effects):
            await one
        await self.ctx.effect(wait_in, message.world, "end", key="end")
        return "both"

    @hf.on(Both)
    async def both(self, message: Both) -> str:
        asked = [one.ask(Start(message.world, str(number)), timeout=60.0) for number, one in enumerate(message.actors)]
        done, _ = await asyncio.wait(asked, return_when=asyncio.FIRST_COMPLETED)
        said = " ".join(sorted(one.result() for one in done))
        await self.ctx.effect(wait_in, message.world, "end")
        return said

    @hf.on(Start)
    async def start(self, message: Start) -> str:
        return await wait_in(message.world, message.word)

    @hf.on(Cancel)
    def cancel(self, message: Cancel) -> None:
        self.seen.append(f"late {message.word}")

    @hf.on(Other)
    def other(self, message: Other) -> None:
        self.seen.append(f"other {message.word}")

    @hf.on(Look)
    def look(self, message: Look) -> list[str]:
        return self.seen


async def awaited(outcome: Awaitable[Any]) -> Any:
    return await outcome


def racer(isolation: Any = "task", name: str = "racer", **options: Any) -> hf.ChildSpec[Racer]:
    method = options.pop("recovery", hf.hybrid(interval=1000.0))
    return hf.child(name, hf.start(Racer), isolation=isolation, recovery=method, shutdown=0.2, **options)
