"""A connection: frames over a Unix socket pair, writes gathered per loop tick, bounded both ways."""

from __future__ import annotations

import asyncio
import itertools
import os
import socket
import struct
import sys
from collections.abc import Callable
from typing import Any, cast

import msgspec

from ...errors import BadMessage, HoldfastError, type_name
from ...kernel.codec import ARRAY, MAX_BYTES, array_head, encode_special, too_large, unencodable
from ...values.budget import MOST_CONTAINERS, check_containers
from .frames import (
    AnyFrame,
    Ask,
    Command,
    Failure,
    Forget,
    Frame,
    Launch,
    Migrate,
    Name,
    Offer,
    Publish,
    Record,
    Reply,
    Run,
    Tell,
    tagged,
)

LENGTH = struct.Struct("<I")
MAX_FRAME = MAX_BYTES + 64 * 1024
"""A frame's head is small; anything larger than this is not ours."""
READ_BYTES = 256 * 1024
PIECE_BYTES = 64 * 1024
"""Frames from this size on are written by themselves instead of being copied together."""
HIGH_BYTES = 4 * 1024 * 1024
"""Unsent bytes at which senders are told to wait."""

RUN_BYTES = 32 * 1024
"""Payload after which a run of messages is closed; a single one larger than an eighth of this is no part of a run."""
LARGE_ARRAY = 64 * 1024
"""Arrays from this size on are written from where they are instead of being copied into the frame."""
_RUN, _FORGET = tagged(Run), tagged(Forget)
MOST_NAMES = 4096
"""Names after which a sender forgets all that it has given: whoever was written to once is not remembered for ever."""
SMALL_BYTES = 1024 * 1024
"""The largest frame of a kind that carries no payload: what is in it may be anything, and takes many times the room."""
_CARRIERS: frozenset[type[Frame]] = frozenset((Tell, Ask, Reply, Failure, Offer, Publish, Record, Migrate))
_FROM_ROOT: frozenset[type[Frame]] = _CARRIERS | {Launch, Run, Command}
_CARRIER_TAGS, _FROM_ROOT_TAGS = (frozenset(tagged(kind)[1] for kind in kinds) for kinds in (_CARRIERS, _FROM_ROOT))
FRAMES_PER_TICK = 128
"""Frames of one guarded peer, each 4 KiB counting as one more, after which others come first."""

_DECODER: msgspec.msgpack.Decoder[AnyFrame] = msgspec.msgpack.Decoder(AnyFrame)


class BadFrame(HoldfastError, text="malformed frame: {problem}"):
    """The peer sent something that is no frame of ours: the connection is closed."""

    problem: str


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
        self._encoder = msgspec.msgpack.Encoder(enc_hook=self._encode_special)
        self._large: list[tuple[bytes, bytes, memoryview]] = []  # arrays of the frame in hand: mark, head, elements
        self._marks = itertools.count(int.from_bytes(os.urandom(15), "big"))
        self._run: list[bytes] = []  # messages that go out as one frame
        self._run_bytes = 0
        self._run_head = (0, 0, 0)  # address, type name, first number
        self._out: list[bytes] = []
        self._out_bytes = 0
        self._flushing = False
        self._paused = False
        self._waiters: list[asyncio.Future[None]] = []
        self._names_out: dict[str, int] = {}
        self._is_full = False  # so many names that they are forgotten behind the next frame
        self.kinds_out: dict[type, int] = {}  # the numbers of message types' names
        self._names_in: list[str] = []
        self._guarded, self._is_resting = guarded, False
        self._large_in = _CARRIER_TAGS if guarded else _FROM_ROOT_TAGS
        self._large_out = _FROM_ROOT if guarded else _CARRIERS
        self._buffer = bytearray(READ_BYTES)
        self._view = memoryview(self._buffer)
        self._begin = self._end = 0
        self.is_open = True

    # -- names ------------------------------------------------------------------------------------------------------

    def name_out(self, text: str) -> Name:
        """A name as the peer will understand it; text the first time."""
        number = self._names_out.get(text)
        if number is None:
            number = self._names_out[text] = len(self._names_out)
            self._is_full = number >= MOST_NAMES
            return text
        return number

    def _forget(self) -> None:
        """Give all names anew from the next frame on."""
        self._names_out.clear()
        self.kinds_out.clear()
        self._is_full = False
        self._out += (len(_FORGET).to_bytes(4, "little"), _FORGET)
        self._out_bytes += len(_FORGET)

    def forget_in(self) -> None:
        """The peer gives all its names anew."""
        self._names_in.clear()

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

    def rename_in(self, now: Callable[[str], str]) -> None:
        """Names that the peer gave mean other ones from now on."""
        self._names_in = list(map(now, self._names_in))

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
        if self._run:
            self._close_run()
        try:
            data = self._encoder.encode(frame)
        except Exception as error:  # Whatever a payload raises while it is encoded means that it cannot be.
            self._large.clear()
            payload = getattr(frame, "body", None)
            self._forget_names(frame)
            raise BadMessage(actor, type_name(type(payload)), unencodable(payload, error)) from error
        size = len(data)
        parts: list[Any] = [data]
        if self._large:
            parts = self._spliced(data)
            size = sum(map(len, parts))
        if size > SMALL_BYTES and (size > MAX_FRAME or type(frame) not in self._large_out):
            payload = getattr(frame, "body", None)
            self._forget_names(frame)
            raise BadMessage(actor, type_name(type(payload)), too_large(payload, size))
        self._out.append(size.to_bytes(4, "little"))
        self._out += parts
        self._out_bytes += size
        if self._is_full:
            self._forget()
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
        run = self._run
        if run and (self._run_bytes >= RUN_BYTES or self._run_head[:2] != (to, name)):
            self._close_run()
            run = self._run
        try:
            data = self._encoder.encode(message)
        except Exception as error:
            self._large.clear()
            raise BadMessage(actor, type_name(type(message)), unencodable(message, error)) from error
        size = len(data)
        if size * 8 > RUN_BYTES or self._large:
            self._large.clear()
            self.send(Tell(to, name, message, number), actor)
            return
        if not run:
            self._run_head = (to, name, number)
            if not self._flushing:
                self._flushing = True
                self._loop.call_soon(self.flush)
        run.append(data)
        self._run_bytes += size

    def _close_run(self) -> None:
        """Queue the run as a frame."""
        run, self._run = self._run, []
        count = len(run)
        array = (0xDC0000 | count).to_bytes(3, "big")
        data = b"".join((_RUN, *map(self._encoder.encode, self._run_head), array, *run))
        self._run_bytes = 0
        self._out.append(len(data).to_bytes(4, "little"))
        self._out.append(data)
        self._out_bytes += len(data)

    # -- large arrays -----------------------------------------------------------------------------------------------

    def _encode_special(self, value: Any) -> Any:
        """As the codec does it, but a large array is left out; a mark stands where it belongs."""
        numpy = sys.modules.get("numpy")
        if numpy is None or not isinstance(value, numpy.ndarray) or value.nbytes < LARGE_ARRAY:
            return encode_special(value)
        if not value.flags.c_contiguous or value.dtype.hasobject:
            return encode_special(value)
        mark = next(self._marks).to_bytes(16, "big")
        head = array_head(value)
        self._large.append((mark, head, memoryview(value.reshape(-1).view("u1"))))
        return msgspec.msgpack.Ext(ARRAY, mark)

    def _spliced(self, data: bytes) -> list[Any]:
        """A frame in parts, with the arrays where their marks were. (MessagePack counts items, not their bytes.)"""
        parts: list[Any] = []
        large, self._large = self._large, []
        begin = 0
        for mark, head, elements in large:
            at = data.index(mark, begin)
            size = len(head) + len(elements)
            parts += (data[begin : at - 2], b"\xc9" + size.to_bytes(4, "big") + bytes((ARRAY,)) + head, elements)
            begin = at + len(mark)
        parts.append(data[begin:])
        return parts

    def _forget_names(self, frame: Frame) -> None:
        """Names that this frame would have introduced are still unknown to the peer."""
        for field in frame.__struct_fields__:
            value = getattr(frame, field)
            if field in ("to", "name", "sender") and type(value) is str:
                self._names_out.pop(value, None)

    def flush(self) -> None:
        """Write what is queued, now; otherwise that happens at the end of the loop tick."""
        self._flushing = False
        if self._run:
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
        return not self._paused and self._out_bytes + self._run_bytes < HIGH_BYTES

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
        begin, end, view, buffer = self._begin, self._end, self._view, self._buffer
        unpack, decode, on_frame, taker = LENGTH.unpack_from, _DECODER.decode, self._on_frame, self.takers.get
        while end - begin >= 4:
            (size,) = unpack(buffer, begin)
            if size > SMALL_BYTES:
                self._check_large(begin + 4, end, size)
            if end - begin - 4 < size:
                break
            if left < 0:
                self._begin = begin
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
        if begin == end:
            begin = end = 0
            if len(buffer) > READ_BYTES * 8:  # One huge frame shall not hold its memory for ever.
                self._buffer = bytearray(READ_BYTES)
                self._view = memoryview(self._buffer)
        self._begin, self._end = begin, end
        if self._guarded and self._paused:
            self._rest()

    def _check_large(self, start: int, end: int, size: int) -> None:
        """See whether a frame may be so large, before there is memory for it."""
        if size > MAX_FRAME:
            raise BadFrame(f"{size} bytes are announced, the limit is {MAX_FRAME}")
        if end - start < 2:
            return  # Its kind has not come yet.
        head, tag = self._buffer[start], self._buffer[start + 1]
        if head & 0xF0 != 0x90 or tag not in self._large_in:
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
