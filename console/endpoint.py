"""The control endpoint of a running system: a Unix socket for its user, to look at the system and to change it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import msgspec

from ..actors.control.orders_lane import answer_bytes
from ..actors.errors import HoldfastError
from ..actors.ordered import Ordered
from ..actors.process.wire.frame_buffer import LENGTH
from ..actors.streams import Listener
from ..actors.values import encode_value
from ..system.system import ActorSystem
from .claims import EndpointInUse, absolute, claimed, listen, remove
from .client_session import ClientSession
from .runtime_folder import socket_path
from .wire import (
    REQUEST,
    AnyRequest,
    BadRequest,
    ControlActor,
    ControlResponse,
    NotServed,
    body_size,
    check_user,
    failure,
    frame,
    peer_of,
)

MOST_CLIENTS = 32
"""Connections at a time; further ones are closed at once."""
IDLE = 600.0
"""Seconds a client may say nothing."""
PATIENCE = 10.0
"""Seconds that a frame may take once it has begun, either way."""
LINGER = 1.0
"""Seconds that a client gets to take the reason why its connection ends."""


@contextlib.asynccontextmanager
async def control_endpoint(
    system: ActorSystem, path: str | os.PathLike[str] | None = None
) -> AsyncGenerator[Path, None]:
    """Serve the control endpoint of a running system, for this user only, until the block ends.

    Without a path the system is found by its name: its socket is in `$XDG_RUNTIME_DIR/holdfast`, else in a private
    folder of this user below that for temporary files.

    The folder must be one that nobody else can write to (or keep everybody's files apart, as /tmp does). A socket that
    a dead process has left is replaced.

    Raises:
        EndpointInUse: a live process has it, there is something else, or the system cannot watch one more descriptor.
        UntrustedFile: others may write the folder.
    """
    async with _listening(system, path) as (where, _):
        yield where


@contextlib.asynccontextmanager
async def served(
    system: ActorSystem,
    path: str | os.PathLike[str] | None = None,
    *,
    entered: contextlib.AbstractAsyncContextManager[object] | None = None,
) -> AsyncGenerator[Path, None]:
    """Run a system with its control endpoint, which is there already while the program waits to lead.

    A program that stands by can be seen so: `holdfast ls` lists it, and commands are told who leads instead.

    Args:
        system: a system that was not entered yet.
        path: of the socket, as `control_endpoint` takes it.
        entered: what is entered to run the system, such as a `Service` with it; left out, the system itself.

    Raises:
        EndpointInUse, UntrustedFile: as `control_endpoint`, before anything is started.
    """
    async with _listening(system, path) as (where, endpoint), system if entered is None else entered:
        try:
            yield where
        finally:  # Before the tree ends: what a client has asked for and is not done is undone.
            await endpoint.close()


@contextlib.asynccontextmanager
async def _listening(
    system: ActorSystem, path: str | os.PathLike[str] | None
) -> AsyncGenerator[tuple[Path, Endpoint], None]:
    """The endpoint of a system while it serves, and where."""
    where = socket_path(system.name) if path is None else absolute(path)
    with claimed(where):
        sock, inode = listen(where)
        endpoint = Endpoint(system, os.geteuid())
        try:
            try:
                endpoint.listen(sock)
            except OSError as error:
                raise EndpointInUse(str(where), error.strerror or str(error)) from error
            yield where, endpoint
        finally:
            await endpoint.close()
            sock.close()
            remove(where, inode)


class Endpoint:
    """Serves many clients side by side; what one of them does wrong ends its own connection only."""

    def __init__(self, system: ActorSystem, uid: int) -> None:
        self._system, self._uid, self._since = system, uid, time.time()
        self._loop = asyncio.get_running_loop()
        self._clients: set[asyncio.Task[Any]] = set()
        self._listener: Listener | None = None
        self._turned_away: dict[socket.socket, asyncio.TimerHandle] = {}
        self._idle: dict[asyncio.Task[Any], None] = {}  # those that have asked for nothing, the longest first

    def listen(self, sock: socket.socket) -> None:
        """Serve whoever connects to a listening socket. Raises OSError: the system cannot watch one more."""
        listener = Listener(sock, self.serve, self._turn_away)
        listener.start()
        self._listener = listener

    def _turn_away(self, client: socket.socket, error: OSError) -> None:
        """Tell a client why it is not served; what it sends meanwhile is not read, and must not cut off our answer."""
        with contextlib.suppress(OSError):
            client.send(frame(failure(NotServed(error.strerror or str(error)))))
            client.shutdown(socket.SHUT_WR)
        self._turned_away[client] = self._loop.call_later(LINGER, self._let_go, client)

    def _let_go(self, client: socket.socket) -> None:
        self._turned_away.pop(client).cancel()
        client.close()

    async def close(self) -> None:
        """End all connections; what they have asked for and is not done is undone."""
        connecting = Ordered[asyncio.Task[None]]()
        if self._listener is not None:
            self._listener.stop()
            connecting = self._listener.connecting
        for client in list(self._turned_away):
            self._let_go(client)
        while tasks := {*self._clients, *connecting}:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection, from its first request to its end."""
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        session = ClientSession(self._system, self._since)
        try:
            check_user(peer_of(writer.get_extra_info("socket")).uid, self._uid)
            self._make_place()
            while (body := await self._next(task, reader)) is not None and await self._answer(
                session, body, reader, writer
            ):
                pass
        except (HoldfastError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            no = error if isinstance(error, HoldfastError) else BadRequest(str(error))
            with contextlib.suppress(OSError, TimeoutError):
                await part(reader, writer, no)
        except (OSError, TimeoutError):
            pass  # It has gone, or says nothing: its connection ends, and that is all.
        except asyncio.CancelledError:
            pass  # The endpoint closes: this task is its own, and nobody waits for its outcome.
        finally:
            self._clients.discard(task)
            writer.close()
            await session.close()

    def _make_place(self) -> None:
        """One more client: if there are too many, whoever has asked for nothing for the longest time has to go.

        Raises:
            BadRequest: all of them are at work.
        """
        if len(self._clients) <= MOST_CLIENTS:
            return
        if not self._idle:
            raise BadRequest(f"there are {MOST_CLIENTS} connections already")
        task = next(iter(self._idle))
        del self._idle[task]
        task.cancel()

    async def _next(self, task: asyncio.Task[Any], reader: asyncio.StreamReader) -> bytes | None:
        """The next request of a client, which may be told to go while it says nothing."""
        self._idle[task] = None
        try:
            return await read(reader)
        finally:
            self._idle.pop(task, None)

    async def _answer(
        self, session: ClientSession, body: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bool:
        """Carry out one request. If the client goes meanwhile it is cancelled, and with it undone: False."""
        work = asyncio.create_task(self._respond(session, REQUEST.decode(body)))
        try:
            await asyncio.sleep(0)
            if not work.done():  # Most are: in a busy loop each step that is not taken is a millisecond saved.
                await self._watch(work, reader)
        finally:
            is_over = work.done()
            work.cancel()
            await asyncio.wait((work,))
        if is_over:
            await write(writer, work.result())
        return is_over

    async def _watch(self, work: asyncio.Task[ControlResponse], reader: asyncio.StreamReader) -> None:
        """Wait until a request is carried out, or its client has gone.

        Raises:
            BadRequest: the client asks for more meanwhile.
        """
        more = asyncio.create_task(reader.read(1))
        try:
            await asyncio.wait((work, more), return_when=asyncio.FIRST_COMPLETED)
        finally:
            is_early = more.done() and more.result()
            more.cancel()  # Before the answer: the next request comes behind that.
            await asyncio.wait((more,))
        if is_early:
            raise BadRequest("it came before the one before it was answered")

    async def _respond(self, session: ClientSession, request: AnyRequest) -> ControlResponse:
        try:
            value = await session.carry_out(request)
            if isinstance(request, ControlActor):
                return ControlResponse(answer_bytes(value, request.path, request.verb))
            return ControlResponse(encode_value(value))
        except (asyncio.CancelledError, GeneratorExit):
            raise
        except BaseException as error:  # It is the client's to know: whatever a user's code raises ends nobody here.
            return failure(error)


async def read(reader: asyncio.StreamReader) -> bytes | None:
    """The next frame; None at the end.

    Raises:
        BadRequest: it is cut short, or too large. TimeoutError: the client says nothing, or not all of it.
    """
    async with asyncio.timeout(IDLE):
        first = await reader.read(1)
    if not first:
        return None
    try:
        async with asyncio.timeout(PATIENCE):
            head = first + await reader.readexactly(LENGTH.size - 1)
            return await reader.readexactly(body_size(head))
    except asyncio.IncompleteReadError as error:
        raise BadRequest("it is cut short") from error


async def part(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, error: HoldfastError) -> None:
    """Tell a client why its connection ends. What it has sent is read: else the kernel would cut off our answer."""
    await write(writer, failure(error))
    writer.write_eof()
    async with asyncio.timeout(LINGER):
        while await reader.read(64 * 1024):
            pass


async def write(writer: asyncio.StreamWriter, response: ControlResponse) -> None:
    """Answer. Raises TimeoutError: the client does not take it."""
    try:
        data = frame(response)
    except BadRequest as error:
        data = frame(failure(error))
    writer.write(data)
    async with asyncio.timeout(PATIENCE):
        await writer.drain()
