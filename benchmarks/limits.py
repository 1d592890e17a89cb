"""The raw limits: the least code that does each job at all, for an actor library to beat or to approach.

No addresses, no supervision, no deadlines, no types, nothing that could fail well. All of it assumes uvloop. Run as
a program this file is the other process of a limit, on an inherited socket:

    python benchmarks/limits.py echo FD
    python benchmarks/limits.py fork-server FD
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import socket
import sqlite3
import struct
import subprocess
import sys
from collections import deque
from collections.abc import AsyncGenerator, Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Any, Final, Self, cast

import msgpack
import uvloop

SOCKET_BUFFER: Final = 1 << 21
FIRST_BUFFER: Final = 1 << 14  # Small, or a new process would first fill pages with zeros.
FULL_BUFFER: Final = 1 << 18
JOINED_WRITE: Final = 16_384  # Up to here one copy into one buffer is cheaper than a vector write.
LENGTH: Final = struct.Struct("<I")
PID: Final = struct.Struct("<i")
ASK, TELL, COUNT = range(3)

pack: Callable[[object], bytes] = msgpack.Packer(autoreset=True, use_bin_type=True).pack
unpack: Callable[[object], Any] = msgpack.unpackb

# --- in one process -------------------------------------------------------------------------------------------------


class Mailbox:
    """Limit of tell, fan-out and ask: a deque, one `call_soon` per burst, a plain function as the handler."""

    __slots__ = ("_loop", "_opened", "_queue", "_ready", "left")

    def __init__(self, opened: Callable[[], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._opened = opened
        self._queue: deque[Any] = deque()
        self._ready = False
        self.left = 0  # messages until `opened` is called

    def handle(self, message: object) -> object:
        self.left -= 1
        if not self.left:
            self._opened()
        return message

    def tell(self, message: object) -> None:
        self._queue.append(message)
        if not self._ready:
            self._ready = True
            self._loop.call_soon(self._drain)

    def ask(self, message: object) -> asyncio.Future[Any]:
        reply = self._loop.create_future()
        self._queue.append((message, reply))
        if not self._ready:
            self._ready = True
            self._loop.call_soon(self._drain_asks)
        return reply

    def _drain(self) -> None:
        self._ready = False
        queue = self._queue
        take, handle = queue.popleft, self.handle
        for _ in range(len(queue)):
            handle(take())

    def _drain_asks(self) -> None:
        self._ready = False
        queue = self._queue
        for _ in range(len(queue)):
            message, reply = queue.popleft()
            reply.set_result(self.handle(message))


class Resident:
    """Limit of spawn and stop: a deque and a task that sleeps on a future until the first message."""

    __slots__ = ("_loop", "_queue", "_wake", "task")

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._queue: deque[Any] = deque()
        self._wake: asyncio.Future[None] | None = None
        self.task = self._loop.create_task(self._run())

    def tell(self, message: object) -> None:
        self._queue.append(message)
        if self._wake is not None:
            self._wake.set_result(None)
            self._wake = None

    async def handle(self, message: object) -> None:
        """Idle residents get none."""

    async def _run(self) -> None:
        while True:
            if not self._queue:
                self._wake = self._loop.create_future()
                await self._wake
            while self._queue:
                await self.handle(self._queue.popleft())


class Boom(Exception):
    """What a restarted object raises."""


class Fragile:
    """The state of a `Restarted`."""

    def __init__(self) -> None:
        self.handled = 0

    def handle(self, message: object) -> object:
        if message is Boom:
            raise Boom
        self.handled += 1
        return message


class Restarted:
    """Limit of a restart: the task keeps the error, builds a new object and a new task, and the queue stays."""

    __slots__ = ("_loop", "_queue", "_wake", "report", "task")

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._queue: deque[tuple[object, asyncio.Future[Any] | None]] = deque()
        self._wake: asyncio.Future[None] | None = None
        self.report: Exception | None = None
        self.task = self._loop.create_task(self._live(Fragile()))

    def tell(self, message: object) -> None:
        self._enqueue(message, None)

    def ask(self, message: object) -> asyncio.Future[Any]:
        reply = self._loop.create_future()
        self._enqueue(message, reply)
        return reply

    def _enqueue(self, message: object, reply: asyncio.Future[Any] | None) -> None:
        self._queue.append((message, reply))
        if self._wake is not None:
            self._wake.set_result(None)
            self._wake = None

    async def _live(self, state: Fragile) -> None:
        queue = self._queue
        try:
            while True:
                if not queue:
                    self._wake = self._loop.create_future()
                    await self._wake
                message, reply = queue.popleft()
                answer = state.handle(message)
                if reply is not None:
                    reply.set_result(answer)
        except Exception as error:
            self.report = error
            self.task = self._loop.create_task(self._live(Fragile()))


# --- between processes: length-prefixed msgpack over a Unix socket --------------------------------------------------


class Frames(asyncio.BufferedProtocol):
    """Frames in and out; what is sent within one tick of the loop leaves in one write."""

    def __init__(self) -> None:
        self._view = memoryview(bytearray(FIRST_BUFFER))
        self._read = self._written = 0
        self._out: list[bytes] = []
        self._loop = asyncio.get_running_loop()
        self.closed: asyncio.Future[None] = self._loop.create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(1 << 24)

    def connection_lost(self, exc: Exception | None) -> None:
        if not self.closed.done():
            self.closed.set_result(None)

    def received(self, frame: list[Any]) -> None:
        raise NotImplementedError

    def send(self, frame: tuple[object, ...]) -> None:
        body = pack(frame)
        out = self._out
        if not out:
            self._loop.call_soon(self._flush)
        out.append(LENGTH.pack(len(body)))
        out.append(body)

    def _flush(self) -> None:
        out, self._out = self._out, []
        if len(out) == 2 and len(out[1]) <= JOINED_WRITE:
            self.transport.write(out[0] + out[1])
        else:
            self.transport.writelines(out)

    def get_buffer(self, sizehint: int) -> memoryview:
        if self._written == len(self._view):
            self._make_room()
        return self._view[self._written :]

    def _make_room(self) -> None:
        """Move the unfinished frame to the front, of a larger buffer while that helps."""
        rest = self._view[self._read : self._written]
        needed = LENGTH.size + (LENGTH.unpack_from(rest)[0] if len(rest) >= LENGTH.size else 0)
        if max(needed, FULL_BUFFER) > len(self._view):
            self._view = memoryview(bytearray(max(1 << needed.bit_length(), 2 * len(self._view))))
            self._view[: len(rest)] = rest
        else:
            self._view[: len(rest)] = bytes(rest)
        self._read, self._written = 0, len(rest)

    def buffer_updated(self, nbytes: int) -> None:
        self._written += nbytes
        view, start, end = self._view, self._read, self._written
        while end - start >= LENGTH.size:
            stop = start + LENGTH.size + LENGTH.unpack_from(view, start)[0]
            if stop > end:
                break
            frame, start = view[start + LENGTH.size : stop], stop
            self.received(unpack(frame))
        if start == end:
            start = self._written = 0
        self._read = start


class EchoServer(Frames):
    """Answers what it is asked, counts what it is told."""

    told = 0

    def received(self, frame: list[Any]) -> None:
        ident, kind, payload = frame
        if kind == TELL:
            self.told += 1
        else:
            self.send((ident, self.told if kind == COUNT else payload))


class Client(Frames):
    """Limit of ask and tell across processes."""

    def __init__(self) -> None:
        super().__init__()
        self._pending: dict[int, asyncio.Future[Any]] = {}
        self._last = 0

    def tell(self, payload: object) -> None:
        self.send((0, TELL, payload))

    def ask(self, payload: object, kind: int = ASK) -> asyncio.Future[Any]:
        self._last += 1
        reply = self._pending[self._last] = self._loop.create_future()
        self.send((self._last, kind, payload))
        return reply

    def received(self, frame: list[Any]) -> None:
        self._pending.pop(frame[0]).set_result(frame[1])


async def connect(ours: socket.socket) -> Client:
    """Speak to an echo server at the other end of this socket."""
    _, client = await asyncio.get_running_loop().connect_accepted_socket(Client, ours)
    return client


def serve(theirs: socket.socket) -> None:
    """Be the echo server until the socket's end."""

    async def until_closed() -> None:
        _, server = await asyncio.get_running_loop().connect_accepted_socket(EchoServer, theirs)
        await server.closed

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(until_closed())


@contextlib.contextmanager
def limit_process(role: str) -> Generator[socket.socket, None, None]:
    """Start this file in a new process; it ends at the end of the socket given here, and is reaped."""
    ours, theirs = socket.socketpair()
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BUFFER)
    child = subprocess.Popen([sys.executable, __file__, role, str(theirs.fileno())], pass_fds=[theirs.fileno()])
    theirs.close()
    try:
        yield ours
    finally:
        ours.close()
        try:
            child.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


@contextlib.asynccontextmanager
async def echo_process() -> AsyncGenerator[Client, None]:
    """A client of an echo server in a process of its own."""
    with limit_process("echo") as ours:
        client = await connect(ours)
        await client.ask(b"")
        try:
            yield client
        finally:
            client.transport.abort()
            await client.closed


# --- on the disk ----------------------------------------------------------------------------------------------------


class GroupCommit:
    """Limit of durable admissions: an append-only file, one write and one fdatasync in a thread for all that came."""

    def __init__(self, path: str) -> None:
        self._loop = asyncio.get_running_loop()
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._thread = ThreadPoolExecutor(1)
        self._records: list[bytes] = []
        self._waiting: list[asyncio.Future[None]] = []
        self._busy = False

    def append(self, record: bytes) -> asyncio.Future[None]:
        accepted: asyncio.Future[None] = self._loop.create_future()
        self._records.append(record)
        self._waiting.append(accepted)
        if not self._busy:
            self._busy = True
            self._loop.call_soon(self._commit)
        return accepted

    def _commit(self) -> None:
        records, self._records = self._records, []
        waiting, self._waiting = self._waiting, []
        done = self._loop.run_in_executor(self._thread, self._sync, b"".join(records))
        done.add_done_callback(lambda _: self._synced(waiting))

    def _sync(self, data: bytes) -> None:
        os.write(self._fd, data)
        os.fdatasync(self._fd)

    def _synced(self, waiting: list[asyncio.Future[None]]) -> None:
        for accepted in waiting:
            accepted.set_result(None)
        if self._records:
            self._commit()
        elif not self._waiting:
            self._busy = False

    def close(self) -> None:
        self._thread.shutdown()
        os.close(self._fd)


# --- a process for each actor ---------------------------------------------------------------------------------------


def serve_forks(requests: socket.socket) -> None:
    """Be the fork server: everything imported, one thread, a child for each socket received."""
    gc.collect()
    gc.freeze()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # The kernel reaps.
    while True:
        message, fds, _, _ = socket.recv_fds(requests, 16, 1)
        if not message:
            return
        pid = os.fork()
        if pid == 0:
            requests.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            serve(socket.socket(fileno=fds[0]))
            os._exit(0)
        os.close(fds[0])
        requests.sendall(PID.pack(pid))


class ForkServer:
    """Limit of starting a process, and of starting it again after a SIGKILL."""

    def __init__(self) -> None:
        self._process = limit_process("fork-server")

    def __enter__(self) -> Self:
        self._requests = self._process.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.__exit__(kind, error, trace)

    def fork(self) -> tuple[int, socket.socket]:
        """A new echo server: its pid, and the socket to it."""
        ours, theirs = socket.socketpair()
        socket.send_fds(self._requests, [b"fork"], [theirs.fileno()])
        theirs.close()
        (pid,) = PID.unpack(self._requests.recv(PID.size))
        return pid, ours

    async def start(self) -> tuple[int, Client]:
        """A new echo server that has answered once."""
        pid, ours = self.fork()
        client = await connect(ours)
        await client.ask(b"")
        return pid, client

    async def recover(self, pid: int, client: Client) -> tuple[int, Client]:
        """Kill it, see it dead, and have another one answer; neither state nor mailbox come back."""
        os.kill(pid, signal.SIGKILL)
        await client.closed
        return await self.start()


FIRST: Final = """
import multiprocessing, operator, time
context = multiprocessing.get_context("forkserver")
ours, theirs = context.Pipe()
process = context.Process(target=operator.methodcaller("send_bytes", b"x"), args=(theirs,))
began = time.perf_counter()
process.start()
ours.recv_bytes()
print(time.perf_counter() - began)
process.join()
"""


def first_process() -> float:
    """Seconds until a first process of `multiprocessing` has answered, its fork server included; it imports nothing."""
    return float(subprocess.run([sys.executable, "-c", FIRST], stdout=subprocess.PIPE, check=True).stdout)


ROLES: Final[dict[str, Callable[[socket.socket], None]]] = {"echo": serve, "fork-server": serve_forks}

if __name__ == "__main__":
    ROLES[sys.argv[1]](socket.socket(fileno=int(sys.argv[2])))


class SqliteLoop:
    """Limit of recorded turns: what a tick has brought is handled, written in one row each, committed, answered."""

    def __init__(self, path: str, *, is_synced: bool) -> None:
        self._loop = asyncio.get_running_loop()
        self._db = sqlite3.connect(path, isolation_level=None)
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute(f"PRAGMA synchronous = {'FULL' if is_synced else 'NORMAL'}")
        self._db.execute("CREATE TABLE turns (id INTEGER PRIMARY KEY, message BLOB, reply BLOB)")
        self._waiting: list[tuple[bytes, asyncio.Future[bytes] | None]] = []
        self.told = 0

    def ask(self, message: bytes) -> asyncio.Future[bytes]:
        reply: asyncio.Future[bytes] = self._loop.create_future()
        self._take(message, reply)
        return reply

    def tell(self, message: bytes) -> None:
        self._take(message, None)

    def _take(self, message: bytes, reply: asyncio.Future[bytes] | None) -> None:
        if not self._waiting:
            self._loop.call_soon(self._tick)
        self._waiting.append((message, reply))

    def _tick(self) -> None:
        taken, self._waiting = self._waiting, []
        rows: list[tuple[bytes, bytes | None]] = []
        for message, reply in taken:
            self.told += 1
            rows.append((message, None if reply is None else message))
        self._db.execute("BEGIN")
        self._db.executemany("INSERT INTO turns VALUES (NULL, ?, ?)", rows)
        self._db.execute("COMMIT")
        for message, reply in taken:
            if reply is not None:
                reply.set_result(message)

    def close(self) -> None:
        self._db.close()
