"""What an actor has open is closed by its background task, whatever ends the life: the task's `finally` runs."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from typing import Literal

import pytest

import holdfast as hf


class Port(hf.Message[int]): ...


class Hang(hf.Message): ...


class Crash(hf.Message): ...


class Leave(hf.Message): ...


class Link(hf.Message[None]):
    path: str


class Door(hf.Actor):
    """Talks to one client."""

    def on_start(self, restored: bool) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._listening.setblocking(False)
        self.ctx.create_task(self._talk())

    async def _talk(self) -> None:
        try:
            self._talks, _ = await asyncio.get_running_loop().sock_accept(self._listening)
            self._talks.sendall(b"hello\n")
            await asyncio.Event().wait()
        finally:
            self._listening.close()
            self._talks.close()

    @hf.on(Port)
    def port(self, message: Port) -> int:
        number: int = self._listening.getsockname()[1]
        return number

    @hf.on(Link)
    def link(self, message: Link) -> None:
        self.ctx.link(self.ctx.find(message.path, hf.Actor))

    @hf.on(Hang)
    async def hang(self, message: Hang) -> None:
        await asyncio.Event().wait()

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("door")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop(hf.NORMAL)

    def on_stop(self, reason: hf.ExitReason) -> None:
        self._talks.sendall(b"bye")  # The task has it open still.


class Neighbour(hf.Actor):
    """Ends others with itself."""

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("neighbour")


async def kill(system: hf.ActorSystem, door: hf.ActorRef[Door]) -> None:
    door.kill()


async def kill_in_turn(system: hf.ActorSystem, door: hf.ActorRef[Door]) -> None:
    door.tell(Hang())
    while not (await system.get_status(door)).turn:
        await asyncio.sleep(0.01)
    door.kill()


async def stop(system: hf.ActorSystem, door: hf.ActorRef[Door]) -> None:
    door.stop()


async def terminate(system: hf.ActorSystem, door: hf.ActorRef[Door]) -> None:
    await system.stop(door)


async def crash(system: hf.ActorSystem, door: hf.ActorRef[Door]) -> None:
    door.tell(Crash())


async def leave(system: hf.ActorSystem, door: hf.ActorRef[Door]) -> None:
    door.tell(Leave())


async def untrapped_exit(system: hf.ActorSystem, door: hf.ActorRef[Door]) -> None:
    neighbour = await system.start(hf.child("neighbour", hf.start(Neighbour), restart="temporary"))
    await door.ask(Link(neighbour.path))
    neighbour.tell(Crash())


ENDS = {
    "kill": (kill, b""),
    "kill in a turn": (kill_in_turn, b""),
    "an EXIT that is not trapped": (untrapped_exit, b""),
    "stop": (stop, b"bye"),
    "terminate": (terminate, b"bye"),
    "crash": (crash, b"bye"),
    "ctx.stop": (leave, b"bye"),
}


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False) as running:
        yield running


@pytest.mark.parametrize("place", ["task", "process"])
@pytest.mark.parametrize("how", ENDS)
async def test_a_socket_is_closed_whatever_ends_its_actor(
    system: hf.ActorSystem, how: str, place: Literal["task", "process"]
) -> None:
    """In a process of its own a kill ends that, and the kernel closes it."""
    end, last_words = ENDS[how]
    door = await system.start(hf.child("door", hf.start(Door), restart="temporary", isolation=place))
    reader, writer = await asyncio.open_connection("127.0.0.1", await door.ask(Port()))
    assert await reader.readline() == b"hello\n"
    await end(system, door)
    async with asyncio.timeout(30):
        assert await reader.read() == last_words
    writer.close()
    await writer.wait_closed()
