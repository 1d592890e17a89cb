"""The control endpoint of a running system: a Unix socket for its user, to look at the system and to change it."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import socket
import stat
from collections.abc import AsyncGenerator, Generator
from pathlib import Path
from typing import Any

import msgspec

from ..actors.errors import HoldfastError
from ..actors.kernel.actor import Actor
from ..actors.ordered import Ordered
from ..actors.process.wire.frame_buffer import LENGTH
from ..actors.streams import Listener
from ..actors.values import encode_value
from ..system.history.authors import ACTING, OPERATOR
from ..system.history.pages import HistoryPage
from ..system.script import check_folders
from ..system.system import ActorSystem
from .trust import Needed, trusted_imports
from .wire import (
    REQUEST,
    AnyRequest,
    AskHistory,
    AskLives,
    AskQuarantined,
    AskWhy,
    BadRequest,
    ControlActor,
    ControlResponse,
    NotServed,
    Transact,
    Tree,
    Whereis,
    body_size,
    check_user,
    failure,
    frame,
    open_arg,
    peer_uid,
)

MOST_CLIENTS = 32
"""Connections at a time; further ones are closed at once."""
IDLE = 600.0
"""Seconds a client may say nothing."""
PATIENCE = 10.0
"""Seconds that a frame may take once it has begun, either way."""
LINGER = 1.0
"""Seconds that a client gets to take the reason why its connection ends."""
LONGEST = 3600.0
"""Seconds that one request may take."""
_TREE = {"add", "remove", "move", "reorder", "strategy", "intensity", "isolation", "stop", "start"}
_LIVING = {"bind", "unbind", "register", "unregister", "suspend", "resume", "replace_state", "replace_code"}
OPERATIONS = frozenset(_TREE | _LIVING | {"protect", "update"})
NAMED = {"update": ("mechanism", "role")}
"""What comes last is named."""


class EndpointInUse(HoldfastError, text="control endpoint {path}: {why}"):
    """A live process listens at this socket, it is no socket, or the system cannot watch one more."""

    path: str
    why: str


@contextlib.asynccontextmanager
async def control_endpoint(system: ActorSystem, path: str | os.PathLike[str]) -> AsyncGenerator[Path, None]:
    """Serve the control endpoint of a running system at `path`, for this user only, until the block ends.

    The folder must be one that nobody else can write to (or keep everybody's files apart, as /tmp does). A socket that
    a dead process has left is replaced.

    Raises:
        EndpointInUse: a live process has it, there is something else, or the system cannot watch one more descriptor.
        UntrustedFile: others may write the folder.
    """
    where = absolute(path)
    with claimed(where):
        sock, inode = listen(where)
        endpoint = Endpoint(system, os.geteuid())
        try:
            try:
                endpoint.listen(sock)
            except OSError as error:
                raise EndpointInUse(str(where), error.strerror or str(error)) from error
            yield where
        finally:
            await endpoint.close()
            sock.close()
            remove(where, inode)


@contextlib.contextmanager
def claimed(path: Path) -> Generator[None, None, None]:
    """Have the path for oneself: of several processes that find the socket of a dead one, one replaces it.

    The claim is a lock on a file beside the socket, which the kernel takes back when its holder dies, however.

    Raises:
        EndpointInUse: a live process has it. UntrustedFile: others may write the folder.
    """
    beside = path.with_name(f"{path.name}.lock")
    try:
        check_folders(path.parent, {os.geteuid()}, may_share=True)
        file = _locked(beside, str(path))
    except OSError as error:
        raise EndpointInUse(str(path), error.strerror or str(error)) from error
    try:
        yield
    finally:
        remove(beside, os.fstat(file).st_ino)
        os.close(file)


def _locked(beside: Path, path: str) -> int:
    while True:
        file = os.open(beside, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            ours, there = os.fstat(file), os.stat(beside, follow_symlinks=False)
        except BlockingIOError:
            os.close(file)
            raise EndpointInUse(path, "a live process listens there") from None
        except FileNotFoundError:  # Its last holder has just ended in good order.
            os.close(file)
            continue
        except BaseException:
            os.close(file)
            raise
        if (ours.st_dev, ours.st_ino) == (there.st_dev, there.st_ino):
            if not stat.S_ISREG(ours.st_mode) or ours.st_uid != os.geteuid() or ours.st_nlink != 1 or ours.st_size:
                os.close(file)
                raise EndpointInUse(path, f"{beside} is no lock of ours: an empty file of this user, with one name")
            return file
        os.close(file)


def absolute(path: str | os.PathLike[str]) -> Path:
    """The path from the root on: the folder in which we are may change."""
    return Path(path).absolute()


def remove(path: Path, inode: int) -> None:
    """Remove what we have made, unless something else is there by now."""
    try:
        if os.lstat(path).st_ino == inode:
            os.unlink(path)
    except FileNotFoundError:
        pass


def listen(path: Path) -> tuple[socket.socket, int]:
    """A listening socket at `path` that never had wider rights than 0600, and its inode."""
    clear(path)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    try:
        os.fchmod(sock.fileno(), 0o600)  # The file gets these rights, less the umask: there is no moment with more.
        before = os.umask(0o177)
        try:
            sock.bind(str(path))
        finally:
            os.umask(before)
        sock.listen(MOST_CLIENTS)
        return sock, os.lstat(path).st_ino
    except OSError as error:
        sock.close()
        raise EndpointInUse(str(path), error.strerror or str(error)) from error


def clear(path: Path) -> None:
    """Remove the socket that a dead process has left. Raises EndpointInUse if it is not that."""
    try:
        found = os.lstat(path)
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(found.st_mode) or found.st_uid != os.geteuid():
        raise EndpointInUse(str(path), "there is something else at this path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(PATIENCE)
        code = probe.connect_ex(str(path))
    if code != errno.ECONNREFUSED:
        raise EndpointInUse(str(path), "a live process listens there")
    remove(path, found.st_ino)


class Endpoint:
    """Serves many clients side by side; what one of them does wrong ends its own connection only."""

    def __init__(self, system: ActorSystem, uid: int) -> None:
        self._system, self._uid = system, uid
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
        try:
            check_user(peer_uid(writer.get_extra_info("socket")), self._uid)
            self._make_place()
            while (body := await self._next(task, reader)) is not None and await self._answer(body, reader, writer):
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

    async def _answer(self, body: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Carry out one request. If the client goes meanwhile it is cancelled, and with it undone: False."""
        request = REQUEST.decode(body)
        work = asyncio.create_task(self._respond(request))
        more = asyncio.create_task(reader.read(1))
        try:
            await asyncio.wait((work, more), return_when=asyncio.FIRST_COMPLETED)
        finally:
            is_early = more.done() and more.result()
            is_over = work.done()
            for task in (work, more):  # Before the answer: the next request comes behind that.
                task.cancel()
            await asyncio.wait((work, more))
        if is_early:
            raise BadRequest("it came before the one before it was answered")
        if is_over:
            await write(writer, work.result())
        return is_over

    async def _respond(self, request: AnyRequest) -> ControlResponse:
        try:
            ACTING.set(OPERATOR)  # In the context of the task of this request.
            async with asyncio.timeout(LONGEST):
                value = await self._do(request)
            return ControlResponse(encode_value(value))
        except Exception as error:  # It is the client's to know; a bug in a user's code must not end the endpoint.
            return failure(error)

    async def _do(self, request: AnyRequest) -> Any:
        system = self._system
        match request:
            case Tree():
                return system.tree()
            case Whereis():
                return system.whereis(request.name).path
            case ControlActor():
                return await self._control(request)
            case Transact():
                return await self._transact(request)
            case AskHistory():
                return msgspec.to_builtins(await self._history(request))
            case AskLives():
                return msgspec.to_builtins(system.lives(request.path))
            case AskWhy():
                return await system.why(request.path, timeout=min(request.timeout, LONGEST))
            case AskQuarantined():
                return msgspec.to_builtins(system.put_aside(request.path))

    async def _history(self, request: AskHistory) -> HistoryPage:
        """A page; its question comes from elsewhere, and is checked as everybody's is."""
        asked = request.question
        page = self._system.history(
            asked.path, kinds=asked.kinds, since=asked.since, until=asked.until, after=asked.after, limit=asked.limit
        )
        if page.events or not request.wait:
            return page
        after, wait = page.next, min(request.wait, LONGEST)
        return await self._system.follow_history(asked.path, kinds=asked.kinds, after=after, timeout=wait)

    async def _control(self, request: ControlActor) -> Any:
        system, timeout = self._system, min(request.timeout, LONGEST)
        ref = system.ref(request.path, Actor)
        with trusted_imports(system._node, Needed(request.script, request.args)):
            args = [open_arg(arg) for arg in request.args]
        value = await getattr(system, request.verb)(ref, *args, timeout=timeout)
        return str(value) if request.verb == "terminate" else value

    async def _transact(self, request: Transact) -> Any:
        timeout = min(request.timeout, LONGEST)
        everything = [arg for _, args in request.operations for arg in args]
        with trusted_imports(self._system._node, Needed(request.script, everything)):
            operations = [(verb, [open_arg(arg) for arg in args]) for verb, args in request.operations]
        async with self._system.transaction(dry_run=request.dry_run, timeout=timeout) as change:
            for verb, args in operations:
                if verb not in OPERATIONS:
                    raise BadRequest(f"there is no operation {verb!r}")
                named = NAMED.get(verb, ())
                at = len(args) - len(named)
                if at < 0:
                    raise BadRequest(f"{verb} lacks {', '.join(named[at:])}")
                getattr(change, verb)(*args[:at], **dict(zip(named, args[at:], strict=True)))
        steps = [(step.number, step.verb, step.target, step.text) for step in change.steps]
        return {"steps": steps, "difference": list(change.difference)}


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
