"""The connection over a real socket pair: what is sent arrives whole and in order, what is no frame ends it."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncGenerator
from typing import Any

import msgspec
import pytest
import uvloop
from hypothesis import given, settings
from hypothesis import strategies as st

import holdfast as hf
from holdfast.actors.kernel.codec import MAX_BYTES
from holdfast.actors.process.wire import frames
from holdfast.actors.process.wire.connection import HIGH_BYTES, MAX_FRAME, Connection
from holdfast.actors.process.wire.frame_buffer import READ_BYTES
from holdfast.actors.process.wire.frames import BadFrame

LENGTH = struct.Struct("<I")
SECONDS = 20.0


class Blob(hf.Message):
    label: str
    data: bytes
    other: Any = None


class End:
    """One end: what came, and how it ended."""

    def __init__(self) -> None:
        self.frames: list[frames.AnyFrame] = []
        self.errors: list[Exception | None] = []
        self.changed = asyncio.Event()
        self.connection = Connection(self._on_frame, self._on_lost)

    def _on_frame(self, frame: frames.AnyFrame) -> None:
        if isinstance(frame, frames.Tell | frames.Command):  # as both sides do
            self.connection.names.from_wire(frame.to)
        if isinstance(frame, frames.Tell):
            frame.body = msgspec.Raw(bytes(frame.body))  # it lies in the buffer, which is used again
        self.frames.append(frame)
        self.changed.set()

    def _on_lost(self, error: Exception | None) -> None:
        self.errors.append(error)
        self.changed.set()

    async def until(self, is_so: Any) -> None:
        async with asyncio.timeout(SECONDS):
            while not is_so():
                self.changed.clear()
                await self.changed.wait()

    async def get(self, count: int) -> list[frames.AnyFrame]:
        await self.until(lambda: len(self.frames) >= count)
        return self.frames

    async def lost(self) -> Exception | None:
        await self.until(lambda: bool(self.errors))
        assert len(self.errors) == 1, "told once"
        return self.errors[0]


@contextlib.asynccontextmanager
async def pair() -> AsyncGenerator[tuple[End, End], None]:
    one, other = socket.socketpair()
    ends = End(), End()
    for end, sock in zip(ends, (one, other), strict=True):
        sock.setblocking(False)
        await end.connection.open(sock)
    try:
        yield ends
    finally:
        for end in ends:
            end.connection.close()
        await asyncio.gather(*(end.lost() for end in ends))
        await asyncio.sleep(0)  # the transports close their sockets


@contextlib.asynccontextmanager
async def against_raw() -> AsyncGenerator[tuple[End, socket.socket], None]:
    """An end, and a bare socket on the other side."""
    ours, raw = socket.socketpair()
    ours.setblocking(False)
    raw.setblocking(False)
    end = End()
    await end.connection.open(ours)
    try:
        yield end, raw
    finally:
        raw.close()
        end.connection.close()
        await end.lost()
        await asyncio.sleep(0)


def packed(frame: Any) -> bytes:
    data = msgspec.msgpack.encode(frame)
    return LENGTH.pack(len(data)) + data


def tell(text: str, data: bytes = b"", to: frames.Name = 0) -> frames.Tell:
    body: Any = Blob(text, data)
    return frames.Tell(to, "m:Blob", body)


def labels(found: list[frames.AnyFrame]) -> list[str]:
    return [msgspec.msgpack.decode(frame.body, type=Blob).label for frame in found]  # type: ignore[union-attr]


# -- whole and in order


async def test_frames_arrive_in_order_both_ways() -> None:
    async with pair() as (one, other):
        for end in (one, other):
            end.connection.send(tell("first", to="/app/a"))
            for number in range(500):
                end.connection.send(tell(str(number)))
        for end in (one, other):
            assert labels(await end.get(501)) == ["first", *map(str, range(500))]


async def test_one_tick_is_one_write() -> None:
    async with against_raw() as (end, raw):
        for _ in range(100):
            end.connection.send(frames.Beat())
        loop = asyncio.get_running_loop()
        first = await loop.sock_recv(raw, 1 << 20)
        assert first == packed(frames.Beat()) * 100


@pytest.mark.parametrize("size", [0, 1, READ_BYTES - 40, READ_BYTES, READ_BYTES + 1, 5_000_000, MAX_BYTES - 100])
async def test_large_frames_come_intact_between_small_ones(size: int) -> None:
    data = bytes(range(256)) * (size // 256) + bytes(size % 256)
    async with pair() as (one, other):
        one.connection.send(tell("before", to="/app/a"))
        one.connection.send(tell("large", data))
        one.connection.send(tell("after"))
        found = await other.get(3)
        assert labels(found) == ["before", "large", "after"]
        large: Any = found[1]
        assert msgspec.msgpack.decode(large.body, type=Blob).data == data


async def test_many_frames_across_the_edges_of_the_buffer() -> None:
    async with pair() as (one, other):
        one.connection.send(tell("0", to="/app/a"))
        for number in range(1, 60):
            one.connection.send(tell(str(number), bytes(number * 7919 % 60_000)))
        assert labels(await other.get(60)) == list(map(str, range(60)))


async def test_half_frames_byte_by_byte() -> None:
    data = packed(tell("slow", b"x" * 30, to="/app/a")) + packed(frames.Beat())
    async with against_raw() as (end, raw):
        loop = asyncio.get_running_loop()
        for at in range(len(data) - 1):
            await loop.sock_sendall(raw, data[at : at + 1])
            await asyncio.sleep(0)
        await end.get(1)
        assert len(end.frames) == 1
        await loop.sock_sendall(raw, data[-1:])
        assert isinstance((await end.get(2))[1], frames.Beat)


async def test_a_large_frame_in_pieces_between_which_the_loop_turns() -> None:
    data = packed(tell("large", bytes(3_000_000), to="/app/a"))
    async with against_raw() as (end, raw):
        loop = asyncio.get_running_loop()
        for at in range(0, len(data), 100_003):
            await loop.sock_sendall(raw, data[at : at + 100_003])
        assert labels(await end.get(1)) == ["large"]


async def test_the_buffer_of_a_large_frame_is_given_back() -> None:
    async with pair() as (one, other):
        one.connection.send(tell("large", bytes(MAX_BYTES - 1000), to="/app/a"))
        await other.get(1)
        one.connection.send(frames.Beat())
        await other.get(2)
        assert len(other.connection._buffer.data) == READ_BYTES


async def test_what_is_queued_leaves_before_an_orderly_close() -> None:
    async with pair() as (one, other):
        one.connection.send(tell("last words", bytes(1_000_000), to="/app/a"))
        one.connection.close()
        assert labels(await other.get(1)) == ["last words"]
        assert await other.lost() is None


# -- refused at the sender


async def test_a_frame_above_the_limit_is_refused_and_the_next_one_goes_through() -> None:
    async with pair() as (one, other):
        number = one.connection.names.to_wire("/app/new")
        with pytest.raises(hf.errors.BadMessage) as refused:
            one.connection.send(tell("huge", bytes(MAX_FRAME), to=number), "/app/new")
        assert "Blob" in str(refused.value)
        assert "field 'data'" in str(refused.value)
        assert str(MAX_BYTES) in str(refused.value)
        one.connection.send(tell("small", to=one.connection.names.to_wire("/app/new")))
        assert labels(await other.get(1)) == ["small"], "a name that was not sent is introduced again"


async def test_a_value_that_cannot_be_coded_is_refused_by_field() -> None:
    async with pair() as (one, other):
        body: Any = Blob("x", b"", object())
        with pytest.raises(hf.errors.BadMessage, match=r"Blob to /app/a: field 'other': a value of type object"):
            one.connection.send(frames.Tell("/app/a", "m:Blob", body), "/app/a")
        one.connection.send(frames.Beat())
        await other.get(1)
        assert isinstance(other.frames[0], frames.Beat), "nothing of the other one was sent"


# -- no frames


BROKEN = {
    "text that is no UTF-8": LENGTH.pack(10) + b"\x94\x01\x00\xa6\x00\x00\x00\x00\x00\x80",
    "nesting without end": LENGTH.pack(50_000) + b"\x94" + b"\x91" * 49_999,
    "2 GiB announced": LENGTH.pack(2**31) + b"x",
    "one byte above the limit announced": LENGTH.pack(MAX_FRAME + 1),
    "4 GiB announced": b"\xff\xff\xff\xff",
    "an empty frame": LENGTH.pack(0),
    "no MessagePack": LENGTH.pack(3) + b"\xc1\xc1\xc1",
    "an unknown kind": LENGTH.pack(2) + b"\x91\x63",
    "a map": packed({"kind": 1}),
    "too few fields": packed([1]),
    "too many fields": packed([10, 1]),
    "a field of the wrong type": packed([4, "id", "kind", "name", b""]),
    "a body that ends early": LENGTH.pack(5) + b"\x94\x01\x00\x00\x92",
    "rest behind the frame": LENGTH.pack(3) + b"\x91\x0a\x00",
    "an unknown name": packed(tell("x", to=0)),
    "a negative name": packed(tell("x", to="/app/a")) + packed(tell("x", to=-1)),
    "a name far off": packed(tell("x", to=2**62)),
}


@pytest.mark.parametrize("data", BROKEN.values(), ids=BROKEN.keys())
async def test_what_is_no_frame_closes_the_connection(data: bytes) -> None:
    async with against_raw() as (end, raw):
        await asyncio.get_running_loop().sock_sendall(raw, packed(frames.Beat()) + data + packed(frames.Beat()))
        assert isinstance(await end.lost(), BadFrame)
        assert isinstance(end.frames[0], frames.Beat), "what came before it counts"
        assert sum(isinstance(frame, frames.Beat) for frame in end.frames) == 1, "what comes behind it does not"
        assert len(end.connection._buffer.data) == READ_BYTES, "no memory for what was announced"
        end.connection.send(frames.Beat())  # to a closed connection: nothing happens


def broken_streams() -> st.SearchStrategy[bytes]:
    """Valid frames that somebody cut, swapped or scribbled in, and plain noise."""
    valid = [
        packed(tell("x", b"abc", to="/app/a")),
        packed(frames.Ask(1, "/app/a", "m:Blob", msgspec.Raw(b"\x90"), 1.0)),
        packed(frames.Reply(1, msgspec.Raw(b"\xc0"))),
        packed(frames.Command("/app/a", "stop", {"reason": {"exit": "Normal"}})),
        packed(frames.Beat()),
    ]
    row = st.lists(st.sampled_from(valid), min_size=1, max_size=6).map(b"".join)
    scribble = st.tuples(row, st.lists(st.tuples(st.integers(0, 200), st.integers(0, 255)), max_size=4)).map(_scribbled)
    return st.one_of(st.binary(max_size=400), row, scribble)


def _scribbled(what: tuple[bytes, list[tuple[int, int]]]) -> bytes:
    data = bytearray(what[0])
    for at, value in what[1]:
        data[at % len(data)] = value
    return bytes(data)


@settings(max_examples=300)
@given(data=broken_streams(), cut=st.integers(1, 64))
def test_random_streams_never_hang_or_break_the_loop(data: bytes, cut: int) -> None:
    async def check() -> None:
        problems: list[dict[str, Any]] = []
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: problems.append(context))
        async with against_raw() as (end, raw):
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                for at in range(0, len(data), cut):
                    await loop.sock_sendall(raw, data[at : at + cut])
            raw.shutdown(socket.SHUT_WR)
            error = await end.lost()
        assert error is None or isinstance(error, BadFrame | ConnectionError), error
        assert not problems

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as made:
        made.run(check())


# -- back-pressure


async def test_a_peer_that_does_not_read_holds_senders_up_and_nothing_grows() -> None:
    async with against_raw() as (end, raw):
        connection = end.connection
        assert connection.room() is None
        sent = 0
        while (room := connection.room()) is None:
            connection.send(tell(str(sent), bytes(100_000), to="/app/a" if sent == 0 else 0))
            sent += 1
            await asyncio.sleep(0)
            assert sent < 1000
        assert sent * 100_000 < 3 * HIGH_BYTES
        assert not room.done()
        loop = asyncio.get_running_loop()
        received = 0
        while received < sent * 100_000:
            received += len(await loop.sock_recv(raw, 1 << 20))
        async with asyncio.timeout(SECONDS):
            await room
        assert connection.room() is None


async def test_within_one_tick_too() -> None:
    async with against_raw() as (end, _):
        for number in range(100):
            end.connection.send(tell(str(number), bytes(100_000), to="/app/a" if number == 0 else 0))
        room = end.connection.room()
        assert room is not None
    await room  # whoever waits is let go when the connection ends


async def test_room_comes_back_when_the_peer_has_read() -> None:
    async with pair() as (one, other):
        for number in range(50):
            one.connection.send(tell(str(number), bytes(100_000), to="/app/a" if number == 0 else 0))
        room = one.connection.room()
        assert room is not None
        await other.get(50)
        async with asyncio.timeout(SECONDS):
            await room
