"""A connection: frames over a Unix socket pair, writes gathered per loop tick, bounded both ways."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Callable
from typing import Any, cast

import msgspec

from ..codec import MAX_BYTES, encode_special, too_large, unencodable
from ..errors import BadMessage, HoldfastError, type_name
from .frames import AnyFrame, Frame, Name

LENGTH = struct.Struct("<I")
MAX_FRAME = MAX_BYTES + 64 * 1024
"""A frame's head is small; anything larger than this is not ours."""
READ_BYTES = 256 * 1024
PIECE_BYTES = 64 * 1024
"""Frames from this size on are written by themselves instead of being copied together."""
HIGH_BYTES = 4 * 1024 * 1024
"""Unsent bytes at which senders are told to wait."""

_DECODER: msgspec.msgpack.Decoder[AnyFrame] = msgspec.msgpack.Decoder(AnyFrame)


class BadFrame(HoldfastError):
    """The peer sent something that is no frame of ours: the connection is closed."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem

    def __str__(self) -> str:
        return f"malformed frame: {self.problem}"


class Connection(asyncio.BufferedProtocol):
    """One end. `on_frame` gets each frame in the order it was sent; `on_lost` is called once, at the end.

    A frame's `body` lies in the buffer: it is decoded or copied before `on_frame` returns.
    """

    def __init__(
        self,
        on_frame: Callable[[AnyFrame], None],
        on_lost: Callable[[Exception | None], None],
        on_batch: Callable[[], None] | None = None,
    ) -> None:
        self._on_frame, self._on_lost, self._on_batch = on_frame, on_lost, on_batch
        self.takers: dict[type[Frame], Callable[[Any], None]] = {}  # frames of these types do not go to `on_frame`
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._encoder = msgspec.msgpack.Encoder(enc_hook=encode_special)
        self._out: list[bytes] = []
        self._out_bytes = 0
        self._flushing = False
        self._paused = False
        self._waiters: list[asyncio.Future[None]] = []
        self._names_out: dict[str, int] = {}
        self._names_in: list[str] = []
        self._buffer = bytearray(READ_BYTES)
        self._view = memoryview(self._buffer)
        self._begin = self._end = 0
        self.is_open = True

    # -- names ------------------------------------------------------------------------------------------------------

    def name_out(self, text: str) -> Name:
        """A name as the peer will understand it; text the first time."""
        number = self._names_out.get(text)
        if number is None:
            self._names_out[text] = len(self._names_out)
            return text
        return number

    def name_in(self, name: Name) -> str:
        """A name the peer sent.

        Raises:
            BadFrame: a number it never gave.
        """
        if type(name) is str:
            self._names_in.append(name)
            return name
        number = cast("int", name)
        if not 0 <= number < len(self._names_in):
            raise BadFrame(f"name {number} was never introduced")
        return self._names_in[number]

    def number_in(self, name: Name) -> int:
        """The number of the name that `name_in` was given last: the peer uses it from now on."""
        return len(self._names_in) - 1 if type(name) is str else cast("int", name)

    # -- writing ----------------------------------------------------------------------------------------------------

    def send(self, frame: Frame, actor: str = "") -> None:
        """Queue a frame; all frames of one loop tick go out in one write.

        Raises:
            BadMessage: its payload cannot be coded or is too large; nothing is sent.
        """
        if not self.is_open:
            return
        try:
            data = self._encoder.encode(frame)
        except Exception as error:  # Whatever a payload raises while it is encoded means that it cannot be.
            payload = getattr(frame, "body", None)
            self._forget_names(frame)
            raise BadMessage(actor, type_name(type(payload)), unencodable(payload, error)) from error
        size = len(data)
        if size > MAX_FRAME:
            payload = getattr(frame, "body", None)
            self._forget_names(frame)
            raise BadMessage(actor, type_name(type(payload)), too_large(payload, size))
        self._out.append(size.to_bytes(4, "little"))
        self._out.append(data)
        self._out_bytes += size
        if not self._flushing:
            self._flushing = True
            self._loop.call_soon(self.flush)

    def _forget_names(self, frame: Frame) -> None:
        """Names that this frame would have introduced are still unknown to the peer."""
        for field in frame.__struct_fields__:
            value = getattr(frame, field)
            if field in ("to", "name", "sender") and type(value) is str:
                self._names_out.pop(value, None)

    def flush(self) -> None:
        """Write what is queued, now; otherwise that happens at the end of the loop tick."""
        self._flushing = False
        transport, out = self._transport, self._out
        if transport is None or not self.is_open or self._paused or not out:
            return
        self._out, size, self._out_bytes = [], self._out_bytes, 0
        if size < PIECE_BYTES or size < len(out) * PIECE_BYTES // 8:
            transport.write(b"".join(out))
        else:
            transport.writelines(out)  # Large frames are not copied together.

    def room(self) -> asyncio.Future[None] | None:
        """None while the peer keeps up; else a future that ends when it does again."""
        if not self._paused and self._out_bytes < HIGH_BYTES:
            return None
        future: asyncio.Future[None] = self._loop.create_future()
        self._waiters.append(future)
        return future

    # -- the protocol's side ----------------------------------------------------------------------------------------

    async def open(self, sock: socket.socket) -> None:
        """Speak over a connected socket, which is ours from now on. Frames may come before this returns."""
        await self._loop.connect_accepted_socket(lambda: self, sock)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(HIGH_BYTES)
        self.flush()

    def pause_writing(self) -> None:
        self._paused = True

    def resume_writing(self) -> None:
        self._paused = False
        self.flush()
        waiters, self._waiters = self._waiters, []
        for future in waiters:
            if not future.done():
                future.set_result(None)

    def get_buffer(self, sizehint: int) -> memoryview:
        if self._end == len(self._buffer):
            self._make_room()
        return self._view[self._end :]

    def _make_room(self) -> None:
        """Move what is left of a frame to the front, in a larger buffer if the frame needs it."""
        left = self._end - self._begin
        need = left + 1
        if left >= LENGTH.size:
            need = LENGTH.unpack_from(self._buffer, self._begin)[0] + LENGTH.size
        size = len(self._buffer)
        while size < need:
            size *= 2
        old = self._view
        self._buffer = bytearray(size)
        self._view = memoryview(self._buffer)
        self._view[:left] = old[self._begin : self._end]
        self._begin, self._end = 0, left

    def buffer_updated(self, nbytes: int) -> None:
        self._end += nbytes
        try:
            self._take_frames()
        except (BadFrame, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            self.close(error if isinstance(error, BadFrame) else BadFrame(str(error)))
            return
        if self._on_batch is not None:
            self._on_batch()

    def _take_frames(self) -> None:
        begin, end, view, buffer = self._begin, self._end, self._view, self._buffer
        unpack, decode, on_frame, taker = LENGTH.unpack_from, _DECODER.decode, self._on_frame, self.takers.get
        while end - begin >= 4:
            (size,) = unpack(buffer, begin)
            if size > MAX_FRAME:
                raise BadFrame(f"{size} bytes are announced, the limit is {MAX_FRAME}")
            if end - begin - 4 < size:
                break
            start = begin + 4
            begin = start + size
            frame = decode(view[start:begin])
            taker(type(frame), on_frame)(frame)
            if not self.is_open:
                return
        if begin == end:
            begin = end = 0
            if len(buffer) > READ_BYTES * 8:  # One huge frame shall not hold its memory for ever.
                self._buffer = bytearray(READ_BYTES)
                self._view = memoryview(self._buffer)
        self._begin, self._end = begin, end

    def eof_received(self) -> bool:
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        self._lose(exc)

    def close(self, error: Exception | None = None) -> None:
        """Send what is queued, then close; a second call changes nothing."""
        if self._transport is not None:
            if error is None:
                self.flush()
                self._transport.close()
            else:
                self._transport.abort()
        self._lose(error)

    def _lose(self, error: Exception | None) -> None:
        if not self.is_open:
            return
        self.is_open = False
        waiters, self._waiters = self._waiters, []
        for future in waiters:
            if not future.done():
                future.set_result(None)
        self._on_lost(error)
