"""What can be put aside is the same for each kind of actor, however the message has come."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import pytest

import holdfast as hf

PLACES: dict[str, dict[str, Any]] = {
    "plain": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid(interval=3600.0)},
    "recorded in a process": {"recovery": hf.hybrid(interval=3600.0), "isolation": "process"},
    "protected": {"mechanism": hf.ftm.PBR()},
}
WAYS = ("ask", "tell", "send", "tell_after", "every", "pipe_to_self", "publish")


class Knock(hf.Message[str]):
    way: str


class Begin(hf.Message):
    way: str


class Open(hf.Message): ...


class Cancel(hf.Message): ...


class Seen(hf.Message[tuple[list[str], list[str]]]): ...


class Look(hf.Message[int]): ...


class Peer(hf.Actor):
    """Ends when it is told anything."""

    @hf.on(Begin)
    def end(self, message: Begin) -> None:
        raise ValueError(message.way)


class Door(hf.Actor):
    """Closed at first: who knocks waits."""

    peer: hf.Binding[Peer]

    def __init__(self) -> None:
        self.is_open = False
        self.seen: list[str] = []
        self.refused: list[str] = []
        self.waiting = 0
        self.timer: object = None

    def on_start(self, restored: bool) -> None:
        if not restored:
            self.put_aside("on_start")
            self.ctx.subscribe("/door")

    def on_exit(self, source: hf.ActorRef[hf.Actor], reason: object) -> None:
        self.put_aside("on_exit")

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: object, recovering: bool) -> None:
        self.put_aside("on_down")

    def put_aside(self, hook: str) -> None:
        with contextlib.suppress(hf.errors.StashError):
            self.ctx.stash()
            return
        self.refused.append(hook)

    @hf.on(Begin)
    def begin(self, message: Begin) -> None:
        match message.way:
            case "tell_after":
                self.timer = self.ctx.tell_after(0.0, Knock("tell_after"))
            case "every":
                self.timer = self.ctx.every(0.01, Knock("every"))
            case "pipe_to_self":
                self.ctx.pipe_to_self(asyncio.sleep(0.0), lambda _: Knock("pipe_to_self"))
            case _:
                self.ctx.trap_exits = True
                self.ctx.link(self.peer)
                self.ctx.monitor(self.peer)

    @hf.on(Cancel)
    def cancel(self, message: Cancel) -> None:
        self.timer.cancel()  # type: ignore[attr-defined]

    @hf.on(Knock)
    def knock(self, message: Knock) -> str:
        if not self.is_open:
            self.waiting += 1
            self.ctx.stash()
        else:
            self.seen.append(message.way)
        return message.way

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Look)
    def look(self, message: Look) -> int:
        return self.waiting

    @hf.on(Seen)
    def read(self, message: Seen) -> tuple[list[str], list[str]]:
        return self.seen, self.refused


async def started(system: hf.ActorSystem, place: str) -> tuple[hf.ActorRef[Peer], hf.ActorRef[Door]]:
    peer = await system.start(hf.child("peer", hf.start(Peer), restart="temporary"))
    bound = {"peer": peer.path}
    return peer, await system.start(hf.child("door", hf.start(Door), bindings=bound, **PLACES[place]))


async def until_waiting(door: hf.ActorRef[Door], count: int) -> None:
    async with asyncio.timeout(20.0):
        while await door.ask(Look()) < count:
            pass


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("way", WAYS)
async def test_a_message_is_put_aside_however_it_has_come(place: str, way: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=0) as system:
        _, door = await started(system, place)
        asked: asyncio.Future[str] | None = None
        match way:
            case "ask":
                asked = asyncio.ensure_future(door.ask(Knock(way), timeout=30.0))
            case "tell":
                door.tell(Knock(way))
            case "send":
                await door.send(Knock(way))
            case "publish":
                await system.publish("/door", Knock(way))
            case _:
                await door.send(Begin(way))
        await until_waiting(door, 1)
        if way in ("tell_after", "every"):
            await door.send(Cancel())  # What was put aside is not the timer's any more.
        waiting = await door.ask(Look())
        assert (await door.ask(Seen()))[0] == []
        await door.send(Open())
        seen, refused = await door.ask(Seen())
        assert seen == [way] * waiting
        assert refused == ["on_start"]
        if asked is not None:
            assert await asked == way


@pytest.mark.parametrize("place", PLACES)
async def test_what_is_no_message_is_not_put_aside(place: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        peer, door = await started(system, place)
        await door.send(Begin("watch"))
        await door.ask(Look())
        peer.tell(Begin("end"))
        async with asyncio.timeout(20.0):
            while len((await door.ask(Seen()))[1]) < 3:
                pass
        assert sorted((await door.ask(Seen()))[1]) == ["on_down", "on_exit", "on_start"]


@pytest.mark.parametrize("place", ["plain", "recorded"])
async def test_the_message_of_a_timer_that_was_put_aside_outlives_a_crash(place: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        _, door = await started(system, place)
        await door.send(Begin("tell_after"))
        await until_waiting(door, 1)
        door.kill()
        await until_waiting(door, 1)  # The plain one begins anew, and puts it aside once more.
        await door.send(Open())
        assert (await door.ask(Seen()))[0] == ["tell_after"]
