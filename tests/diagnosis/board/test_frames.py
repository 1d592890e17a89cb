"""The board's frames: what is said is heard, however the stream is cut, and nothing else is."""

import zlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from holdfast.diagnosis.board import BadBoardFrame, ChannelSpecification, Measurements, Reading, Specification
from holdfast.diagnosis.board.board_frames import (
    CHANNELS,
    HEAD,
    LARGEST,
    TAIL,
    AskMeasurements,
    AskSpecification,
    AuthenticateFrame,
    BoardDecoder,
    Broadcast,
    DoneFrame,
    Frame,
    RefusedFrame,
    SetDefaults,
    SwitchFrame,
    encode,
)

numbers = st.integers(0, CHANNELS - 1)
masks = st.frozensets(numbers)
unsigned, signed = st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1)
names = st.text(max_size=8)
frames: st.SearchStrategy[Frame] = st.one_of(
    st.builds(AskSpecification),
    st.builds(AskMeasurements),
    st.builds(DoneFrame),
    st.builds(AuthenticateFrame, st.text(min_size=1, max_size=30)),
    st.builds(SwitchFrame, numbers, st.booleans()),
    st.builds(Broadcast, st.one_of(st.just(0), st.integers(10, 3_600_000))),
    st.builds(SetDefaults, masks),
    st.builds(RefusedFrame, st.text(max_size=50)),
    st.builds(
        Specification,
        st.tuples(*[st.builds(ChannelSpecification, names, unsigned, unsigned)] * CHANNELS),
        masks,
    ),
    st.builds(
        Measurements,
        st.integers(0, 2**64 - 1),
        st.tuples(*[st.builds(Reading, st.booleans(), signed, signed)] * CHANNELS),
    ),
)
said = st.lists(st.tuples(st.integers(0, 0xFFFF), frames), max_size=5)


def heard(decoder: BoardDecoder) -> list[tuple[int, Frame]]:
    found: list[tuple[int, Frame]] = []
    while (taken := decoder.take()) is not None:
        found.append(taken)
    return found


@given(said, st.lists(st.integers(1, 200)))
def test_what_is_said_is_heard_however_it_is_cut(what: list[tuple[int, Frame]], sizes: list[int]) -> None:
    stream = b"".join(encode(sequence, frame) for sequence, frame in what)
    decoder, found = BoardDecoder(), list[tuple[int, Frame]]()
    for size in [*sizes, len(stream) + 1]:
        piece, stream = stream[:size], stream[size:]
        decoder.feed(piece)
        found += heard(decoder)
    assert found == what
    assert not decoder.is_inside


@given(said.filter(bool), st.data())
def test_one_flipped_bit_is_noticed(what: list[tuple[int, Frame]], data: st.DataObject) -> None:
    stream = bytearray(b"".join(encode(sequence, frame) for sequence, frame in what))
    bit = data.draw(st.integers(0, len(stream) * 8 - 1))
    stream[bit // 8] ^= 1 << bit % 8
    decoder, found = BoardDecoder(), list[tuple[int, Frame]]()
    decoder.feed(bytes(stream))
    try:
        found += heard(decoder)
    except BadBoardFrame:
        pass
    # A length that has grown makes the decoder wait for more; what it hears before is what was said.
    assert len(found) < len(what)
    assert found == what[: len(found)]


@given(st.binary(max_size=300))
def test_noise_is_refused_or_waited_out(noise: bytes) -> None:
    decoder, found, refused = BoardDecoder(), list[tuple[int, Frame]](), False
    decoder.feed(noise)
    try:
        found = heard(decoder)
    except BadBoardFrame:
        refused = True
    assert found == []
    # Only what may yet become a frame is waited for.
    assert refused or noise[:2] == b"HB"[: len(noise)]


def whole(kind: int, body: bytes, sequence: int = 7) -> bytes:
    """A frame whose borders and checksum are right."""
    head = HEAD.pack(b"HB", 1, kind, sequence, len(body))
    return head + body + TAIL.pack(zlib.crc32(head + body))


@given(st.integers(0, 255), st.binary(max_size=200))
@example(kind=4, body=b"\x007\x00\x00")  # more milliseconds than there may be
@example(kind=4, body=b"\0\0\0\x09")
@example(kind=3, body=b"\x0a\x01")
@example(kind=5, body=b"\x04\0")
def test_a_whole_frame_is_heard_exactly_or_refused_and_the_next_one_is_heard(kind: int, body: bytes) -> None:
    decoder = BoardDecoder()
    decoder.feed(whole(kind, body) + encode(8, DoneFrame()))
    taken, refused = None, None
    try:
        taken = decoder.take()
    except BadBoardFrame as error:
        refused = error
    assert (taken is None) is not (refused is None)
    assert refused is None or (refused.sequence, refused.is_fatal) == (7, False)
    assert taken is None or encode(*taken) == whole(kind, body)
    assert decoder.take() == (8, DoneFrame())


@pytest.mark.parametrize(
    ("data", "why", "is_fatal"),
    [
        (b"GET / HTTP/1.1\r\n", "does not begin as one", True),
        (HEAD.pack(b"HB", 2, 1, 0, 0) + bytes(4), "version 2", True),
        (HEAD.pack(b"HB", 1, 1, 0, LARGEST + 1), "1025 bytes", True),
        (whole(1, b"")[:-1] + b"\0", "checksum", True),
        (whole(0x7F, b""), "no kind 0x7f", False),
        (whole(3, bytes([10, 1])), "no channel 10", False),
        (whole(3, bytes([1, 2])), "not 2", False),
        (whole(3, bytes([1])), "SwitchFrame", False),
        (whole(1, b"x"), "holds more", False),
        (whole(4, bytes([0, 0, 0, 9])), "not 9", False),
        (whole(5, bytes([0b100, 0])), "no channel 10", False),
        (whole(0x82, bytes(8)), "10 channels, not 0", False),
    ],
)
def test_a_bad_frame_is_refused_with_the_reason(data: bytes, why: str, is_fatal: bool) -> None:
    decoder = BoardDecoder()
    decoder.feed(data)
    with pytest.raises(BadBoardFrame) as raised:
        decoder.take()
    assert why in str(raised.value)
    assert raised.value.is_fatal is is_fatal


@pytest.mark.parametrize(
    "frame",
    [
        SwitchFrame(10, True),
        SwitchFrame(-1, True),
        Broadcast(9),
        Broadcast(3_600_001),
        SetDefaults(frozenset({10})),
        Measurements(0, ()),
        Measurements(-1, (Reading(False, 0, 0),) * 10),
        Specification(()),
        Specification((ChannelSpecification("x" * 33, 0, 0),) * 10),
    ],
)
def test_what_cannot_be_is_not_said(frame: Frame) -> None:
    with pytest.raises(BadBoardFrame):
        encode(1, frame)
