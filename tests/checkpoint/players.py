"""Actors that do as they are told, for tests that kill them in the middle of it."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from pathlib import Path
from typing import Any

import holdfast as hf


async def start(
    system: hf.ActorSystem, isolation: str, name: str, recipe: hf.Start[Any], **options: Any
) -> hf.ActorRef[Any]:
    """Start an actor as a task, in a process, or below a supervisor that has a process ("subtree")."""
    if isolation != "subtree":
        return await system.start(hf.child(name, recipe, isolation=isolation, **options))  # type: ignore[arg-type]
    spec = hf.supervisor(
        f"of-{name}", children=[hf.child(name, recipe, **options)], isolation="process", intensity=1000
    )
    await system.start(spec)
    return system.ref(f"/app/of-{name}/{name}", recipe.kind)


class Note(hf.Message[int]):
    text: str


class Notes(hf.Message[list[str]]): ...


class Sink(hf.Actor):
    """Notes what it gets; never recorded, never killed: what it has was really sent, and as often."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.notes.append(message.text)
        return len(self.notes)

    @hf.on(Notes, readonly=True)
    def read(self, message: Notes) -> list[str]:
        return list(self.notes)


class Pass(hf.Message): ...


class Let(hf.Message): ...


class Barrier(hf.Actor):
    """Answers nobody until it is told to let them through."""

    def __init__(self) -> None:
        self.waiting: list[hf.ReplyHandle[None]] = []
        self.lets = False

    @hf.on(Pass)
    def come(self, message: Pass) -> hf.ReplyHandle[None] | None:
        if self.lets:
            return None
        self.waiting.append(self.ctx.reply_handle())
        return self.waiting[-1]

    @hf.on(Let)
    def let(self, message: Let) -> None:
        self.lets = True
        for one in self.waiting:
            one.reply(None)


class Do(hf.Message[str]):
    """Steps such as "add 1"; what is sent goes to `peer`."""

    steps: list[str]
    peer: hf.ActorRef[Any] | None = None


class Seen(hf.Message[list[str]]): ...


class Tick(hf.Message):
    text: str


class No(hf.Refusal):
    why: str


class Doer(hf.Actor):
    """Its state is the list of what it has done."""

    def __init__(self) -> None:
        self.seen: list[str] = []
        self.handles: list[hf.ReplyHandle[str]] = []
        self.timers: list[Any] = []

    @hf.on(Seen, readonly=True)
    def read(self, message: Seen) -> list[str]:
        return list(self.seen)

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.seen.append(message.text)

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.seen.append(message.text)
        return len(self.seen)

    @hf.on(Do)
    async def do(self, message: Do) -> Any:
        result: Any = None
        for step in message.steps:
            verb, _, arg = step.partition(" ")
            result = await self.step(verb, arg, message.peer) or result
        return result or str(len(self.seen))

    async def step(self, verb: str, arg: str, peer: hf.ActorRef[Any] | None) -> Any:
        match verb:
            case "add":
                self.seen.append(arg)
            case "tell" if peer is not None:
                peer.tell(Note(arg))
            case "send" if peer is not None:
                await peer.send(Note(arg))
            case "ask" if peer is not None:
                reply = await peer.ask(Note(arg), timeout=20.0)
                self.seen.append(f"{arg}:{reply}")
            case "hurry" if peer is not None:
                try:
                    await peer.ask(Do(["gate " + arg]), timeout=0.05)
                except hf.AskTimeout:
                    self.seen.append("timeout")
            case "flush":
                await self.ctx.flush()
            case "gate":
                await gate(arg)
            case "once":
                if not Path(arg).exists():
                    Path(arg).touch()
                    os.kill(os.getpid(), signal.SIGKILL)
            case "die":
                with Path(arg).open("a") as deaths:
                    deaths.write("x")
                os.kill(os.getpid(), signal.SIGKILL)
            case "raise":
                if arg != "when open" or "open" in self.seen:
                    raise RuntimeError(arg)
            case "fail":
                raise OSError("for good")
            case "memory":
                raise MemoryError
            case "hang":
                if not Path(arg).exists():
                    Path(arg).touch()
                    time.sleep(60.0)
            case "replayed":
                if Path(arg).exists():
                    raise RuntimeError("it fails the second time")
                Path(arg).touch()
            case "leave":
                self.ctx.stop(hf.SHUTDOWN)
            case "refuse":
                raise No(arg)
            case "world":
                self.seen += [repr(self.ctx.now()), repr(self.ctx.random.random()), str(self.ctx.uuid())]
            case "stash":
                if "open" not in self.seen:
                    self.ctx.stash()
                else:
                    self.seen.append(arg)
            case "unstash":
                self.seen.append("open")
                self.ctx.unstash()
            case "later":
                handle = self.ctx.reply_handle()
                self.handles.append(handle)
                return handle
            case "reply":
                self.handles.pop(0).reply(arg)
            case "after":
                self.timers.append(self.ctx.tell_after(float(arg), Tick("tick")))
            case "every":
                self.timers.append(self.ctx.every(float(arg), Tick("tick")))
            case "cancel":
                self.timers.pop(0).cancel()
            case "pipe":
                self.ctx.pipe_to_self(gate(arg), lambda _: Tick("piped"))
            case "burst":
                self.ctx.pipe_to_self(burst(arg), lambda _: Tick("piped"))
            case "subscribe":
                self.ctx.subscribe(arg)
            case "monitor" if peer is not None:
                self.ctx.monitor(peer)
            case "link" if peer is not None:
                self.ctx.link(peer)
            case "stop":
                self.ctx.stop()
            case "forward" if peer is not None:
                if peer != self.ctx.ref:
                    self.ctx.forward(peer)
            case "spoil":
                self.spoiled = object()
            case "mend":
                del self.spoiled
            case _:
                raise ValueError(verb)
        return None

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.seen.append(f"down {recovering}")


class Late(Doer):
    """Its start takes until somebody lets it through."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = path

    async def on_start(self, restored: bool) -> None:
        await gate(self._path)


async def gate(path: str) -> None:
    """Say that we are here, and wait until somebody lets us through."""
    Path(path).touch()
    while not Path(path + ".open").exists():
        await asyncio.sleep(0.001)


async def burst(path: str) -> None:
    """Background work that fails, and counts how often it did."""
    with Path(path).open("a") as file:
        file.write("x")
    raise OSError("no luck")


class Hooks(hf.Actor):
    """Writes down the order of its hooks, in a file: a life's memory ends with it. Dies at the hook named in `fuse`."""

    def __init__(self, log: str, fuse: str) -> None:
        self.count = 0
        self._log, self._fuse = log, fuse
        self._say("init")

    def _say(self, word: str) -> None:
        with Path(self._log).open("a") as file:
            file.write(word + "\n")
        if Path(self._fuse).exists() and Path(self._fuse).read_text() == word:
            Path(self._fuse).unlink()
            if Path(self._fuse + ".kill").exists():
                os.kill(os.getpid(), signal.SIGKILL)
            raise RuntimeError(f"{word} fails once")

    def on_start(self, restored: bool) -> None:
        self._say(f"start {restored}")

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self._say(f"note {message.text}")
        self.count += 1
        return self.count

    def on_recovered(self) -> None:
        self._say(f"recovered {self.count}")


class Dice(hf.Actor):
    """Not deterministic, and does not say so: it sends what only this process knows."""

    def __init__(self) -> None:
        self.rolls = 0

    @hf.on(Do)
    async def do(self, message: Do) -> str:
        self.rolls += 1
        assert message.peer is not None
        message.peer.tell(Note(str(id(self) + os.urandom(4)[0] * 2**64 + int.from_bytes(os.urandom(8)))))
        return str(self.rolls)


class Honest(hf.Actor):
    """Says that it is not deterministic."""

    deterministic = False


class Unsavable(hf.Actor):
    """Has a state that no snapshot can hold."""

    def __init__(self) -> None:
        self.lock = asyncio.Lock()


async def until(is_so: Any, seconds: float = 60.0) -> None:
    """Wait for something that only shows when it is looked at."""
    async with asyncio.timeout(seconds):
        while not is_so():
            await asyncio.sleep(0.002)
