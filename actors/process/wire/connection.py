"""A connection: frames over a Unix socket pair, writes gathered per loop tick, bounded both ways."""

from __future__ import annotations

import asyncio
import socket
import sys
from collections.abc import Callable
from typing import Any, cast

import msgspec

from ...errors import BadMessage, type_name
from ...kernel.codec import MAX_BYTES, too_large, unencodable
from ...values.budget import MOST_CONTAINERS, check_containers
from .frame_buffer import LENGTH, FrameBuffer
from .frame_encoder import FrameEncoder, OpenRun
from .frames import (
    AnyFrame,
    Ask,
    BadFrame,
    Command,
    Failure,
    Forget,
    Frame,
    Launch,
    Migrate,
    Offer,
    Publish,
    Record,
    Reply,
    Tell,
    TellRun,
    payload_of,
    tagged,
)
from .name_table import NameTable

MAX_FRAME = MAX_BYTES + 64 * 1024
"""A frame's head is small; anything larger than this is not ours."""
PIECE_BYTES = 64 * 1024
"""Frames from this size on are written by themselves instead of being copied together."""
HIGH_BYTES = 4 * 1024 * 1024
"""Unsent bytes at which senders are told to wait."""

RUN_BYTES = 32 * 1024
"""Payload after which a run of messages is closed; a single one larger than an eighth of this is no part of a run."""
_RUN, _FORGET = tagged(TellRun), tagged(Forget)
SMALL_BYTES = 1024 * 1024
"""The largest frame of a kind that carries no payload: what is in it may be anything, and takes many times the room."""
_CARRIERS: frozenset[type[Frame]] = frozenset((Tell, Ask, Reply, Failure, Offer, Publish, Record, Migrate))
_FROM_ROOT: frozenset[type[Frame]] = _CARRIERS | {Launch, TellRun, Command}
_CARRIER_TAGS, _FROM_ROOT_TAGS = (frozenset(tagged(kind)[1] for kind in kinds) for kinds in (_CARRIERS, _FROM_ROOT))
FRAMES_PER_TICK = 128
"""Frames of one guarded peer, each 4 KiB counting as one more, after which others come first."""

_DECODER: msgspec.msgpack.Decoder[AnyFrame] = msgspec.msgpack.Decoder(AnyFrame)


class Connection(asyncio.BufferedProtocol):
    """One end. `on_frame` gets each frame in the order it was sent; `on_lost` is called once, at the end.

    A frame's `body` lies in the buffer: it is decoded or copied before `on_frame` returns. Whatever a handler raises
    means that the peer said what cannot be: the connection ends. Of a `guarded` peer only so much is taken in at a
    time, nothing while it does not read itself, and no large frame of a kind that only we may send.
    """

    def __init__(
        self,
        on_frame: Callable[[AnyFrame], None],
        on_lost: Callable[[Exception | None], None],
        on_batch: Callable[[], None] | None = None,
        *,
        guarded: bool = False,
    ) -> None:
        self._on_frame, self._on_lost, self._on_batch = on_frame, on_lost, on_batch
        self.takers: dict[type[Frame], Callable[[Any], None]] = {}  # frames of these types do not go to `on_frame`
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self.names = NameTable()
        self._encoder = FrameEncoder()
        self._run = OpenRun()
        self._out: list[bytes] = []
        self._out_bytes = 0
        self._flushing = False
        self._paused = False
        self._waiters: list[asyncio.Future[None]] = []
        self._guarded, self._is_resting = guarded, False
        self._buffer = FrameBuffer()
        self.is_open = True

    # -- writing ----------------------------------------------------------------------------------------------------

    def send(self, frame: Frame, actor: str = "") -> None:
        """Queue a frame; all frames of one loop tick go out in one write.

        Raises:
            BadMessage: its payload cannot be coded or is too large; nothing is sent.
        """
        if not self.is_open:
            return
        if self._run.bodies:
            self._close_run()
        encoder = self._encoder
        try:
            data = encoder.encode(frame)
        except Exception as error:  # Whatever a payload raises while it is encoded means that it cannot be.
            encoder.large.clear()
            payload = payload_of(frame)
            self.names.withdraw(frame)
            raise BadMessage(actor, type_name(type(payload)), unencodable(payload, error)) from error
        size = len(data)
        parts: list[Any] = [data]
        if encoder.large:
            parts = encoder.spliced(data)
            size = sum(map(len, parts))
        if size > SMALL_BYTES and (size > MAX_FRAME or type(frame) not in (_FROM_ROOT if self._guarded else _CARRIERS)):
            payload = payload_of(frame)
            self.names.withdraw(frame)
            raise BadMessage(actor, type_name(type(payload)), too_large(payload, size))
        self._out.append(size.to_bytes(4, "little"))
        self._out += parts
        self._out_bytes += size
        if self.names.is_full:
            self.names.forget_given()
            self._out += (len(_FORGET).to_bytes(4, "little"), _FORGET)
            self._out_bytes += len(_FORGET)
        if not self._flushing:
            self._flushing = True
            self._loop.call_soon(self.flush)

    def tell(self, to: int, name: int, message: Any, number: int, actor: str) -> None:
        """Queue a plain message; those of one type to one address go out as one frame.

        Raises:
            BadMessage: it cannot be coded or is too large; nothing is sent.
        """
        if not self.is_open:
            return
        run, encoder = self._run, self._encoder
        if run.bodies and (run.size >= RUN_BYTES or run.head[:2] != (to, name)):
            self._close_run()
        try:
            data = encoder.encode(message)
        except Exception as error:
            encoder.large.clear()
            raise BadMessage(actor, type_name(type(message)), unencodable(message, error)) from error
        size = len(data)
        if size * 8 > RUN_BYTES or encoder.large:
            encoder.large.clear()
            self.send(Tell(to, name, message, number), actor)
            return
        if not run.bodies:
            run.head = (to, name, number)
            if not self._flushing:
                self._flushing = True
                self._loop.call_soon(self.flush)
        run.bodies.append(data)
        run.size += size

    def _close_run(self) -> None:
        """Queue the run as a frame."""
        run = self._run
        array = (0xDC0000 | len(run.bodies)).to_bytes(3, "big")
        data = b"".join((_RUN, *map(self._encoder.encode, run.head), array, *run.bodies))
        run.bodies, run.size = [], 0
        self._out.append(len(data).to_bytes(4, "little"))
        self._out.append(data)
        self._out_bytes += len(data)

    def flush(self) -> None:
        """Write what is queued, now; otherwise that happens at the end of the loop tick."""
        self._flushing = False
        if self._run.bodies:
            self._close_run()
        transport, out = self._transport, self._out
        if transport is None or not self.is_open or self._paused or not out:
            return
        self._out, size, self._out_bytes = [], self._out_bytes, 0
        if size < PIECE_BYTES or size < len(out) * PIECE_BYTES // 8:
            transport.write(b"".join(out))
        else:
            transport.writelines(out)  # Large frames are not copied together.
            # The stock loop of early releases of CPython 3.12 and 3.13 forgets there to pause us; here it looks.
            transport.set_write_buffer_limits(HIGH_BYTES)

    @property
    def has_room(self) -> bool:
        """Whether the peer keeps up."""
        return not self._paused and self._out_bytes + self._run.size < HIGH_BYTES

    def room(self) -> asyncio.Future[None] | None:
        """None while the peer keeps up; else a future that ends when it does again."""
        if self.has_room:
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
        if self._is_resting:
            self._loop.call_soon(self._go_on)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer.space()

    def buffer_updated(self, nbytes: int) -> None:
        self._buffer.end += nbytes
        self._take_in(FRAMES_PER_TICK if self._guarded else sys.maxsize)

    def _take_in(self, most: int) -> None:
        """Take in frames; `most`: how many small ones at once."""
        try:
            self._take_frames(most)
        except BadFrame as error:
            self.close(error)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            self.close(BadFrame(str(error)))
        except Exception as error:  # What a handler was told cannot be: else it would not raise.
            self.close(BadFrame(f"{type_name(type(error))}: {error}"))
        else:
            if self._on_batch is not None:
                self._on_batch()

    def _take_frames(self, left: int) -> None:
        buffer = self._buffer
        begin, end, view, data = buffer.begin, buffer.end, buffer.view, buffer.data
        unpack, decode, on_frame, taker = LENGTH.unpack_from, _DECODER.decode, self._on_frame, self.takers.get
        while end - begin >= 4:
            (size,) = unpack(data, begin)
            if size > SMALL_BYTES:
                self._check_large(begin + 4, end, size)
            if end - begin - 4 < size:
                break
            if left < 0:
                buffer.begin = begin
                self._rest()
                return
            start = begin + 4
            begin = start + size
            left -= 1 + (size >> 12)
            if size > MOST_CONTAINERS and self._guarded:
                check_containers(view[start:begin])
            frame = decode(view[start:begin])
            taker(type(frame), on_frame)(frame)
            if not self.is_open:
                return
        buffer.taken(begin)
        if self._guarded and self._paused:
            self._rest()

    def _check_large(self, start: int, end: int, size: int) -> None:
        """See whether a frame may be so large, before there is memory for it."""
        if size > MAX_FRAME:
            raise BadFrame(f"{size} bytes are announced, the limit is {MAX_FRAME}")
        if end - start < 2:
            return  # Its kind has not come yet.
        head, tag = self._buffer.data[start : start + 2]
        if head & 0xF0 != 0x90 or tag not in (_CARRIER_TAGS if self._guarded else _FROM_ROOT_TAGS):
            raise BadFrame(f"{size} bytes are announced for a frame without a payload, the limit is {SMALL_BYTES}")

    def _rest(self) -> None:
        """Take in nothing more until others had their turn, and the peer has read what it was sent."""
        if not self._is_resting and self._transport is not None:
            self._is_resting = True
            self._transport.pause_reading()
        if not self._paused:
            self._loop.call_soon(self._go_on)

    def _go_on(self) -> None:
        """Take in what was left."""
        if not self._is_resting or self._paused or not self.is_open or self._transport is None:
            return
        self._is_resting = False
        self._transport.resume_reading()
        self._take_in(FRAMES_PER_TICK)

    def eof_received(self) -> bool:
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        if self._is_resting and self.is_open:
            self._take_in(sys.maxsize)  # It may have said in the end why it has ended.
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
