"""Connections are made to paths, numbers and names; a listener goes on when it could take nobody."""

from __future__ import annotations

import asyncio
import errno
import socket
from pathlib import Path
from typing import Any

import pytest

from holdfast.actors import streams
from holdfast.actors.streams import Listener, connect


async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(await reader.read(100))
    await writer.drain()
    writer.close()


async def said(address: Any) -> bytes:
    reader, writer = await connect(address)
    writer.write(b"hello")
    answer = await reader.read(100)
    writer.close()
    await writer.wait_closed()
    return answer


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
async def test_a_port_is_reached_by_number_and_by_name(host: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        sock.setblocking(False)
        listener = Listener(sock, echo)
        listener.start()
        assert await said((host, sock.getsockname()[1])) == b"hello"
        listener.stop()


async def test_a_path_is_reached_and_nobody_behind_one_is_told(tmp_path: Path) -> None:
    path = str(tmp_path / "s")
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(path)
        sock.listen()
        sock.setblocking(False)
        listener = Listener(sock, echo)
        listener.start()
        assert await said(path) == b"hello"
        listener.stop()
    with pytest.raises(ConnectionRefusedError):
        await connect(path)
    with pytest.raises(FileNotFoundError):
        await connect(f"{path}2")


async def test_a_listener_without_descriptors_looks_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "PAUSE", 0.01)
    failures = iter([errno.EMFILE, errno.ENFILE])

    class Short(socket.socket):
        def accept(self) -> Any:
            for number in failures:
                raise OSError(number, "none left")
            return super().accept()

    with Short(socket.AF_INET) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.listen()
        sock.setblocking(False)
        listener = Listener(sock, echo)
        listener.start()
        assert await said(sock.getsockname()) == b"hello"
        assert not list(failures)
        listener.stop()
