"""A compromised worker, and those who must not suffer from it."""

from __future__ import annotations

import asyncio
import os
import select
import socket
import struct
import threading
from typing import Any

import holdfast as hf

LENGTH = struct.Struct("<I")


class Write(hf.Message[int]):
    """Write these bytes to the root, as they are, behind all that was said before."""

    data: bytes


class WriteLater(hf.Message[int]):
    """The same from a thread, again and again, while the actor's own code goes on."""

    data: bytes
    times: int


class SetPage(hf.Message[int]):
    """Write a number to the page that both sides share, and say that it has changed."""

    place: int
    number: int
    nudge: bytes


class BeDeaf(hf.Message[int]):
    """Read nothing any more; the answer still leaves."""


class Ping(hf.Message[int]): ...


class Add(hf.Message[int]):
    number: int = 1


class Anything(hf.Message[int]):
    value: Any = None


class Senders(hf.Message[list[str]]): ...


class Kill(hf.Message[int]):
    """Kill another actor; how its own process sees to it that one may is taken out first."""

    path: str
    in_turn: bool = False  # as an output of the turn, if the actor is recorded


class Terminate(hf.Message[int]):
    """The same with an order to whoever the port leads to: have the child `victim` terminated."""


class Evil(hf.Actor):
    """Does with its connection what it likes."""

    port: hf.Binding[hf.Actor]

    def _socket(self) -> socket.socket:
        connection = self.ctx._cell.node.ports.uplink.connection
        connection.flush()
        return connection._transport.get_extra_info("socket")

    @hf.on(Write)
    def write(self, message: Write) -> int:
        self._socket()
        self.ctx._cell.node.ports.uplink.connection._transport.write(message.data)
        return 1

    @hf.on(WriteLater)
    def write_later(self, message: WriteLater) -> int:
        own = os.dup(self._socket().fileno())

        def write() -> None:
            try:
                for _ in range(message.times):
                    left = memoryview(message.data)
                    while left:
                        select.select([], [own], [])
                        left = left[os.write(own, left) :]
            except OSError:
                return  # We are ended: that is as it should be.

        thread = threading.Thread(target=write, daemon=True)
        self.ctx._cell.node.loop.call_later(0.05, thread.start)  # Behind our answer.
        return 1

    @hf.on(SetPage)
    async def set_page(self, message: SetPage) -> int:
        page = self.ctx._cell.node.ports.uplink.page
        getattr(page, "_page", page)[message.place] = message.number
        self._socket()
        self.ctx._cell.node.ports.uplink.connection._transport.write(message.nudge)
        await asyncio.sleep(3600)
        return 1

    @hf.on(BeDeaf)
    def be_deaf(self, message: BeDeaf) -> int:
        uplink = self.ctx._cell.node.ports.uplink
        uplink.node.loop.call_later(0.05, uplink.connection._transport.pause_reading)
        return 1

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        return 1

    @hf.on(Kill)
    def kill(self, message: Kill) -> int:
        self._unbridle()
        victim = self.ctx.find(message.path, hf.Actor)
        if message.in_turn:
            victim.kill()
        else:
            self.ctx._cell.node.loop.call_later(0.05, victim._cell.obey, "kill", self.ctx.path)  # Behind our answer.
        return 1

    @hf.on(Terminate)
    def terminate(self, message: Terminate) -> int:
        self._unbridle()
        self.port.tell(hf.TerminateChild("victim"))
        return 1

    def _unbridle(self) -> None:
        self.ctx._cell.node.ports.uplink.require_granted = lambda path, order: None


class House(hf.Supervisor):
    """Names its child in its own `init`, and binds it there."""

    def __init__(self, kind: str, target: str) -> None:
        self.kind, self.target = kind, target

    def init(self) -> hf.Plan:
        lives: dict[str, dict[str, Any]] = {
            "plain": {},
            "recorded": {"recovery": hf.hybrid()},
            "protected": {"mechanism": hf.ftm.PBR()},
        }
        options = lives[self.kind]
        evil = hf.child("evil", hf.start(Evil), bindings={"port": self.target}, **options)
        return hf.Plan([evil], intensity=1000)


class Victim(hf.Actor):
    """Counts, and notes who has sent."""

    def __init__(self) -> None:
        self.total = 0
        self.senders: list[str] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        sender = self.ctx.sender
        self.senders.append("" if sender is None else sender.path)
        self.total += message.number
        return self.total

    @hf.on(Anything)
    def anything(self, message: Anything) -> int:
        return 0

    @hf.on(Senders, readonly=True)
    def who(self, message: Senders) -> list[str]:
        return self.senders
