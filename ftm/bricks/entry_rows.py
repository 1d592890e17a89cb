"""Encodes large lists and dicts of plain values by rows of entries, and skips entries that did not change.

Numbers, texts and bytes cannot change: an entry that is the very object that it was is as it was. A list of them is
looked through for each image, and only groups in which an entry is another one are encoded anew. What comes out are the
bytes that `encode_value` makes of the whole.
"""

from __future__ import annotations

import zlib
from itertools import chain
from operator import is_
from typing import Any, Final

import msgspec

from ...actors.values.value_writer import HEAD_ALONE

MANY: Final = 64
"""Entries from which on a variable is encoded in groups."""
GROUP_BYTES: Final = 32 * 1024
"""What a group should come to."""
PLAIN: Final = frozenset({type(None), bool, int, float, str, bytes})
_ENCODER: Final = msgspec.msgpack.Encoder()


class Rows:
    """One variable: its entries as they were last, and the encoded groups."""

    def __init__(self, name: str, kind: type) -> None:
        self.name, self.kind = name, kind
        self.blocks: list[bytes] = []  # the head, then the groups
        self.sums: list[int] = []
        self.size = 0
        self._groups: list[list[Any]] = []
        self._count = 0  # entries of a group

    def take(self, value: list[Any] | dict[Any, Any]) -> bool:
        """Encode what has changed since the last time; False: there is something that is not plain.

        A change leaves the lists of blocks and sums that were there before as they are.
        """
        entries: list[Any] = value if type(value) is list else [*chain.from_iterable(value.items())]  # type: ignore[union-attr]
        count = self._count or self._sized(entries)
        blocks, sums = [self._head(len(value))], [0]
        groups: list[list[Any]] = []
        known = len(self._groups)
        for index, begin in enumerate(range(0, len(entries), count)):
            group = entries[begin : begin + count]
            old = self._groups[index] if index < known else ()
            if len(old) == len(group) and all(map(is_, old, group)):
                blocks.append(self.blocks[index + 1])
                sums.append(self.sums[index + 1])
                groups.append(old)  # type: ignore[arg-type]
                continue
            if not PLAIN.issuperset(map(type, group)):
                return False
            try:
                block = _ENCODER.encode(group)[1 if len(group) < 16 else 3 if len(group) < 65536 else 5 :]
            except (OverflowError, UnicodeEncodeError):
                return False
            groups.append(group)
            if old and block == self.blocks[index + 1]:  # Another object of the same value.
                blocks.append(self.blocks[index + 1])
                sums.append(self.sums[index + 1])
            else:
                blocks.append(block)
                sums.append(zlib.crc32(block))
        if self.blocks and blocks[0] == self.blocks[0]:
            blocks[0] = self.blocks[0]
        sums[0] = zlib.crc32(blocks[0])
        self.blocks, self.sums, self.size, self._groups = blocks, sums, sum(map(len, blocks)), groups
        has_grown = count > 2 and self.size > 4 * GROUP_BYTES * len(groups)
        self._count = 0 if has_grown else count
        return True

    def _sized(self, entries: list[Any]) -> int:
        """How many entries make a group; an even number, for keys and their values stay together."""
        sample = entries[:: max(1, len(entries) // 32)]
        if not PLAIN.issuperset(map(type, sample)):
            return MANY  # It will not come to that.
        try:
            size = len(_ENCODER.encode(sample)) // len(sample) + 1
        except (OverflowError, UnicodeEncodeError):
            return MANY
        return max(2, GROUP_BYTES // size // 2 * 2)

    def _head(self, length: int) -> bytes:
        """All that stands before the entries: the variable's name, and how many there are."""
        marks = (b"\xdc", b"\xdd") if self.kind is list else (b"\xde", b"\xdf")  # MANY are no few
        head = marks[0] + length.to_bytes(2, "big") if length < 65536 else marks[1] + length.to_bytes(4, "big")
        return HEAD_ALONE + b"\x81" + _ENCODER.encode(self.name) + head
