"""Asks whoever leads a fleet, from outside of it: over a Unix socket, again and again until there is an answer.

A request is four bytes of length, and msgpack: its number, the name of the message, and the message. Its answer has the
number, who gives it, and the reply.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

import msgspec

from holdfast import Message

from .actors import FindPath, GetMap, LogRead, MapperState, NoWay, ReadLog
from .desk import ANSWERS, NO_WAY

REPLIES: dict[type[Message[Any]], Any] = {**ANSWERS, GetMap: MapperState, ReadLog: LogRead}
KINDS = {kind.__name__: kind for kind in REPLIES}
AGAIN = 0.02  # seconds until the next attempt to connect; nobody tells that somebody else leads
SILENT = 1.0  # seconds without any answer after which another connection is made
R = TypeVar("R")


class FarRequest(msgspec.Struct, array_like=True):
    """What goes to a node."""

    number: int
    kind: str
    message: bytes


class FarAnswer(msgspec.Struct, array_like=True):
    """What comes back, and from which process."""

    number: int
    pid: int
    reply: bytes


async def read_frame(reader: asyncio.StreamReader) -> bytes:
    """The next frame. Raises EOFError: there is none."""
    return await reader.readexactly(int.from_bytes(await reader.readexactly(4)))


def write_frame(writer: asyncio.StreamWriter, data: bytes) -> None:
    """Send a frame."""
    writer.write(len(data).to_bytes(4) + data)


@dataclass
class Waiting:
    """A request that is not answered yet, and when it was made, on the monotonic clock."""

    message: Message[Any]
    reply: asyncio.Future[bytes]
    made: float = field(default_factory=monotonic)


class FarFleet:
    """What asks and hears, as a ref to mapper, planner and reader of whoever leads.

    Attributes:
        leader: the process that has answered last; 0 before.
        struck: when something was killed whose end no answer has outlived yet; 0: nothing.

    Args:
        socket: where whoever leads listens.
        outlived: told how many seconds after `struck` a request was answered that was made later.
    """

    def __init__(self, socket: Path, outlived: Callable[[float], None]) -> None:
        self.leader, self.struck = 0, 0.0
        self._socket, self._outlived = socket, outlived
        self._numbers = itertools.count(1)
        self._waiting: dict[int, Waiting] = {}
        self._writer: asyncio.StreamWriter | None = None
        self._asking = asyncio.create_task(self._ask_on())

    def ask(self, message: Message[R], timeout: float) -> Awaitable[R]:
        """Ask whoever leads, as long as it takes; `timeout` is of each node's own asks."""
        number = next(self._numbers)
        waiting = self._waiting[number] = Waiting(message, asyncio.get_running_loop().create_future())
        self._send(number, waiting)
        return asyncio.ensure_future(self._answer(number, waiting))

    async def close(self) -> None:
        """Ask no more."""
        self._asking.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._asking

    async def _answer(self, number: int, waiting: Waiting) -> Any:
        try:
            reply = await waiting.reply
        finally:
            del self._waiting[number]
        message = waiting.message
        if reply == NO_WAY and isinstance(message, FindPath):
            raise NoWay(message.start, message.goal)
        return msgspec.msgpack.decode(reply, type=REPLIES[type(message)])

    def _send(self, number: int, waiting: Waiting) -> None:
        if self._writer is not None:
            request = FarRequest(number, type(waiting.message).__name__, msgspec.msgpack.encode(waiting.message))
            write_frame(self._writer, msgspec.msgpack.encode(request))

    async def _ask_on(self) -> None:
        while True:
            with contextlib.suppress(OSError, EOFError, TimeoutError):
                reader, self._writer = await asyncio.open_unix_connection(self._socket)
                try:
                    for number, waiting in [*self._waiting.items()]:
                        self._send(number, waiting)
                    while True:
                        async with asyncio.timeout(SILENT):
                            self._hear(msgspec.msgpack.decode(await read_frame(reader), type=FarAnswer))
                finally:
                    self._writer.close()
                    self._writer = None
            await asyncio.sleep(AGAIN)

    def _hear(self, answer: FarAnswer) -> None:
        self.leader = answer.pid
        waiting = self._waiting.get(answer.number)
        if waiting is None or waiting.reply.done():
            return
        waiting.reply.set_result(answer.reply)
        if self.struck and waiting.made > self.struck:
            seconds, self.struck = monotonic() - self.struck, 0.0
            self._outlived(seconds)
