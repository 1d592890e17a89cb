"""Children of a journaled dynamic supervisor that come back later than it: bound to a desk, behind another, failing."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import holdfast as hf

PATH = "/app/guests/guest"
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "bounded": {"mailbox": hf.bounded(100)},
    "recorded": {"recovery": hf.hybrid()},
    "process": {"isolation": "process"},
    "recorded process": {"isolation": "process", "recovery": hf.hybrid()},
    "protected": {"recovery": hf.hybrid()},
}
RECORDED = ("recorded", "recorded process", "protected")
WAITS = ("bound", "turn", "backoff")
"""Why it does not start at once: nobody is at the desk, the one before it takes long, its first start fails."""


class Add(hf.Message[int]):
    """The answer is the sum of all that was added."""

    number: int


class Tell(hf.Message):
    """To the speaker: have the guest add this, and say nothing of it."""

    number: int


class Look(hf.Message[str]):
    """What an actor that looks for the guest finds."""


class Desk(hf.Actor):
    def __init__(self) -> None: ...


class Guest(hf.Actor):
    desk: hf.Binding[Desk]

    def __init__(self, fails: str = "") -> None:
        self.sum, self.fails = 0, fails

    def on_start(self, restored: bool) -> None:
        if self.fails and not os.path.exists(self.fails):
            raise OSError("not now")

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.sum += message.number
        return self.sum


class Slow(hf.Actor):
    """Its start ends when there is a file."""

    def __init__(self, file: str) -> None:
        self.file = file

    async def on_start(self, restored: bool) -> None:
        while not os.path.exists(self.file):
            await asyncio.sleep(0.01)

    @hf.on(Add)
    def add(self, message: Add) -> int:
        return message.number


class Starter(hf.Actor):
    """Asks for the start of "b" as soon as it is there itself, and says then what that one answers."""

    guests = "/app/house/guests"

    def __init__(self, file: str) -> None:
        self.file, self.answer = file, ""

    def on_start(self, restored: bool) -> None:
        self.ctx.tell_after(0.0, Tell(7))

    @hf.on(Tell)
    async def start(self, message: Tell) -> None:
        try:
            guests = self.ctx.find(self.guests, hf.supervision.DynamicSupervisor)
        except hf.errors.NoSuchActor:
            self.ctx.tell_after(0.01, message)
            return
        asked = guests.ask(hf.StartChild(id="b", args=(f"{self.file}.goes_on",)), 30.0)
        open(self.file, "a").close()
        try:
            ref: hf.ActorRef[Slow] = await asked
        except hf.errors.AlreadyStarted as there:
            ref = there.ref
        try:
            self.answer = str(await ref.ask(Add(message.number), 30.0))
        except hf.errors.ActorStopped as error:
            self.answer = str(error)

    @hf.on(Look)
    def look(self, message: Look) -> str:
        return self.answer


class Speaker(hf.Actor):
    def __init__(self) -> None: ...

    @hf.on(Tell)
    def tell(self, message: Tell) -> None:
        self.ctx.find(PATH, Guest).tell(Add(message.number))

    @hf.on(Add)
    async def ask(self, message: Add) -> int:
        return await self.ctx.find(PATH, Guest).ask(message, 30.0)

    @hf.on(Look)
    def look(self, message: Look) -> str:
        return self.ctx.find(PATH, Guest).path


def guest(kind: str, why: str, file: str) -> hf.ChildSpec[hf.Actor]:
    options: dict[str, Any] = KINDS[kind]
    if why == "bound":
        options = {**options, "bindings": {"desk": "/app/desk"}}
    elif why == "backoff":
        options = {**options, "backoff": hf.Backoff(initial=0.05, maximum=0.05)}
    return hf.child("guest", hf.start(Guest, file if why == "backoff" else ""), **options)


@asynccontextmanager
async def program(store: str | None) -> AsyncGenerator[hf.ActorSystem]:
    """Without the desk."""
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        await system.start(hf.child("speaker", hf.start(Speaker), recovery=hf.hybrid()))
        yield system


async def come(system: hf.ActorSystem) -> hf.ActorRef[hf.supervision.DynamicSupervisor]:
    """The supervisor, as soon as it knows whom it has; the starts of its children may go on."""
    start = asyncio.create_task(system.start(hf.dynamic("guests", journal=True, intensity=100)))
    with system.events() as events:
        while (await events.until(hf.events.ActorStarted)).address != "/app/guests":
            pass
    start.add_done_callback(asyncio.Task.exception)
    return system.ref("/app/guests", hf.supervision.DynamicSupervisor)


async def add(system: hf.ActorSystem, kind: str, why: str, file: str) -> None:
    """The guest, which has added five."""
    guests = system.ref("/app/guests", hf.supervision.DynamicSupervisor)
    open(file, "w").close()
    if why == "bound":
        await system.start(hf.child("desk", hf.start(Desk)))
    elif why == "turn":
        await guests.ask(hf.StartChild(hf.child("a", hf.start(Slow, file))))
    await guests.ask(hf.StartChild(guest(kind, why, file)))
    if kind == "protected":
        async with system.transaction() as change:
            change.protect(PATH, hf.ftm.PBR())
    assert await system.ref(PATH, Guest).ask(Add(5)) == 5
    os.unlink(file)


async def let_come(system: hf.ActorSystem, why: str, file: str) -> None:
    open(file, "w").close()
    if why == "bound":
        await system.start(hf.child("desk", hf.start(Desk)))


async def told(store: str, by: str, end: str) -> None:
    """The guest, who waits for the desk, is told something by nobody or by an actor, and the program ends."""
    async with program(store) as system:
        await come(system)
        if by == "nobody":
            await system.ref(PATH, Guest).send(Add(10))
        elif by == "tell":
            await system.ref("/app/speaker", Speaker).send(Tell(10))
            await system.ref("/app/speaker", Speaker).ask(Look())  # It has been told by now.
        else:
            asked = system.ref("/app/speaker", Speaker).ask(Add(10), 1.0)
            await asyncio.wait((asked,))
        if end == "kill":
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    from tests.supervision import expected_player

    asyncio.run(expected_player.told(*sys.argv[1:]))
