"""The bytes of a connection: frames come out as they went in, however they are cut, and memory is given back."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.actors.process.wire.frame_buffer import LENGTH, READ_BYTES, FrameBuffer

SIZES = st.one_of(st.integers(0, 40), st.integers(READ_BYTES - 9, READ_BYTES + 9), st.just(READ_BYTES * 9))


@settings(max_examples=40, deadline=None)
@given(st.lists(SIZES, max_size=6), st.lists(st.integers(1, READ_BYTES * 2), min_size=1), st.data())
def test_frames_come_out_as_they_went_in(sizes: list[int], cuts: list[int], data: st.DataObject) -> None:
    frames = [bytes((number + 1,)) * size for number, size in enumerate(sizes)]
    coming = memoryview(b"".join(LENGTH.pack(len(frame)) + frame for frame in frames))
    buffer, got, count = FrameBuffer(), list[bytes](), 0
    while coming:
        space = buffer.space()
        assert len(space) > 0
        size = min(len(space), len(coming), cuts[count % len(cuts)])
        space[:size], coming = coming[:size], coming[size:]
        buffer.end += size
        count += 1
        begin = buffer.begin
        most = data.draw(st.integers(0, 3), label="frames that are taken in at once")
        while most and buffer.end - begin >= LENGTH.size:
            (length,) = LENGTH.unpack_from(buffer.data, begin)
            if buffer.end - begin - LENGTH.size < length:
                break
            got.append(bytes(buffer.view[begin + LENGTH.size : begin + LENGTH.size + length]))
            begin += LENGTH.size + length
            most -= 1
        buffer.taken(begin)
        largest = max((len(frame) for frame in frames), default=0)
        assert len(buffer.data) <= max(READ_BYTES, 2 * (largest + LENGTH.size) + 2 * sum(map(len, frames)))
        if buffer.begin == buffer.end:
            assert len(buffer.data) <= READ_BYTES * 8
    while buffer.end - buffer.begin >= LENGTH.size:
        (length,) = LENGTH.unpack_from(buffer.data, buffer.begin)
        begin = buffer.begin + LENGTH.size
        got.append(bytes(buffer.view[begin : begin + length]))
        buffer.taken(begin + length)
    assert got == frames
    assert buffer.begin == buffer.end == 0 or not frames
