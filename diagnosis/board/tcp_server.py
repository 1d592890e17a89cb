"""The board's TCP server: some clients at a time, each bounded in all it may send, hold and leave unread."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import socket
import ssl
from typing import Protocol

from ...actors.streams import Listener
from .board_frames import (
    Answer,
    AskMeasurements,
    AskSpecification,
    AuthenticateFrame,
    BadBoardFrame,
    BoardDecoder,
    Broadcast,
    DoneFrame,
    Frame,
    Measurements,
    RefusedFrame,
    SetDefaults,
    Specification,
    SwitchFrame,
    encode,
)
from .board_tls import check_token

MOST_CLIENTS = 8
"""Connections at a time; of those that hear no broadcasts, the longest silent one gives its seat to a new one."""
IDLE = 3600.0
"""Seconds a client may say nothing."""
PATIENCE = 5.0
"""Seconds that a frame may take once it has begun, either way."""
MOST_UNREAD = 64 * 1024
"""Bytes that a client may leave unread before it is told no more broadcasts."""
PIECE = 4096


class Device(Protocol):
    """What the server is in front of. Its channels are those that frames allow."""

    def specification(self) -> Specification:
        """Say what the board is and which channels it has."""
        ...

    def measure(self) -> Measurements:
        """What it measures now, in numbers that a frame can hold."""
        ...

    def switch(self, channel: int, on: bool) -> None:
        """Switch a channel; to do it twice is to do it once."""
        ...

    def set_defaults(self, channels: frozenset[int]) -> None:
        """Which channels are on after its own power-up."""
        ...


class BoardServer:
    """Serves a device.

    Args:
        device: what is behind it.
        host, port: where it listens.
        token: what a client has to say before anything else; None: nothing.
        tls: how connections are encrypted, from `server_tls`; None: they are not.
        insecure: whether a token is taken in clear from other machines.

    Raises:
        ValueError: the token would come over a network in clear.

    Attributes:
        delay: seconds by which each answer comes later than it could.
        is_mute: no answer comes, and no broadcast.
        is_deaf: new connections are closed at once.
    """

    def __init__(
        self,
        device: Device,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        *,
        tls: ssl.SSLContext | None = None,
        insecure: bool = False,
    ) -> None:
        check_token(host, token, is_encrypted=tls is not None, insecure=insecure)
        self._tls = tls
        self._device, self._host, self._port = device, host, port
        self._socket: socket.socket | None = None
        self._listener: Listener | None = None
        self._clients: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        self._silent: dict[asyncio.Task[None], None] = {}  # those that hear nothing either, the longest first
        self._token = token
        self.delay = 0.0
        self.is_mute = self.is_deaf = False

    @property
    def url(self) -> str:
        """Where it listens, for `Board`."""
        scheme = "tcp" if self._tls is None else "tls"
        return f"{scheme}://{f'[{self._host}]' if ':' in self._host else self._host}:{self._port}"

    async def start(self) -> None:
        """Listen. Raises OSError: the address cannot be had, or the system cannot watch one more connection."""
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        sock = self._socket = socket.create_server((self._host, self._port), family=family)
        sock.setblocking(False)
        self._listener = Listener(sock, self._serve, limit=PIECE, tls=self._tls)
        try:
            self._listener.start()
        except OSError:
            sock.close()
            raise
        self._port = sock.getsockname()[1]

    def abort(self) -> None:
        """End at once, without waiting for anybody."""
        if self._listener is not None:
            self._listener.stop()
        if self._socket is not None:
            self._socket.close()
        self.drop()

    async def close(self) -> None:
        """End, and wait until all connections have ended."""
        self.abort()
        while self._clients:
            await asyncio.wait(list(self._clients))

    def drop(self) -> None:
        """Cut all connections as if the cable were pulled: what is under way is lost."""
        for task, writer in self._clients.items():
            writer.transport.abort()
            task.cancel()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if self.is_deaf:
            writer.transport.abort()
            return
        self._clients[task] = writer
        client = _Client(self, self._device, reader, writer, self._token)
        try:
            if len(self._clients) > MOST_CLIENTS and not self._free_seat(task):
                await client.send(0, RefusedFrame(f"there are {MOST_CLIENTS} connections already"))
            else:
                await client.run()
        except (OSError, TimeoutError):
            pass  # It has gone, or says nothing, or does not listen: its connection ends, and that is all.
        except asyncio.CancelledError:
            pass  # We drop it: this task is its own, and nobody waits for its outcome.
        finally:
            del self._clients[task]
            self._silent.pop(task, None)
            writer.close()

    def _free_seat(self, newcomer: asyncio.Task[None]) -> bool:
        """Have the client go that has said and heard nothing for the longest time; False: all of them are at work."""
        task = next((one for one in self._silent if one is not newcomer), None)
        if task is None:
            return False
        del self._silent[task]
        self._clients[task].transport.abort()
        task.cancel()
        return True

    def note_silence(self, task: asyncio.Task[None], is_silent: bool) -> None:
        """A client says and hears nothing from now on, or does again."""
        self._silent.pop(task, None)
        if is_silent:
            self._silent[task] = None


class _Client:
    """One connection of a client, with what is read and written over it."""

    def __init__(
        self,
        server: BoardServer,
        device: Device,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        token: str | None,
    ) -> None:
        self._token, self._is_known = token, token is None
        self._server, self._device, self._reader, self._writer = server, device, reader, writer
        self._broadcasts: asyncio.Task[None] | None = None

    async def run(self) -> None:
        """From its first frame to its end."""
        decoder, clock = BoardDecoder(), asyncio.get_running_loop().time
        ends, task = clock() + IDLE, asyncio.current_task()
        assert task is not None
        try:
            while True:
                self._server.note_silence(task, self._broadcasts is None)
                async with asyncio.timeout_at(ends):
                    data = await self._reader.read(PIECE)
                self._server.note_silence(task, False)
                if not data:
                    return
                was_inside = decoder.is_inside
                decoder.feed(data)
                while (answered := await self._next(decoder)) is not None:
                    if not answered:
                        return
                    was_inside = False
                if not was_inside:  # A frame that comes byte by byte gets no more time with each.
                    ends = clock() + (PATIENCE if decoder.is_inside else IDLE)
        finally:
            await self._stop_broadcasts()

    async def _next(self, decoder: BoardDecoder) -> bool | None:
        """Answer the next frame. None: there is none yet; False: the connection must end."""
        try:
            taken = decoder.take()
            if taken is None:
                return None
            sequence, frame = taken
            answer = await self._answer(frame)
        except BadBoardFrame as error:
            await self._reply(error.sequence, RefusedFrame(error.why))
            return not error.is_fatal
        await self._reply(sequence, answer)
        return True

    async def _answer(self, frame: Frame) -> Answer:
        if not self._is_known and not isinstance(frame, AuthenticateFrame):
            return RefusedFrame("say the token first: Board(url, token=...)")
        match frame:
            case AuthenticateFrame(token):
                self._is_known = self._token is None or hmac.compare_digest(token.encode(), self._token.encode())
                if not self._is_known:
                    raise BadBoardFrame("this is not the token", is_fatal=True)
                return DoneFrame()
            case AskSpecification():
                return self._device.specification()
            case AskMeasurements():
                return self._device.measure()
            case SwitchFrame(channel, on):
                self._device.switch(channel, on)
                return DoneFrame()
            case SetDefaults(channels):
                self._device.set_defaults(channels)
                return DoneFrame()
            case Broadcast(milliseconds):
                await self._stop_broadcasts()
                if milliseconds:
                    self._broadcasts = asyncio.create_task(self._broadcast(milliseconds / 1000))
                return DoneFrame()
            case _:
                return RefusedFrame(f"{type(frame).__name__} is for a board to say")

    async def _reply(self, sequence: int, answer: Answer) -> None:
        if self._server.delay:
            await asyncio.sleep(self._server.delay)
        await self.send(sequence, answer)

    async def send(self, sequence: int, frame: Frame) -> None:
        """Send, and wait until the client takes it. Raises TimeoutError, OSError."""
        if self._server.is_mute:
            return
        if self._writer.transport.is_closing():
            raise ConnectionResetError("the client has gone")
        self._writer.write(encode(sequence, frame))
        async with asyncio.timeout(PATIENCE):
            await self._writer.drain()

    async def _broadcast(self, interval: float) -> None:
        with contextlib.suppress(OSError, TimeoutError):  # The reader's side ends the connection.
            while True:
                if self._writer.transport.get_write_buffer_size() <= MOST_UNREAD:
                    await self.send(0, self._device.measure())
                await asyncio.sleep(interval)

    async def _stop_broadcasts(self) -> None:
        if self._broadcasts is not None:
            self._broadcasts.cancel()
            await asyncio.wait((self._broadcasts,))
            self._broadcasts = None
