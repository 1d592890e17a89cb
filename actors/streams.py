"""Makes sure that the event loop can watch a connection before the loop is given it.

There may be no memory for one more, or `fs.epoll.max_user_watches` be reached. asyncio tells that to nobody who waits
for the connection, and uvloop ends the whole program.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import select
import socket
import ssl
from collections.abc import Awaitable, Callable
from typing import Any, Final

from .ordered import Ordered

AT_ONCE: Final = 32
"""Connections that are accepted before others have the loop."""
PAUSE: Final = 1.0
"""Seconds until a listener that could take nobody, for the system had no room, looks again."""
GREETING: Final = 5.0
"""Seconds in which two sides agree on how they encrypt."""
LIMIT: Final = 64 * 1024
"""Bytes that a reader holds before whoever writes has to wait."""

LOOPBACK_NAMES: Final = ("localhost", "ip6-localhost")

Address = str | tuple[str, int]
"""The path of a Unix socket, or a host and a port."""


def is_loopback(host: str) -> bool:
    """Whether a host can only be reached from its own machine.

    >>> is_loopback("127.0.0.1"), is_loopback("::1"), is_loopback("localhost"), is_loopback("10.0.0.7")
    (True, True, True, False)
    """
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() in LOOPBACK_NAMES


def check_can_watch(*fds: int) -> None:
    """Raise OSError if a loop cannot watch these descriptors beside all that is watched.

    It is not a reservation: another may take what is left.
    """
    with select.epoll() as scratch:
        for fd in fds:
            scratch.register(fd, select.EPOLLIN)


async def connect(
    address: Address, *, limit: int = LIMIT, tls: ssl.SSLContext | None = None
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect to whoever listens at an address; with `tls` what is sent is encrypted, and who is there must prove it.

    Raises:
        OSError: nobody takes connections there, or the system cannot watch one more.
    """
    problem: OSError = OSError(f"{address!r} has no address")
    for family, where in await _found(address):
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            check_can_watch(sock.fileno())
            await asyncio.get_running_loop().sock_connect(sock, where)
            if family == socket.AF_UNIX:
                return await asyncio.open_unix_connection(sock=sock, limit=limit)
            named = None if tls is None else address[0]
            return await asyncio.open_connection(sock=sock, limit=limit, ssl=tls, server_hostname=named)
        except OSError as error:
            sock.close()
            problem = error
        except BaseException:
            sock.close()
            raise
    raise problem


async def _found(address: Address) -> list[tuple[socket.AddressFamily, Any]]:
    """The places that an address may mean; only a name is looked up in a thread."""
    if isinstance(address, str):
        return [(socket.AF_UNIX, address)]
    host, port = address
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST)
    except socket.gaierror:
        found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return [(family, where) for family, _, _, _, where in found]


class Listener:
    """Takes the connections of a socket that listens, and has each served.

    Args:
        sock: it listens; it does not block. Whoever made it closes it.
        serve: has one connection, to its end; it runs as a task.
        turn_away: has a connection that cannot be watched, and closes it.
        tls: has connections encrypted; whoever has not agreed on that within `GREETING` seconds is not served.
    """

    def __init__(
        self,
        sock: socket.socket,
        serve: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
        turn_away: Callable[[socket.socket, OSError], None] = lambda client, error: client.close(),
        *,
        limit: int = LIMIT,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._sock, self._serve, self._turn_away, self._limit, self._tls = sock, serve, turn_away, limit, tls
        self._loop = asyncio.get_running_loop()
        self._pause: asyncio.TimerHandle | None = None
        self._is_watched = False
        self.connecting = Ordered[asyncio.Task[None]]()
        """Connections that are not served yet."""

    def start(self) -> None:
        """Raises OSError: the system cannot watch one more."""
        check_can_watch(self._sock.fileno())
        self._is_watched = True
        self._loop.add_reader(self._sock, self._accept)

    def stop(self) -> None:
        """Accept no more connections from now on."""
        if self._pause is not None:
            self._pause.cancel()
        if self._is_watched:
            self._is_watched = False
            self._loop.remove_reader(self._sock)
        for task in self.connecting:
            task.cancel()

    def _accept(self) -> None:
        for _ in range(AT_ONCE):
            try:
                client, _ = self._sock.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError:  # There are no descriptors, or no memory: whoever waits is served when there are.
                self._wait()
                return
            client.setblocking(False)
            try:
                check_can_watch(client.fileno())
            except OSError as error:
                self._turn_away(client, error)
                continue
            task = self._loop.create_task(self._connect(client))
            self.connecting.add(task)
            task.add_done_callback(self.connecting.discard)

    def _wait(self) -> None:
        if self._is_watched:
            self._is_watched = False
            self._loop.remove_reader(self._sock)
        self._pause = self._loop.call_later(PAUSE, self._go_on)

    def _go_on(self) -> None:
        try:
            self.start()
        except OSError:
            self._wait()

    async def _connect(self, client: socket.socket) -> None:
        reader = asyncio.StreamReader(self._limit, self._loop)
        with contextlib.ExitStack() as undo:
            undo.callback(client.close)
            with contextlib.suppress(OSError):  # It has gone.
                await self._loop.connect_accepted_socket(
                    lambda: asyncio.StreamReaderProtocol(reader, self._serve, self._loop),
                    client,
                    ssl=self._tls,
                    ssl_handshake_timeout=None if self._tls is None else GREETING,
                )
                undo.pop_all()
