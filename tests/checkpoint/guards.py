"""Actors that are told to be safe, and what the tests of the recovery controller share."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncGenerator
from typing import Any

import holdfast as hf
from tests.checkpoint.players import Doer, start, until
from tests.checkpoint.strikes import NEVER

PHASES = ["detect", "safe_state", "isolate", "restart", "restore", "replay", "release"]
POINTS = [(when, phase) for phase in PHASES[1:] for when in ("before", "after")]


class Halt(hf.Message):
    speed: float


class Resume(hf.Message): ...


class Words(hf.Message[list[str]]): ...


class Faint(hf.Message): ...


class Wheels(hf.Actor):
    """Writes down what it is told; its words are its state."""

    def __init__(self) -> None:
        self.words: list[str] = []

    def on_safe_state(self, entered: bool) -> None:
        self.words.append("safe" if entered else "free")

    @hf.on(Halt)
    def halt(self, message: Halt) -> None:
        self.words.append(f"halt {message.speed}")

    @hf.on(Resume)
    def resume(self, message: Resume) -> None:
        self.words.append("resume")

    @hf.on(Faint)
    def faint(self, message: Faint) -> None:
        raise RuntimeError("too hot in here")

    @hf.on(Words, readonly=True)
    def say(self, message: Words) -> list[str]:
        return list(self.words)


class Planner(Doer):
    """A doer that drives wheels."""

    wheels: hf.Binding[Wheels]


@contextlib.asynccontextmanager
async def running(store: str | None = None, **options: Any) -> AsyncGenerator[hf.ActorSystem, None]:
    """A system that allows many restarts."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store, **options) as system:
        yield system


async def wheels(system: hf.ActorSystem, name: str = "wheels", **options: Any) -> hf.ActorRef[Wheels]:
    return await system.start(hf.child(name, hf.start(Wheels), **options))


async def planner(system: hf.ActorSystem, isolation: str, name: str = "planner", **method: Any) -> hf.ActorRef[Any]:
    method.setdefault("interval", NEVER)
    method.setdefault("safe_state", "/app/wheels")
    return await start(system, isolation, name, hf.start(Planner), recovery=hf.hybrid(**method), shutdown=8.0)


async def words(ref: hf.ActorRef[Any]) -> list[str]:
    return await ref.ask(Words(), timeout=30.0)


async def over(system: hf.ActorSystem) -> None:
    """Wait until no recovery is under way and the controller has told of all."""
    recoveries = system._homes.recoveries
    await until(lambda: not recoveries.all() and not recoveries._untold and not recoveries.held)


def part(system: hf.ActorSystem, name: str) -> hf.ActorRef[Any]:
    """A part of the recovery: "" is their supervisor."""
    return system._node.cell_at(f"/app/recovery/{name}".rstrip("/")).ref


def phases(events: list[hf.events.Event], address: str) -> list[tuple[int, str]]:
    """(attempt, phase) of those that were told of."""
    return [
        (one.attempt, one.phase)
        for one in events
        if isinstance(one, hf.events.RecoveryPhase) and one.address == address
    ]
