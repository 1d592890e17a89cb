"""Actors in OS processes that watch others, publish and send. Imported there, so nothing of pytest here."""

from __future__ import annotations

from typing import Any

import holdfast as hf
from tests.actors.process.players import Fail, Note, Notebook, Seen, Where


class Watch(hf.Message):
    """Link to, monitor, watch or forget `other`; with `how` as the name of the method of ctx."""

    how: str
    other: hf.ActorRef[Any]


class Cancel(hf.Message):
    """Cancel all monitors."""


class Trap(hf.Message):
    pass


class Heard(hf.Message[list[list[str]]]):
    """What `on_exit` and `on_down` were told: which, from whom, why, recovering or not."""


class HeardSome(hf.Message[list[list[str]]]):
    """The same, as soon as there are `count`."""

    count: int


class Subscribe(hf.Message):
    topic: str
    wanted: bool = True


class Publish(hf.Message[float]):
    """Publish all of `texts`; the reply comes when everybody has accepted."""

    topic: str
    texts: list[str]


class Send(hf.Message[str]):
    """Send `count` notes to `to`, waiting for the acceptance of each."""

    to: hf.ActorRef[Any]
    count: int


class AskPort(hf.Message[int]):
    """Ask whoever is bound for its pid."""


class Spawn(hf.Message[hf.ActorRef[Any]]):
    name: str


class StopChild(hf.Message):
    ref: hf.ActorRef[Any]
    kill: bool = False


class Observer(Notebook):
    """Watches others, publishes and sends."""

    port: hf.Binding[Notebook]
    second: hf.Binding[Notebook]

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[list[str]] = []
        self.monitors: list[hf.Monitor] = []
        self.listeners: list[tuple[int, hf.ReplyHandle[list[list[str]]]]] = []

    @hf.on(Watch)
    def watch(self, message: Watch) -> None:
        made = getattr(self.ctx, message.how)(message.other)
        if made is not None:
            self.monitors.append(made)

    @hf.on(Cancel)
    def cancel(self, message: Cancel) -> None:
        for monitor in self.monitors:
            monitor.cancel()

    @hf.on(Trap)
    def trap(self, message: Trap) -> None:
        self.ctx.trap_exits = True

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self._hear("exit", source.path, str(reason), "")

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self._hear("down", source.path, str(reason), str(recovering))

    def _hear(self, *what: str) -> None:
        self.heard.append(list(what))
        for count, handle in self.listeners:
            if len(self.heard) >= count:
                handle.reply(self.heard)

    @hf.on(Heard, readonly=True)
    def all_heard(self, message: Heard) -> list[list[str]]:
        return self.heard

    @hf.on(HeardSome)
    def some_heard(self, message: HeardSome) -> hf.ReplyHandle[list[list[str]]]:
        handle = self.ctx.reply_handle()
        self.listeners.append((message.count, handle))
        if len(self.heard) >= message.count:
            handle.reply(self.heard)
        return handle

    @hf.on(Subscribe)
    def subscribe(self, message: Subscribe) -> None:
        (self.ctx.subscribe if message.wanted else self.ctx.unsubscribe)(message.topic)

    @hf.on(Publish)
    async def publish(self, message: Publish) -> float:
        for text in message.texts:
            await self.ctx.publish(message.topic, Seen(text))
        return self.ctx.now()

    @hf.on(Send)
    async def send(self, message: Send) -> str:
        for number in range(message.count):
            try:
                await message.to.send(Note(str(number)))
            except hf.SendError as error:
                return f"{number} {type(error).__name__}"
        return f"{message.count} sent"

    @hf.on(AskPort)
    async def ask_port(self, message: AskPort) -> int:
        return await self.port.ask(Where())

    @hf.on(Spawn)
    def spawn(self, message: Spawn) -> hf.ActorRef[Any]:
        return self.ctx.spawn(hf.start(Observer), message.name)

    @hf.on(StopChild)
    def stop_child(self, message: StopChild) -> None:
        if message.kill:
            message.ref.kill()
        else:
            message.ref.stop()

    @hf.on(Fail)
    def fail(self, message: Fail) -> int:
        raise ValueError(message.text)
