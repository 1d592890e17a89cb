"""A buffer for the bytes that a connection has received and not yet decoded."""

from __future__ import annotations

import struct

LENGTH = struct.Struct("<I")
READ_BYTES = 256 * 1024


class FrameBuffer:
    """A buffer that grows for a large frame, and is small again after a huge one. `begin` to `end` is not taken in."""

    __slots__ = ("begin", "data", "end", "view")

    def __init__(self) -> None:
        self.begin = self.end = 0
        self._make(READ_BYTES)

    def _make(self, size: int) -> None:
        self.data = bytearray(size)
        self.view = memoryview(self.data)

    def space(self) -> memoryview:
        """Where the next bytes go, at least one."""
        if self.end == len(self.data):
            self._make_room()
        return self.view[self.end :]

    def _make_room(self) -> None:
        """Move what is left of a frame to the front, in a larger buffer if the frame needs it."""
        left = self.end - self.begin
        need = left + 1
        if left >= LENGTH.size:
            need = max(need, LENGTH.unpack_from(self.data, self.begin)[0] + LENGTH.size)
        size = len(self.data)
        while size < need:
            size *= 2
        old = self.view
        self._make(size)
        self.view[:left] = old[self.begin : self.end]
        self.begin, self.end = 0, left

    def taken(self, begin: int) -> None:
        """All before `begin` is taken in."""
        if begin == self.end:
            begin = self.end = 0
            if len(self.data) > READ_BYTES * 8:  # One huge frame shall not hold its memory for ever.
                self._make(READ_BYTES)
        self.begin = begin
