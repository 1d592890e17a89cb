"""Links between programs and servers that are slow, silent or broken: a small proxy for each server, in user space."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import Sequence

CHUNK = 64 << 10
"""Bytes that are passed on at once."""


class SlowLinks:
    """A proxy in front of each server, on ports of its own. All methods are for the loop that they run on.

    Attributes:
        delay: seconds until bytes arrive, each way.
        jitter: seconds more, drawn for each piece.
        rate: bytes a second of each connection; 0: no limit.
    """

    def __init__(self, seed: int) -> None:
        self.delay = self.jitter = 0.0
        self.rate = 0.0
        self.ports: list[int] = []
        self._random = random.Random(seed)
        self._listening: list[asyncio.Server] = []
        self._passing: set[asyncio.Task[None]] = set()
        self._open: set[asyncio.StreamWriter] = set()
        self._passes = {True: asyncio.Event(), False: asyncio.Event()}
        self.mend()

    async def start(self, servers: Sequence[int]) -> None:
        """Listen in front of the servers on these ports."""
        for port in servers:
            listening = await asyncio.start_server(lambda *ends, to=port: self._accept(to, *ends), "127.0.0.1", 0)
            self._listening.append(listening)
            self.ports.append(listening.sockets[0].getsockname()[1])

    def hush(self, *, up: bool = True, down: bool = True) -> None:
        """Pass nothing on, to the servers or from them, while all connections stay open."""
        for way, is_hushed in ((True, up), (False, down)):
            if is_hushed:
                self._passes[way].clear()

    def freeze(self) -> None:
        """Pass nothing on, for ever, over the connections that there are; new ones are as they should be."""
        self.hush()
        self._passes = {True: asyncio.Event(), False: asyncio.Event()}
        self.mend()

    def mend(self) -> None:
        """Pass everything on, and at once."""
        self.delay = self.jitter = self.rate = 0.0
        for passes in self._passes.values():
            passes.set()

    def sever(self) -> None:
        """Break all connections that there are."""
        for writer in self._open:
            writer.transport.abort()

    async def close(self) -> None:
        """End it."""
        for listening in self._listening:
            listening.close()
        self.sever()
        for task in self._passing:
            task.cancel()
        if self._passing:
            await asyncio.wait(self._passing)

    async def _accept(self, port: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._passing.add(task)
        task.add_done_callback(self._passing.discard)
        ends = [writer]
        self._open.add(writer)
        try:
            there, back = await asyncio.open_connection("127.0.0.1", port)
            ends.append(back)
            self._open.add(back)
            ways = [
                asyncio.ensure_future(self._pass(reader, back, up=True)),
                asyncio.ensure_future(self._pass(there, writer, up=False)),
            ]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.wait(ways)
        except (OSError, asyncio.CancelledError):
            pass  # The server is gone, or the test is over: whoever has connected sees its connection end.
        finally:
            for end in ends:
                self._open.discard(end)
                end.close()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, up: bool) -> None:
        """Pass on what comes, in order: what is on its way does not hold up what follows, unless there is a limit."""
        loop = asyncio.get_running_loop()
        under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(256)
        passes = self._passes[up]
        delivering = asyncio.ensure_future(self._deliver(under_way, writer, passes))
        with contextlib.suppress(OSError):
            try:
                while (data := await reader.read(CHUNK)) and not delivering.done():
                    late = self.delay + self._random.uniform(0, self.jitter)
                    await under_way.put((loop.time() + late, data))
                    if self.rate:
                        await asyncio.sleep(len(data) / self.rate)
                await passes.wait()  # Of the end nobody is told either.
            finally:
                delivering.cancel()
                await asyncio.wait([delivering])

    async def _deliver(
        self, under_way: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter, passes: asyncio.Event
    ) -> None:
        loop = asyncio.get_running_loop()
        with contextlib.suppress(OSError):
            while True:
                due, data = await under_way.get()
                await asyncio.sleep(due - loop.time())
                await passes.wait()
                writer.write(data)
                await writer.drain()
