"""The dashboard on a port of its own: on the loopback, unless somebody says otherwise and knows what that means."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import os
import socket
from collections.abc import AsyncGenerator, Generator
from pathlib import Path
from typing import Final

import uvicorn

from ...actors.errors import SpecError
from .web_app import Dashboard

BACKLOG: Final = 64
STOPS: Final = 2
"""Seconds that requests in hand have to end when the dashboard closes."""


class _Server(uvicorn.Server):
    """A server that leaves the signals of the program alone."""

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None]:
        yield


@contextlib.asynccontextmanager
async def open_dashboard(
    app: Dashboard,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    certfile: str | os.PathLike[str] | None = None,
    keyfile: str | os.PathLike[str] | None = None,
    insecure: bool = False,
) -> AsyncGenerator[str]:
    """Serve a dashboard on a port of its own until the block ends; the block gets its URL.

    Args:
        app: made by `dashboard(...)`.
        host: the address to listen at.
        port: 0 takes a free one.
        certfile, keyfile: a certificate with its chain, and its key, in PEM: TLS is used then.
        insecure: allow an address that others can reach without TLS: they can read the token and all that is shown.

    Raises:
        SpecError: the address is in use, or none, or others can reach it and there is no TLS.
    """
    if not is_loopback(host) and certfile is None and not insecure:
        raise SpecError(
            "dashboard",
            f"others can reach {host}, and could read the token on the way: give certfile= and keyfile=, "
            "or insecure=True if something else protects the way",
        )
    _check_files(certfile, keyfile)
    sock = _listening(host, port)
    config = uvicorn.Config(
        app,
        log_config=None,
        log_level="critical",
        access_log=False,
        lifespan="off",
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=STOPS,
        ssl_certfile=certfile,
        ssl_keyfile=keyfile,
    )
    server = _Server(config)
    serving = asyncio.create_task(server.serve([sock]), name="holdfast dashboard server")
    name = f"[{host}]" if ":" in host else host
    try:
        yield f"{'http' if certfile is None else 'https'}://{name}:{sock.getsockname()[1]}/"
    finally:
        server.should_exit = True
        await app.close()
        await asyncio.wait((serving,))
        sock.close()
    serving.result()


def _check_files(*files: str | os.PathLike[str] | None) -> None:
    for file in files:
        if file is not None and not Path(file).is_file():
            raise SpecError("dashboard", f"there is no file {os.fspath(file)}: TLS needs a certificate and its key")


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((host, port))
        sock.listen(BACKLOG)
        sock.setblocking(False)
    except (OSError, OverflowError) as error:
        sock.close()
        raise SpecError("dashboard", f"{host}:{port}: {error}") from error
    return sock


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address.

    >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("::1"), is_loopback("0.0.0.0")
    (True, True, True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # A name: whoever has made it may lead it anywhere.
        return False
