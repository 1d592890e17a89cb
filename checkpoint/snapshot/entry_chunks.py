"""Cuts the entries of large lists and dicts into chunks, and finds those in which nothing has changed.

Where a chunk ends is said by its last entry alone (by a checksum, which is low often enough), so that what is put in or
taken out moves no border but its own: content-defined chunking. What was seen of a chunk when it was encoded says
whether it must be encoded again.

Source: Muthitacharoen, Chen and Mazieres 2001, A Low-bandwidth Network File System, for the borders.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import accumulate, chain
from operator import is_
from typing import Any, Final
from zlib import crc32

import msgspec

from ...actors.values import UnsavableValue, walked_pieces
from ...actors.values.arrays import is_array
from ...actors.values.saved_refs import Addressed
from .image_parts import Chunk

MANY: Final = 64
"""Entries from which on a list or dict is cut into chunks."""
LARGE: Final = 64 * 1024
"""And bytes, at a glance."""
CHUNK_BYTES: Final = 16 * 1024
"""What chunks come to in the mean."""
LEAST: Final = CHUNK_BYTES // 4
MOST: Final = CHUNK_BYTES * 4
LARGE_ENTRY: Final = CHUNK_BYTES
"""Entries of this size are not looked at one by one: large arrays stay where they lie, and are not copied."""
_LOW: Final = (1 << 32) // CHUNK_BYTES
_UNTOLD: Final = (ValueError, TypeError, OverflowError, RecursionError)


def _told(value: object) -> object:
    if is_array(type(value)):
        array: Any = value
        if array.nbytes >= LARGE_ENTRY:
            raise ValueError("it is large")
        return array.tobytes()
    return value.path if isinstance(value, Addressed) else None


_told_by: Final = msgspec.msgpack.Encoder(enc_hook=_told).encode  # Only for checksums and sizes.


class ChunkTable:
    """A variable that is a large list or dict, and its chunks as they were last.

    Attributes:
        chunks: those of the last image, in order.
    """

    def __init__(self, name: str, kind: type, where: str) -> None:
        self.name, self.kind, self._where = name, kind, where
        self.chunks: list[Chunk] = []
        self._length = 0  # of the entries of the last image
        self._borders: list[tuple[int, int]] = []  # in them
        self._is_made_anew = False  # each time it is looked at, as far as it seems

    def fits(self, value: object) -> bool:
        """Whether the variable is still one to be cut into chunks."""
        return isinstance(value, list | dict) and type(value) is self.kind and len(value) >= MANY

    def remember(self) -> None:
        """Keep those chunks that need not be encoded again if nothing changes."""
        chunks = self.chunks[:1] if self._is_made_anew else self.chunks
        self.chunks = [chunk for chunk in chunks if chunk.remember()]

    def take(self, value: list[Any] | dict[Any, Any]) -> None:
        """Look through the entries; chunks in which nothing has changed stay the objects that they were.

        Raises:
            UnsavableValue: one cannot be saved.
        """
        entries = value if isinstance(value, list) else [*chain.from_iterable(value.items())]
        items = _aligned(self.chunks, entries)
        self._is_made_anew = bool(self.chunks) and not any(isinstance(item, Chunk) for item in items)
        if self._is_made_anew and len(entries) == self._length:
            # To find borders takes longer than to encode plain numbers, which may all be other ones each time.
            chunks, rest = self._cut(entries, self._borders)
        else:
            chunks, rest = self._put_together(items)
        self.chunks = [*chunks, self._chunk(rest)] if rest else chunks
        self._length = len(entries)
        ends = accumulate(len(chunk.entries) for chunk in self.chunks)
        self._borders = [(end, chunk.ending) for end, chunk in zip(ends, self.chunks, strict=True) if not chunk.is_open]

    def _put_together(self, items: list[Chunk | list[Any]]) -> tuple[list[Chunk], list[Any]]:
        """Chunks of all entries, old ones where they can be, and the entries behind the last border."""
        chunks, begun = list[Chunk](), list[Any]()
        for item in items:
            if isinstance(item, list):
                begun += item
            elif not item.is_unchanged() or (item.is_open and item is not items[-1]):
                begun += item.entries
            else:
                made, begun = self._cut(begun, self._found(begun))
                chunks += made
                if begun:  # It ends with what was within a chunk before.
                    begun += item.entries
                else:
                    chunks.append(item)
        made, begun = self._cut(begun, self._found(begun))
        return chunks + made, begun

    def _found(self, entries: list[Any]) -> list[tuple[int, int]]:
        return _borders(entries, 1 if self.kind is list else 2)

    def _cut(self, entries: list[Any], borders: list[tuple[int, int]]) -> tuple[list[Chunk], list[Any]]:
        """Chunks of these entries, and those behind the last border."""
        chunks, begin = list[Chunk](), 0
        for end, checksum in borders:
            chunk = self._chunk(entries[begin:end])
            chunk.is_open, chunk.ending = False, checksum
            chunks.append(chunk)
            begin = end
        return chunks, entries[begin:]

    def _chunk(self, entries: list[Any]) -> Chunk:
        return Chunk(self.name, entries, self._where)


def is_large(value: Any) -> bool:
    """Whether a variable should be cut into chunks: a list or dict of many entries, none of them large by itself."""
    kind: Any = type(value)
    if not (kind in (list, dict) and len(value) >= MANY):
        return False
    step = len(value) // 32
    some: list[Any] = value[::step] if kind is list else [*value.items()][::step]
    if any(is_array(type(one)) for one in some):  # They lie one behind the other already.
        return False
    try:
        size = sum(map(_size_at_a_glance, some)) // len(some)
    except UnsavableValue:  # It is said where the variable is encoded.
        return False
    return size < LARGE_ENTRY and size * len(value) >= LARGE


def _size_at_a_glance(entry: object) -> int:
    try:
        return len(_told_by(entry))
    except _UNTOLD:
        return sum(len(memoryview(piece).cast("B")) for piece in walked_pieces(entry, "entry")[0])


def _aligned(chunks: list[Chunk], entries: list[Any]) -> list[Chunk | list[Any]]:
    """All entries in order: chunks that hold the very same ones, and lists of what lies between."""
    begin, end, first, last = 0, len(entries), 0, len(chunks)
    while first < last and _holds(chunks[first], entries, begin, end):
        begin += len(chunks[first].entries)
        first += 1
    while first < last and _holds(chunks[last - 1], entries, end - len(chunks[last - 1].entries), end, begin):
        last -= 1
        end -= len(chunks[last].entries)
    front: list[Chunk | list[Any]] = [*chunks[:first]]
    heads = {id(chunk.entries[0]): chunk for chunk in chunks[first:last]}
    places = [at for at, one in enumerate(map(id, entries[begin:end]), begin) if one in heads] if heads else []
    for at in places:
        chunk = heads.get(id(entries[at]))
        if at < begin or chunk is None or not _holds(chunk, entries, at, end):
            continue
        if at > begin:
            front.append(entries[begin:at])
        front.append(heads.pop(id(entries[at])))
        begin = at + len(chunk.entries)
    if end > begin:
        front.append(entries[begin:end])
    return [*front, *chunks[last:]]


def _holds(chunk: Chunk, entries: list[Any], begin: int, end: int, least: int = 0) -> bool:
    """Whether a chunk holds the entries from `begin` on, which lie between `least` and `end`."""
    own = chunk.entries
    behind = begin + len(own)
    if begin < least or behind > end or own[-1] is not entries[behind - 1]:
        return False
    return all(map(is_, own, entries[begin:behind]))


def _borders(entries: list[Any], step: int) -> list[tuple[int, int]]:
    """Where chunks of entries end, each with the checksum of the entry before the border."""
    told = _all_told(entries)
    checksums = [*map(crc32, told[::step])]  # Of a dict that of the key: its value changes.
    sizes = [*map(len, told)]
    if step == 2:
        sizes = [*map(int.__add__, sizes[::2], sizes[1::2])]
    low = [at for at, (checksum, size) in enumerate(zip(checksums, sizes, strict=True)) if checksum < size * _LOW]
    found: list[tuple[int, int]] = []
    begin, ends = 0, [*accumulate(sizes)]
    while True:
        next_low = bisect_left(low, bisect_left(ends, begin + LEAST))
        at = min(low[next_low] if next_low < len(low) else len(ends), bisect_left(ends, begin + MOST))
        if at == len(ends):
            return found
        found.append(((at + 1) * step, checksums[at]))
        begin = ends[at]


def _all_told(entries: list[Any]) -> list[bytes]:
    """Each entry in bytes that are the same in every process, for checksums."""
    try:
        return [*map(_told_by, entries)]
    except _UNTOLD:
        return [*map(_told_alone, entries)]


def _told_alone(entry: object) -> bytes:
    try:
        return _told_by(entry)
    except _UNTOLD:
        return b"".join(walked_pieces(entry, "entry")[0])
