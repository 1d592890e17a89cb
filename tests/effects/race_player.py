"""An actor whose turns are random programs of races: effects, moments, messages and answers, some of them given up."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections import Counter
from collections.abc import Awaitable
from typing import Any

import holdfast as hf

WORLD: Counter[str] = Counter()
"""What the effects have done, outside of all actors."""
DELAYS = (0.0, 0.01, 0.01, 0.02, 0.3)
"""Seconds after which things come. Several come at the same moment."""


class Play(hf.Message[list[str]]):
    n: int


class Ring(hf.Message):
    number: int


class Echo(hf.Message[str]):
    word: str
    seconds: float


class Step(hf.Message):
    n: int
    index: int
    said: str


class Told(hf.Message[dict[str, list[Any]]]): ...


async def act(word: str, seconds: float) -> str:
    """An effect."""
    await asyncio.sleep(seconds)
    WORLD[word] += 1
    return word


async def awaited(outcome: Awaitable[str]) -> str:
    return await outcome


class Helper(hf.Actor):
    def __init__(self) -> None:
        self.steps: list[tuple[int, int, str]] = []

    @hf.on(Echo)
    async def echo(self, message: Echo) -> str:
        await self.ctx.sleep(message.seconds)
        return message.word

    @hf.on(Step)
    def step(self, message: Step) -> None:
        self.steps.append((message.n, message.index, message.said))

    @hf.on(Told, readonly=True)
    def told(self, message: Told) -> dict[str, list[Any]]:
        return {"steps": list(self.steps)}


class Player(hf.Actor):
    helper: hf.Binding[Helper]
    ledger: hf.Binding[Helper]

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.done: list[tuple[int, list[str]]] = []
        self.rang: list[int] = []

    @hf.on(Play)
    async def play(self, message: Play) -> list[str]:
        n = message.n
        if n in (known := dict(self.done)):
            return known[n]
        draw = random.Random(f"{self.seed} {n}")
        said: list[str] = []
        every: list[asyncio.Future[Any]] = []
        await self.ctx.sleep(0.0)  # A turn that only asks does not hear each answer by itself.
        for index in range(draw.randint(1, 5)):
            said.append(await self.step(draw, f"{n}.{index}", every))
            self.ledger.tell(Step(n, index, said[-1]))
        heard = " ".join(said).split()
        said += [text for one in every if (text := outcome(one)).startswith("ring") and text.split()[1] not in heard]
        self.done.append((n, said))
        return said

    async def step(self, draw: random.Random, name: str, every: list[asyncio.Future[Any]]) -> str:
        """Wait for some of what is begun, and say what has come of it; all of it is added to `every`."""
        how, after = draw.choice(("race", "race", "race", "gather", "group")), draw.choice(("cancel", "await", "leave"))
        sources = [
            self.begin(draw.choice("eswwa"), f"{name}.{at}", draw.choice(DELAYS)) for at in range(draw.randint(1, 3))
        ]
        every += sources
        if how == "race":
            done, rest = await asyncio.wait(sources, return_when=asyncio.FIRST_COMPLETED)
            said = list(map(outcome, done))
            if after == "cancel":
                for one in rest:
                    one.cancel()
            elif after == "await" and rest:
                done, _ = await asyncio.wait(rest)
                said += ["then", *map(outcome, done)]
            return " ".join(said)
        if how == "gather":
            await asyncio.gather(*sources, return_exceptions=True)
        else:
            with contextlib.suppress(ExceptionGroup):
                async with asyncio.TaskGroup() as group:
                    for one in sources:
                        group.create_task(awaited(one))
        return " ".join(map(outcome, sources))

    def begin(self, kind: str, name: str, seconds: float) -> asyncio.Future[Any]:
        """Begin an effect, a sleep, a wait for a ring, or an ask."""
        match kind:
            case "e":
                return self.ctx.effect(act, f"e{name}", seconds, key=name)
            case "s":
                return self.ctx.sleep(seconds)
            case "w":
                return self.ctx.wait_for(Ring, timeout=seconds or 1.0)
            case _:
                return self.helper.ask(Echo(name, seconds), timeout=1000.0)

    @hf.on(Ring)
    def ring(self, message: Ring) -> None:
        self.rang.append(message.number)

    @hf.on(Told)
    def told(self, message: Told) -> dict[str, list[Any]]:
        return {"done": list(self.done), "rang": list(self.rang)}


def outcome(one: asyncio.Future[Any]) -> str:
    """What came of it, in words."""
    if not one.done():
        return "left"
    if one.cancelled():
        return "given up"
    error = one.exception()
    if error is not None:
        return type(error).__name__
    result = one.result()
    return f"ring {result.number}" if isinstance(result, Ring) else str(result)
