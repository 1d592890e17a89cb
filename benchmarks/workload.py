"""The messages and actors of the benchmarks; child processes import them from here."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

from harness import ask_all

import holdfast as hf

A = TypeVar("A", bound=hf.Actor)


async def start_process(system: hf.ActorSystem, name: str, start: hf.Start[A], recovery: Any = None) -> hf.ActorRef[A]:
    """Start an actor in a process of its own, and see that it is one: a task would answer sooner."""
    ref = await system.start(hf.child(name, start, isolation="process", recovery=recovery))
    assert system.pid_of(ref) != os.getpid()
    return ref


class Tick(hf.Message):
    """Told, to be counted."""


class Ping(hf.Message[int]):
    """Asked; the reply says nothing."""


class Data(hf.Message):
    """Told, to be counted, across processes."""

    data: bytes


class EchoData(hf.Message[bytes]):
    """Asked; the reply is `data`."""

    data: bytes


class Told(hf.Message[int]):
    """How many were told; in order with them, so the answer also says that they are handled."""


class Boom(hf.Message):
    """The receiver crashes."""


class Counter(hf.Actor):
    """Counts down in a plain function, and says when it is through."""

    def __init__(self, opened: Callable[[], None], left: int) -> None:
        self._opened = opened
        self.left = left

    @hf.on(Tick)
    def count(self, message: Tick) -> None:
        self.left -= 1
        if not self.left:
            self._opened()


class AsyncCounter(hf.Actor):
    """The same in a coroutine function that never waits."""

    def __init__(self, opened: Callable[[], None], left: int) -> None:
        self._opened = opened
        self.left = left

    @hf.on(Tick)
    async def count(self, message: Tick) -> None:
        self.left -= 1
        if not self.left:
            self._opened()


class Responder(hf.Actor):
    """Answers, and does as much for it as the limit."""

    def __init__(self) -> None:
        self.left = 0

    @hf.on(Ping)
    def answer(self, message: Ping) -> int:
        self.left -= 1
        return 1


class Idle(hf.Actor):
    """Has one variable and waits."""

    def __init__(self) -> None:
        self.balance = 0

    @hf.on(Ping)
    def answer(self, message: Ping) -> int:
        return self.balance


class Fragile(hf.Actor):
    """Crashes when told to."""

    def __init__(self) -> None:
        self.handled = 0

    @hf.on(Boom)
    def crash(self, message: Boom) -> None:
        raise RuntimeError("told to")

    @hf.on(Ping)
    def answer(self, message: Ping) -> int:
        self.handled += 1
        return self.handled


class Doomed(Fragile):
    """Crashes as soon as it is up."""

    def on_start(self, restored: bool) -> None:
        self.ctx.ref.tell(Boom())


class Echo(hf.Actor):
    """Lives in a process of its own."""

    def __init__(self) -> None:
        self.told = 0

    @hf.on(EchoData)
    def echo(self, message: EchoData) -> bytes:
        return message.data

    @hf.on(Data)
    def count(self, message: Data) -> None:
        self.told += 1

    @hf.on(Told, readonly=True)
    def total(self, message: Told) -> int:
        return self.told


class Drive(hf.Message[float]):
    """Ask `peer` so many times; the reply is the median latency in seconds."""

    peer: hf.ActorRef[Echo]
    data: bytes
    count: int


class Driver(hf.Actor):
    """Asks another actor from a process of its own."""

    @hf.on(Drive)
    async def drive(self, message: Drive) -> float:
        measured = await ask_all(message.peer.ask, EchoData(message.data), message.count)
        return measured.p50
