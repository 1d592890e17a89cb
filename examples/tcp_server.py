"""A server of lines over TCP: nothing that was said to a user is lost with connections, crashes and restarts.

`python tcp_server.py`, then `nc localhost 8000` in two terminals: `hello ann` in one, `say ann Dear Ann` in the other.
Ann reads `1 Dear Ann`, at each connection until she says `ack 1`. With `PROCESSES=4` in the environment four processes
share the port.
"""

import asyncio
import os
from typing import Literal

import holdfast as hf

SLOWEST = 5.0
"""Seconds that a client may take to read what it is sent; one that is slower is let go."""
SILENT = 60.0
"""Seconds without a line from a client, after which it is let go; `ping` is enough."""
WINDOW = 100
"""So many lines a client is sent that it has not acknowledged; the others wait in the session."""
MOST = 10_000
"""Lines that wait for a user."""


class Full(hf.Refusal):
    """Too many lines wait for this user."""


class Post(hf.Message[None]):
    """From whoever writes, to the session of the reader."""

    text: str


class Attach(hf.Message[None]):
    """From a connection to the session of its user."""

    connection: hf.ActorRef[hf.Actor]


class Ack(hf.Message):
    """The client has read all up to this line."""

    number: int


class Out(hf.Message):
    """From a session to its connection."""

    line: str


class Leave(hf.Message):
    """From a session to its connection: another one has come."""


class Received(hf.Message):
    """From the client."""

    line: str


class HungUp(hf.Message):
    """The client has gone."""


class Silent(hf.Message):
    """Nothing has come for too long."""


class Session(hf.Actor):
    """What a user has not read. It is recorded, and outlives connections."""

    def __init__(self) -> None:
        self.unread: list[str] = []
        self.first = 1  # the number of the first one
        self.pushed = 0  # of the last one that this connection was given
        self.connection: hf.ActorRef[hf.Actor] | None = None
        self.next: hf.ActorRef[hf.Actor] | None = None  # is to follow when that one has ended

    @hf.on(Post)
    def post(self, message: Post) -> None:
        if len(self.unread) >= MOST:
            raise Full
        self.unread.append(message.text)
        self.push()

    @hf.on(Ack)
    def forget(self, message: Ack) -> None:
        read = max(0, min(message.number, self.pushed) + 1 - self.first)
        del self.unread[:read]
        self.first += read
        self.push()

    @hf.on(Attach)
    def attach(self, message: Attach) -> None:
        self.ctx.monitor(message.connection)
        older = self.connection if self.next is None else self.next
        if older is not None:
            older.tell(Leave())
        self.next = message.connection
        if self.connection is None:
            self.take_over()

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason, recovering: bool) -> None:
        if source == self.next:
            self.next = None
        if source == self.connection:
            self.take_over()

    def take_over(self) -> None:
        self.connection, self.next = self.next, None
        self.pushed = self.first - 1
        self.push()

    def push(self) -> None:
        if self.connection is not None:
            for text in self.unread[self.pushed + 1 - self.first : WINDOW]:
                self.pushed += 1
                self.connection.tell(Out(f"{self.pushed} {text}"))


class Connection(hf.Actor):
    """One socket. Its task reads, its turns write."""

    sessions: hf.Binding[hf.supervision.DynamicSupervisor]
    turn_timeout = SLOWEST

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer, self._handled = reader, writer, asyncio.Event()
        self._session: hf.ActorRef[Session] | None = None
        self._silence: hf.Timer | None = None

    async def on_start(self, restored: bool) -> None:
        self._silence = self.ctx.tell_after(SILENT, Silent())
        self.ctx.create_task(self._read(self.ctx.ref))
        await asyncio.sleep(0)  # It has begun, so its `finally` runs.

    async def _read(self, me: hf.ActorRef[hf.Actor]) -> None:
        """Read a line when the last one has been handled. Whatever ends this life, the socket is closed."""
        try:
            async for line in self._reader:
                self._handled.clear()
                me.tell(Received(line.decode(errors="replace").strip()))
                await self._handled.wait()
        except (OSError, ValueError):
            pass  # It has gone, or its line is too long.
        finally:
            self._writer.close()  # It may have to be sent first what was written.
            asyncio.get_running_loop().call_later(SLOWEST, self._writer.transport.abort)
        me.tell(HungUp())

    async def _write(self, line: str) -> None:
        """Wait until the client has room for it; `turn_timeout` says how long."""
        if not self._writer.is_closing():
            try:
                self._writer.write(f"{line}\n".encode())
                await self._writer.drain()
            except OSError:
                self.ctx.stop(hf.NORMAL)

    async def _session_of(self, name: str) -> hf.ActorRef[Session]:
        try:
            ref: hf.ActorRef[Session] = await self.sessions.ask(hf.StartChild(id=name))
        except hf.errors.AlreadyStarted as there:
            return there.ref
        return ref

    @hf.on(Received)
    async def obey(self, message: Received) -> None:
        assert self._silence is not None
        self._silence.cancel()
        self._silence = self.ctx.tell_after(SILENT, Silent())
        match message.line.split(maxsplit=2):
            case ["hello", name] if name.isalnum() and self._session is None:
                self._session = await self._session_of(name)
                await self._write(f"hello {name}")
                await self._session.ask(Attach(self.ctx.ref))
            case ["say", name, text] if name.isalnum():
                try:
                    await (await self._session_of(name)).ask(Post(text))
                except Full:
                    await self._write("full")
                else:
                    await self._write("said")
            case ["ack", number] if number.isdecimal() and self._session is not None:
                self._session.tell(Ack(int(number)))
            case ["ping"]:
                await self._write("pong")
            case _:
                await self._write("hello NAME, say NAME TEXT, ack NUMBER, or ping")
        self._handled.set()

    @hf.on(Out)
    async def out(self, message: Out) -> None:
        await self._write(message.line)

    @hf.on(Leave)
    async def leave(self, message: Leave) -> None:
        await self._write("bye: you are connected elsewhere")
        self.ctx.stop(hf.NORMAL)

    @hf.on(HungUp)
    def hung_up(self, message: HungUp) -> None:
        self.ctx.stop(hf.NORMAL)

    @hf.on(Silent)
    async def silent(self, message: Silent) -> None:
        await self._write("bye: you have said nothing for too long")
        self.ctx.stop(hf.NORMAL)

    def on_stop(self, reason: hf.ExitReason) -> None:
        if reason == hf.SHUTDOWN and not self._writer.is_closing():
            self._writer.write(b"bye: this server ends, connect again\n")


class Listener(hf.Actor):
    """Accepts connections, and starts an actor for each."""

    connections: hf.Binding[hf.supervision.DynamicSupervisor]

    def __init__(self, port: int) -> None:
        self.port = port

    async def on_start(self, restored: bool) -> None:
        server = await asyncio.start_server(self._accept, "127.0.0.1", self.port, reuse_port=True)
        self.ctx.create_task(self._close_at_the_end(server))

    async def _close_at_the_end(self, server: asyncio.Server) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            server.close()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await self.connections.ask(hf.StartChild(args=(reader, writer)))
        except hf.HoldfastError:  # There are as many as there may be, or this server ends.
            writer.close()


def door(number: int, port: int, isolation: Literal["task", "process"]) -> hf.ChildSpec:
    """A listener and its connections, which live in one process."""
    connection = hf.child(
        None,
        hf.Start(Connection),
        restart="temporary",
        mailbox=hf.bounded(2 * WINDOW, overflow="drop_newest"),
        bindings={"sessions": "/tcp/sessions"},
    )
    listener = hf.child(
        "listener", hf.start(Listener, port), bindings={"connections": f"/tcp/door-{number}/connections"}
    )
    return hf.supervisor(
        f"door-{number}",
        strategy="rest_for_one",
        isolation=isolation,
        children=[hf.dynamic("connections", template=connection, max_children=10_000), listener],
    )


def tree(port: int, processes: int = 1) -> list[hf.ChildSpec]:
    """The sessions first: they are there before the first client comes, and until the last one has gone."""
    session = hf.child(None, hf.start(Session), recovery=hf.hybrid())
    isolation: Literal["task", "process"] = "task" if processes == 1 else "process"
    return [
        hf.dynamic("sessions", template=session, journal=True),
        *(door(number, port, isolation) for number in range(processes)),
    ]


async def main() -> None:
    """Serve until a signal comes: `hf.run` then cancels this, and the system stops in order, the doors first."""
    port, processes = int(os.environ.get("PORT", "8000")), int(os.environ.get("PROCESSES", "1"))
    async with hf.ActorSystem("tcp", store=os.environ.get("STORE", "sqlite:tcp.db")) as system:
        for spec in tree(port, processes):
            await system.start(spec)
        await asyncio.Event().wait()


if __name__ == "__main__":
    hf.run(main())
