"""Frames as bytes: large arrays stay where they are, and are written between the parts of their frame."""

from __future__ import annotations

import itertools
import os
import sys
from typing import Any

import msgspec

from ...kernel.codec import ARRAY, array_head, check_array, encode_special

LARGE_ARRAY = 64 * 1024
"""Arrays from this size on are written from where they are instead of being copied into the frame."""


class FrameEncoder:
    """Encodes frames and messages; `large` has the arrays of the one in hand until `spliced` puts them in place."""

    __slots__ = ("_marks", "encode", "large")

    def __init__(self) -> None:
        self.encode = msgspec.msgpack.Encoder(enc_hook=self._encode_special).encode
        self.large: list[tuple[bytes, bytes, memoryview]] = []  # mark, head, elements
        self._marks = itertools.count(int.from_bytes(os.urandom(15), "big"))

    def _encode_special(self, value: Any) -> Any:
        """As the codec does it, but a large array is left out; a mark stands where it belongs."""
        numpy = sys.modules.get("numpy")
        if numpy is None or not isinstance(value, numpy.ndarray) or value.nbytes < LARGE_ARRAY:
            return encode_special(value)
        check_array(value)
        if not value.flags.c_contiguous:
            return encode_special(value)
        mark = next(self._marks).to_bytes(16, "big")
        head = array_head(value)
        self.large.append((mark, head, memoryview(value.reshape(-1).view("u1"))))
        return msgspec.msgpack.Ext(ARRAY, mark)

    def spliced(self, data: bytes) -> list[Any]:
        """A frame in parts, with the arrays where their marks were. (MessagePack counts items, not their bytes.)"""
        parts: list[Any] = []
        large, self.large = self.large, []
        begin = 0
        for mark, head, elements in large:
            at = data.index(mark, begin)
            size = len(head) + len(elements)
            parts += (data[begin : at - 2], b"\xc9" + size.to_bytes(4, "big") + bytes((ARRAY,)) + head, elements)
            begin = at + len(mark)
        parts.append(data[begin:])
        return parts


class OpenRun:
    """Plain messages of one type to one address, encoded, that go out as one frame."""

    __slots__ = ("bodies", "head", "size")

    def __init__(self) -> None:
        self.bodies: list[bytes] = []
        self.size = 0
        self.head: tuple[int, int, int] = (0, 0, 0)  # address, type name, first number
