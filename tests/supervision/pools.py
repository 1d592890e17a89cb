"""A pool's workers and messages, for its tests."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from typing import Any

import holdfast as hf


class Job(hf.Message[str]):
    """Answered with the worker's name, at once or when the gate is open."""

    key: str = ""
    waits: bool = False


class Note(hf.Message):
    text: str = ""


class Notes(hf.Message[list[str]]): ...


class Who(hf.Message[str]): ...


class Pid(hf.Message[int]): ...


class Boom(hf.Message): ...


class Via(hf.Message[str]):
    """Ask the pool from within a worker."""

    again: int = 0


class Stranger(hf.Message): ...


class Gate:
    """Holds up jobs until it is opened; kept by the test."""

    def __init__(self) -> None:
        self.event = asyncio.Event()
        self.at_work: list[str] = []
        self.slow_start = False


class Worker(hf.Actor):
    def __init__(self, gate: Gate | None = None) -> None:
        self._gate = gate
        self.notes: list[str] = []

    @property
    def name(self) -> str:
        return self.ctx.path.rpartition("/")[2]

    async def on_start(self, restored: bool) -> None:
        if self._gate is not None and self._gate.slow_start:
            await self._gate.event.wait()

    @hf.on(Job)
    async def job(self, message: Job) -> str:
        if message.waits and self._gate is not None:
            self._gate.at_work.append(self.name)
            await self._gate.event.wait()
        return self.name

    @hf.on(Note)
    def note(self, message: Note) -> None:
        sender = self.ctx.sender
        self.notes.append(message.text + ("" if sender is None else f" from {sender.path}"))

    @hf.on(Notes, readonly=True)
    def all_notes(self, message: Notes) -> list[str]:
        return list(self.notes)

    @hf.on(Who)
    def who(self, message: Who) -> str:
        sender = self.ctx.sender
        return f"{self.name} {'' if sender is None else sender.path}"

    @hf.on(Pid)
    def pid(self, message: Pid) -> int:
        return os.getpid()

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Via)
    async def via(self, message: Via) -> str:
        if not message.again:
            return self.name
        pool = hf.supervision.pool_of(self.ctx, "/app/w", Worker)
        return f"{self.name} {await pool.ask(Via(message.again - 1))}"


class Other(hf.Actor):
    @hf.on(Who)
    async def who(self, message: Who) -> str:
        pool = hf.supervision.pool_of(self.ctx, "/app/w", Worker)
        pool.tell(Note("hello"))
        return await pool.ask(Who())


async def begin(
    system: hf.ActorSystem, worker: Any = None, size: int = 3, **options: Any
) -> tuple[hf.ActorRef[Any], hf.ActorRef[Worker]]:
    """The pool's supervisor, and the pool."""
    options.setdefault("intensity", 99)
    top = await system.start(hf.supervision.pool("w", worker or hf.start(Worker), size, **options))
    return top, hf.supervision.pool_of(system, "/app/w", Worker)


def one(system: hf.ActorSystem, number: int) -> hf.ActorRef[Worker]:
    return system.ref(f"/app/w/{number}", Worker)


async def names(pool: hf.ActorRef[Worker], count: int, key: Callable[[int], str] = lambda _: "") -> str:
    return " ".join([await pool.ask(Job(key(number))) for number in range(count)])


async def settled(system: hf.ActorSystem) -> None:
    """Until nothing happens any more; turns may wait (which `node.settled` would wait for): all is in this process."""
    for _ in range(20):
        await asyncio.sleep(0)
        while system._node.awake:
            await asyncio.sleep(0)
