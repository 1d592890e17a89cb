"""A program that can watch no more connections: it makes none, takes none, and goes on when that has passed."""

from __future__ import annotations

import asyncio
import socket
import sys

import uvloop

from holdfast.actors.streams import Listener, connect
from tests.faults.ledgers import be_bounded
from tests.faults.watches import wait_for_word


async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(await reader.read(1))
    await writer.drain()
    writer.close()


async def attempt(where: tuple[str, int]) -> None:
    try:
        reader, writer = await connect(where)
    except OSError as error:
        print(f"not connected: {error.strerror}", flush=True)
    else:
        writer.write(b"x")
        print(f"connected {(await reader.read(1)).decode()}", flush=True)
        writer.close()


def call(where: tuple[str, int]) -> bytes:
    """Connect without the loop."""
    with socket.create_connection(where, timeout=60.0) as sock:
        sock.sendall(b"y")
        try:
            return sock.recv(1)
        except ConnectionResetError:
            return b""


async def work() -> None:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        sock.setblocking(False)
        listener = Listener(sock, serve)
        listener.start()
        where = sock.getsockname()
        wait_for_word()
        await attempt(where)
        print(f"served {(await asyncio.to_thread(call, where)).decode() or 'nobody'}", flush=True)
        wait_for_word()
        await attempt(where)
        print(f"served {(await asyncio.to_thread(call, where)).decode() or 'nobody'}", flush=True)
        listener.stop()


def main() -> None:
    be_bounded()
    (uvloop.run if sys.argv[1] == "uvloop" else asyncio.run)(work())
