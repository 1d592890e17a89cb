"""The binary frames of the power board's protocol; anything else is refused.

A frame is, in network byte order: `HB`, version (1 byte), kind (1), sequence (2), size of the body (2), the body, and
the CRC-32 of all before it (4). An answer has the sequence of its request; what is broadcast has sequence 0.

A frame whose borders cannot be trusted ends the connection; one that is whole, and says what cannot be, is refused with
the reason, and the next one is read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from typing import Final, TypeAlias

import msgspec

from ...actors.errors import HoldfastError

CHANNELS: Final = 10
MAGIC: Final = b"HB"
VERSION: Final = 1
HEAD: Final = struct.Struct("!2sBBHH")
TAIL: Final = struct.Struct("!I")
LARGEST: Final = 1024
"""Bytes of a body."""
LONGEST_NAME: Final = 32
"""Bytes of a channel's name."""
LONGEST_TOKEN: Final = 128
"""Bytes of a token."""
LONGEST_REASON: Final = 200
"""Bytes of the reason of a refusal."""
FASTEST, SLOWEST = 10, 3_600_000
"""Milliseconds between two broadcasts, at least and at most; 0 is none."""


class BadBoardFrame(HoldfastError, text="bad frame: {why}"):
    """Bytes that are no frame, or a frame that says what cannot be.

    Attributes:
        sequence: of the frame; 0 if it is not known.
        is_fatal: where the next frame begins is not known.
    """

    why: str
    sequence: int = 0
    is_fatal: bool = False


class AskSpecification(msgspec.Struct, frozen=True):
    """Asks the board what it is and which channels it has."""


class AskMeasurements(msgspec.Struct, frozen=True):
    """What do you measure now?"""


class SwitchFrame(msgspec.Struct, frozen=True):
    """Switch a channel, 0 to 9, on or off."""

    channel: int
    on: bool


class Broadcast(msgspec.Struct, frozen=True):
    """Tell me the measurements every so many milliseconds; 0: no more."""

    milliseconds: int


class SetDefaults(msgspec.Struct, frozen=True):
    """The channels that are on after the board's own power-up, and no others."""

    channels: frozenset[int]


class AuthenticateFrame(msgspec.Struct, frozen=True):
    """Says the token, before anything else, to a board that has one."""

    token: str


class ChannelSpecification(msgspec.Struct, frozen=True):
    """A channel: what it is called, its voltage, and the current it may draw."""

    name: str
    millivolts: int
    milliamperes: int


class Specification(msgspec.Struct, frozen=True):
    """What the board is: ten channels, and those that are on after its power-up."""

    channels: tuple[ChannelSpecification, ...]
    defaults: frozenset[int] = frozenset()


class Reading(msgspec.Struct, frozen=True):
    """What one channel measures at the moment."""

    on: bool
    milliamperes: int
    millivolts: int


class Measurements(msgspec.Struct, frozen=True):
    """All ten channels, so many milliseconds after the board's power-up."""

    uptime_milliseconds: int
    channels: tuple[Reading, ...]


class DoneFrame(msgspec.Struct, frozen=True):
    """The request was carried out."""


class RefusedFrame(msgspec.Struct, frozen=True):
    """The request was not carried out."""

    why: str


Request: TypeAlias = AskSpecification | AskMeasurements | SwitchFrame | Broadcast | SetDefaults | AuthenticateFrame
Answer: TypeAlias = Specification | Measurements | DoneFrame | RefusedFrame
Frame: TypeAlias = Request | Answer

KINDS: Final[dict[int, type[Frame]]] = {
    0x01: AskSpecification,
    0x02: AskMeasurements,
    0x03: SwitchFrame,
    0x04: Broadcast,
    0x05: SetDefaults,
    0x06: AuthenticateFrame,
    0x81: Specification,
    0x82: Measurements,
    0x83: DoneFrame,
    0x84: RefusedFrame,
}
EMPTY: Final[dict[type[Frame], Frame]] = {
    AskSpecification: AskSpecification(),
    AskMeasurements: AskMeasurements(),
    DoneFrame: DoneFrame(),
}
NUMBERS: Final = {kind: number for number, kind in KINDS.items()}

_SWITCH = struct.Struct("!BB")
_MILLISECONDS = struct.Struct("!I")
_MASK = struct.Struct("!H")
_UPTIME = struct.Struct("!Q")
_READING = struct.Struct("!Bii")
_CHANNEL = struct.Struct("!IIB")


def encode(sequence: int, frame: Frame) -> bytes:
    """The bytes of a frame.

    Raises:
        BadFrame: it says what cannot be: a channel beyond the tenth, a number that does not fit, a name too long.
    """
    try:
        body = _body(frame)
        if len(body) > LARGEST:
            raise BadBoardFrame(f"the body has {len(body)} bytes, and {LARGEST} are allowed", sequence)
        head = HEAD.pack(MAGIC, VERSION, NUMBERS[type(frame)], sequence, len(body))
    except struct.error as error:
        raise BadBoardFrame(f"a number does not fit: {error}") from error
    return head + body + TAIL.pack(zlib.crc32(head + body))


class BoardDecoder:
    """Frames from a stream of bytes, however it is cut; it never keeps more than one frame and what came with it."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def is_inside(self) -> bool:
        """Whether a frame has begun and is not whole."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> None:
        """More of the stream; take all frames before the next piece."""
        self._buffer += data

    def take(self) -> tuple[int, Frame] | None:
        """The next frame and its sequence; None: it is not whole yet.

        Raises:
            BadFrame: unless it is fatal, the next call goes on with the next frame.
        """
        if not MAGIC.startswith(self._buffer[: len(MAGIC)]):
            raise BadBoardFrame("it does not begin as one", is_fatal=True)
        if len(self._buffer) < HEAD.size:
            return None
        _, version, number, sequence, size = HEAD.unpack_from(self._buffer)
        if version != VERSION:
            raise BadBoardFrame(f"it is of version {version}, and this is {VERSION}", sequence, is_fatal=True)
        if size > LARGEST:
            raise BadBoardFrame(f"the body has {size} bytes, and {LARGEST} are allowed", sequence, is_fatal=True)
        end = HEAD.size + size
        if len(self._buffer) < end + TAIL.size:
            return None
        whole = bytes(self._buffer[:end])
        if TAIL.unpack_from(self._buffer, end)[0] != zlib.crc32(whole):
            raise BadBoardFrame("its checksum is wrong", is_fatal=True)
        del self._buffer[: end + TAIL.size]
        return sequence, _decoded(number, sequence, whole[HEAD.size :])


def _decoded(number: int, sequence: int, body: bytes) -> Frame:
    kind = KINDS.get(number)
    if kind is None:
        raise BadBoardFrame(f"there is no kind 0x{number:02x}", sequence)
    try:
        frame = _frame(kind, body)
        again = _body(frame)  # Numbers that cannot be are found here, too.
    except (struct.error, UnicodeDecodeError, IndexError) as error:
        raise BadBoardFrame(f"the body of {kind.__name__} is wrong: {error}", sequence) from error
    except BadBoardFrame as error:
        raise BadBoardFrame(error.why, sequence) from error
    if again != body:
        raise BadBoardFrame(f"the body of {kind.__name__} holds more than it should", sequence)
    return frame


def _body(frame: Frame) -> bytes:
    match frame:
        case AskSpecification() | AskMeasurements() | DoneFrame():
            return b""
        case SwitchFrame(channel, on):
            return _SWITCH.pack(_channel(channel), on)
        case Broadcast(milliseconds):
            if milliseconds and not FASTEST <= milliseconds <= SLOWEST:
                raise BadBoardFrame(f"a broadcast comes every {FASTEST} to {SLOWEST} ms, or 0, not {milliseconds}")
            return _MILLISECONDS.pack(milliseconds)
        case SetDefaults(channels):
            return _MASK.pack(_mask(channels))
        case AuthenticateFrame(token):
            return _token(token)
        case Specification(channels, defaults):
            _ten(channels)
            parts = [_MASK.pack(_mask(defaults))]
            for one in channels:
                name = one.name.encode()
                if len(name) > LONGEST_NAME:
                    raise BadBoardFrame(f"a name has up to {LONGEST_NAME} bytes, {one.name!r} has {len(name)}")
                parts += [_CHANNEL.pack(one.millivolts, one.milliamperes, len(name)), name]
            return b"".join(parts)
        case Measurements(uptime, channels):
            _ten(channels)
            readings = (_READING.pack(one.on, one.milliamperes, one.millivolts) for one in channels)
            return _UPTIME.pack(uptime) + b"".join(readings)
        case RefusedFrame(why):
            return why.encode()[:LONGEST_REASON].decode(errors="ignore").encode()


def _frame(kind: type[Frame], body: bytes) -> Frame:
    """The frame of a body. What the body holds besides is found by coding the frame again."""
    if kind is SwitchFrame:
        channel, on = _SWITCH.unpack(body)
        return SwitchFrame(_channel(channel), _flag(on))
    if kind is Broadcast:
        return Broadcast(*_MILLISECONDS.unpack(body))
    if kind is SetDefaults:
        return SetDefaults(_channels(*_MASK.unpack(body)))
    if kind is AuthenticateFrame:
        return AuthenticateFrame(body.decode())
    if kind is Specification:
        return _specification(body)
    if kind is Measurements:
        readings = _READING.iter_unpack(body[_UPTIME.size :])
        channels = tuple(Reading(_flag(on), milliamperes, millivolts) for on, milliamperes, millivolts in readings)
        _ten(channels)
        return Measurements(_UPTIME.unpack_from(body)[0], channels)
    if kind is RefusedFrame:
        return RefusedFrame(body.decode())
    return EMPTY[kind]


def _specification(body: bytes) -> Specification:
    (mask,) = _MASK.unpack_from(body)
    channels: list[ChannelSpecification] = []
    place = _MASK.size
    for _ in range(CHANNELS):
        millivolts, milliamperes, size = _CHANNEL.unpack_from(body, place)
        place += _CHANNEL.size
        channels.append(ChannelSpecification(body[place : place + size].decode(), millivolts, milliamperes))
        place += size
    return Specification(tuple(channels), _channels(mask))


def _channel(number: int) -> int:
    if not 0 <= number < CHANNELS:
        raise BadBoardFrame(f"there is no channel {number}: they are 0 to {CHANNELS - 1}")
    return number


def _token(token: str) -> bytes:
    body = token.encode()
    if not 0 < len(body) <= LONGEST_TOKEN:
        raise BadBoardFrame(f"a token has 1 to {LONGEST_TOKEN} bytes, not {len(body)}")
    return body


def _flag(value: int) -> bool:
    if value > 1:
        raise BadBoardFrame(f"on is 1 and off is 0, not {value}")
    return bool(value)


def _mask(channels: Iterable[int]) -> int:
    return sum(1 << _channel(number) for number in channels)


def _channels(mask: int) -> frozenset[int]:
    return frozenset(_channel(number) for number in range(16) if mask >> number & 1)


def _ten(channels: tuple[object, ...]) -> None:
    if len(channels) != CHANNELS:
        raise BadBoardFrame(f"a board has {CHANNELS} channels, not {len(channels)}")
