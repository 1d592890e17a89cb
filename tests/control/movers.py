"""Actors that are moved."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import holdfast as hf
from tests.control.players import Account


class Note(hf.Message):
    sender: str
    n: int


class Count(hf.Message[int]):
    """Asked in the same sequence as `Note`s are told."""

    sender: str
    n: int


class Seen(hf.Message[dict[str, list[int]]]): ...


class Where(hf.Message[int]): ...


class Ledger(hf.Actor):
    """Notes who sent what, in order."""

    def __init__(self) -> None:
        self.seen: dict[str, list[int]] = {}

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.seen.setdefault(message.sender, []).append(message.n)

    @hf.on(Count)
    def count(self, message: Count) -> int:
        self.seen.setdefault(message.sender, []).append(message.n)
        return message.n

    @hf.on(Seen)
    def tell_seen(self, message: Seen) -> dict[str, list[int]]:
        return self.seen

    @hf.on(Where)
    def where(self, message: Where) -> int:
        return os.getpid()


class Slow(Ledger):
    """Awaits something in each turn."""

    @hf.on(Note)
    async def note(self, message: Note) -> None:  # type: ignore[override]  # as a handler it is one
        await asyncio.sleep(0)
        self.seen.setdefault(message.sender, []).append(message.n)


class Started(Account):
    """Notes how it began, and tells of its end by a file."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = path
        self.starts: list[bool] = []

    def on_start(self, restored: bool) -> None:
        self.starts.append(restored)

    def on_stop(self, reason: hf.ExitReason) -> None:
        Path(f"{self._path}.new").write_text(f"{os.getpid()} {reason}")
        Path(f"{self._path}.new").rename(self._path)


class Fussy(Account):
    """Does not start where it may not."""

    def __init__(self, forbidden: str, how: str) -> None:
        super().__init__()
        self._forbidden, self._how = forbidden, how

    async def on_start(self, restored: bool) -> None:
        if restored and Path(self._forbidden).exists():
            await asyncio.sleep(0)
            match self._how:
                case "raise":
                    raise ValueError("not here")
                case "exit":
                    os._exit(3)
                case _:
                    await asyncio.sleep(3600)


class Tick(hf.Message): ...


class Ticks(hf.Message[list[int]]): ...


class Begin(hf.Message):
    every: float
    once: float


class End(hf.Message): ...


class Ticker(hf.Actor):
    """Has timers, and keeps their handles."""

    def __init__(self) -> None:
        self.pids: list[int] = []
        self.timers: list[hf.Timer] = []

    @hf.on(Begin)
    def begin(self, message: Begin) -> None:
        if message.every:
            self.timers.append(self.ctx.every(message.every, Tick()))
        if message.once:
            self.timers.append(self.ctx.tell_after(message.once, Tick()))

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.pids.append(os.getpid())

    @hf.on(Ticks)
    def ticks(self, message: Ticks) -> list[int]:
        return self.pids

    @hf.on(End)
    def end(self, message: End) -> None:
        for timer in self.timers:
            timer.cancel()
        self.timers.clear()


class Later(hf.Message[int]): ...


class Answer(hf.Message[int]):
    value: int


class Delayed(hf.Actor):
    """Answers when it is told to."""

    def __init__(self, hidden: bool = False) -> None:
        self.waiting: list[hf.ReplyHandle[int]] = []
        self._hidden: list[hf.ReplyHandle[int]] = []
        self._is_hidden = hidden

    @hf.on(Where)
    def where(self, message: Where) -> int:
        return os.getpid()

    @hf.on(Later)
    def later(self, message: Later) -> hf.ReplyHandle[int]:
        handle: hf.ReplyHandle[int] = self.ctx.reply_handle()
        (self._hidden if self._is_hidden else self.waiting).append(handle)
        return handle

    @hf.on(Answer)
    def answer(self, message: Answer) -> int:
        waiting = [*self.waiting, *self._hidden]
        for handle in waiting:
            handle.reply(message.value)
        self.waiting.clear()
        self._hidden.clear()
        return len(waiting)


class Open(hf.Message): ...


class Put(hf.Message[int]):
    n: int


class Door(hf.Actor):
    """Puts aside what comes until it is opened."""

    def __init__(self) -> None:
        self.is_open = False
        self.seen: list[int] = []

    @hf.on(Put)
    def put(self, message: Put) -> int:
        if not self.is_open:
            self.ctx.stash()
            return -1
        self.seen.append(message.n)
        return message.n

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.ctx.unstash()


class Work(hf.Message):
    path: str


class Done(hf.Message): ...


class Worker(Account):
    """Has work in the background."""

    @hf.on(Work)
    def work(self, message: Work) -> None:
        self.ctx.pipe_to_self(until(message.path), lambda _: Done())

    @hf.on(Done)
    def done(self, message: Done) -> None:
        self.total += 100


async def until(path: str) -> None:
    while not Path(path).exists():
        await asyncio.sleep(0.005)


class Bond(hf.Message):
    link: hf.ActorRef[Any] | None = None
    watch: hf.ActorRef[Any] | None = None


class Downs(hf.Message[list[str]]): ...


class Friend(hf.Actor):
    """Links, watches, subscribes, keeps a ref."""

    other: hf.Binding[Account]

    def __init__(self) -> None:
        self.downs: list[str] = []
        self.friend: hf.ActorRef[Any] | None = None
        self.heard = 0

    def on_start(self, restored: bool) -> None:
        if not restored:
            self.ctx.trap_exits = True
            self.ctx.subscribe("/run-time")

    @hf.on(Bond)
    def bond(self, message: Bond) -> None:
        if message.link is not None:
            self.ctx.link(message.link)
        if message.watch is not None:
            self.ctx.monitor(message.watch)
            self.friend = message.watch

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.heard += 1

    @hf.on(Downs)
    async def tell_downs(self, message: Downs) -> list[str]:
        return [*self.downs, f"heard {self.heard}", f"friend {self.friend.path if self.friend else None}"]

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.downs.append(f"down {source.path}")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.downs.append(f"exit {source.path}")


class Spawns(Account):
    """Has a child of its own."""

    def on_start(self, restored: bool) -> None:
        self.ctx.spawn(hf.start(Account), "own")


class Homesick(hf.Actor):
    """Never comes up in one process, and notes there that it was ended."""

    def __init__(self, process: int, ended: str) -> None:
        self.process, self.ended = process, ended

    async def on_start(self, restored: bool) -> None:
        if os.getpid() == self.process:
            try:
                await asyncio.Event().wait()
            finally:
                Path(self.ended).touch()


class Picky(hf.Actor):
    """Its state goes through hooks."""

    def __init__(self) -> None:
        self._values = [1]

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self._values.append(message.n)
        return sum(self._values)

    def get_state(self) -> list[int]:
        return self._values

    def set_state(self, state: list[int]) -> None:
        self._values = list(state)


class Large(hf.Actor):
    """Its state grows by as many bytes as it is told."""

    def __init__(self) -> None:
        self.data = b""

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.data += bytes(message.n)
        return len(self.data)


class Leaves(Account):
    """Stops itself at the end of a turn that waits."""

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        Path(f"{message.path}.begun").touch()
        await until(message.path)
        self.ctx.stop()


OTHER: dict[str, Any] = {"task": "process", "process": "task"}


def lives_in(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> Any:
    return "task" if system.pid_of(ref) == os.getpid() else "process"


def moved(stream: hf.events.EventStream) -> list[tuple[str, str]]:
    return [(event.origin, event.to) for event in stream.take() if isinstance(event, hf.events.Moved)]


class Shutter(hf.Actor):
    """Takes one note each time it is opened, and takes its time; the others wait."""

    def __init__(self) -> None:
        self.is_open = False
        self.taken: list[int] = []

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Count)
    async def count(self, message: Count) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        await asyncio.sleep(0.05)
        self.taken.append(message.n)
        return len(self.taken)
