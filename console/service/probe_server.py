"""A server for probes over HTTP, for programs that have no web server: Kubernetes asks, one line is answered."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import Final

from ...actors.errors import SpecError

MOST_BYTES: Final = 8192
"""Bytes that a request may have."""
MOST_PROBES: Final = 16
"""Requests at a time; the connection of a further one is closed at once."""
LONGEST: Final = 5.0
"""Seconds that one request may take, with its answer."""


class ProbeServer:
    """Answers GET requests, each on a connection of its own.

    Args:
        address: `HOST:PORT`, with `[...]` around an IPv6 address.
        answer: gives status and text for a path, or None if there is no such page.

    Raises:
        SpecError: the address is none.
    """

    def __init__(self, address: str, answer: Callable[[str], Awaitable[tuple[int, str] | None]]) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise SpecError("probes", f"must be HOST:PORT, such as 0.0.0.0:8080, not {address!r}")
        self._host, self.port = host.strip("[]"), int(port)
        self._answer = answer
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self) -> None:
        """Listen, at a free port if it is 0. Raises SpecError: somebody else has the address."""
        try:
            self._server = await asyncio.start_server(self._connected, self._host, self.port, limit=MOST_BYTES)
        except OSError as error:
            raise SpecError("probes", f"{self._host}:{self.port}: {error.strerror or error}") from error
        self.port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Answer nobody any more; whoever waits for an answer is cut off."""
        if self._server is None:
            return
        self._server.close()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._tasks) >= MOST_PROBES:
            writer.transport.abort()
            return
        task = asyncio.get_running_loop().create_task(self._serve(reader, writer), name="probe")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(LONGEST):
                head = await reader.readuntil(b"\r\n\r\n")
                status, text = await self._answered(head)
                body = text.encode() + b"\n"
                line = f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\nContent-Type: text/plain; charset=utf-8\r\n"
                writer.write(f"{line}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # Whoever asked has gone, or asks for what is no probe: the next one is answered again.
        finally:
            writer.transport.abort()

    async def _answered(self, head: bytes) -> tuple[int, str]:
        method, _, rest = head.partition(b"\r\n")[0].decode("latin-1").partition(" ")
        if method not in ("GET", "HEAD") or not rest.startswith("/"):
            return HTTPStatus.BAD_REQUEST, "GET /livez or /readyz"
        return await self._answer(rest.partition(" ")[0].partition("?")[0]) or (HTTPStatus.NOT_FOUND, "no such page")
