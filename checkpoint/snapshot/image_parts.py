"""The parts of an image: variables, and chunks of the entries of large lists and dicts, each encoded by itself.

Parts may share objects that can change. Such an object is written by the first part that holds it, under a number that
no other has in the image; those behind it refer to that number, so that it is one object again when they come back.
The numbers come from names and contents, not from what a process remembers: the same state has the same image.
"""

from __future__ import annotations

import hashlib
from array import array
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any, Final
from zlib import crc32

from ...actors.values import ALONE, Links, walked_pieces
from ...actors.values.same_objects import Level, is_as_seen, seen

_LOW_BITS: Final = (1 << 30) - 1
_CHUNK: Final = 1 << 30
"""Numbers of chunks are above it: below are those of the pieces of a variable."""


def digest(block: bytes | memoryview) -> bytes:
    """By which bytes are known that are in memory no more."""
    return hashlib.blake2b(block, digest_size=16).digest()


class ImagePart:
    """Something that is encoded by itself.

    Attributes:
        objects: what can change and is reached, by id; none once there is only `ids`.
        ids: of these.
    """

    __slots__ = ("ids", "links", "name", "number", "objects", "pieces", "size", "value", "where")

    def __init__(self, name: str, value: object, where: str) -> None:
        self.name, self.value, self.where = name, value, where
        self.number = 0
        self.links = ALONE
        self.pieces, found = walked_pieces(value, where)
        self.objects = {key: one for key, one in found.items() if one is not None}
        self.ids: Iterable[int] = self.objects
        self.size = _size(self.pieces)

    def encode(self, links: Links) -> None:
        """Encode it with what it shares with other parts."""
        self.links = links
        self.pieces = walked_pieces(self.value, self.where, links=links)[0]
        self.size = _size(self.pieces)


class Chunk(ImagePart):
    """Some entries of a list, or keys and values in turn of a dict. Its bytes are made again when they are wanted.

    Attributes:
        is_open: whether it ends where the entries end, and not at a border.
        ending: a checksum of its last entry.
        digest: of its bytes, if it is known.
    """

    __slots__ = ("_levels", "digest", "ending", "entries", "is_open")

    def __init__(self, name: str, entries: list[Any], where: str) -> None:
        super().__init__(name, entries, where)
        self.entries = entries
        self.is_open, self.ending = True, 0
        self.digest = b""
        self._levels: list[Level] | None = None
        del self.objects[id(entries)]

    def remember(self) -> bool:
        """Keep no bytes, but what is needed to see later whether the entries have changed; False: nobody can."""
        self.pieces = []
        if self._levels is None:
            self._levels = seen(self.entries, 2 * self.size)
        if self._levels is None:
            return False
        if self.objects:  # They hold each other.
            self.ids, self.objects = array("Q", self.objects), {}
        return True

    def is_unchanged(self) -> bool:
        """Whether the entries would be encoded as the same bytes."""
        return self._levels is not None and is_as_seen(self._levels, self.entries)

    def encode(self, links: Links) -> None:
        """Encode it with what it shares with other parts."""
        super().encode(links)
        self.digest = b""

    def is_known_by(self, known: bytes | None) -> bool:
        """Whether this is the digest of its bytes."""
        if not self.digest and known is not None:
            self.digest = digest(self.data())
        return self.digest == known

    def data(self) -> bytes:
        """The bytes of the chunk, made again if they were let go."""
        if not self.pieces:
            self.encode(self.links)
        return b"".join(self.pieces)


def shared_ids(parts: Sequence[ImagePart], before: set[int], held: Sequence[int]) -> set[int]:
    """What is reached at several places.

    Args:
        parts: all of an image; those without `objects` have not changed since the last one.
        before: what was reached at several places in that one.
        held: places beside the parts: the lists and dicts whose chunks are among these.
    """
    fresh, again = set(held), set(before)
    if len(fresh) < len(held):
        again |= fresh
    for part in parts:
        again.update(fresh.intersection(part.objects))
        fresh.update(part.objects)
    for part in parts:
        if not part.objects:
            again |= fresh.intersection(part.ids)
    if not again:
        return again
    counts = Counter(key for key in chain(held, *(part.ids for part in parts)) if key in again)
    return {key for key, count in counts.items() if count > 1}


def link(parts: Iterable[ImagePart], shared: set[int]) -> None:
    """Number the parts of an image in their order, and encode those anew that share something else now.

    Args:
        parts: all of them.
        shared: what several of them reach, by id.
    """
    free, taken, known, last = dict[int, int](), set[int](), dict[int, int](), dict[str, int]()
    for part in parts:
        wish = crc32(part.name.encode(errors="surrogatepass"), last.get(part.name, 0)) & _LOW_BITS
        number = free.get(wish, wish)
        while number in taken:
            number = (number + 1) & _LOW_BITS
        taken.add(number)
        free[wish] = number + 1
        part.number = _CHUNK + number
        if isinstance(part, Chunk):
            last[part.name] = part.ending
        links = ALONE
        own = [key for key in part.ids if key in shared] if shared else []
        if own:
            given = {key: -1 - (number << 32) - at for at, key in enumerate(key for key in own if key not in known)}
            links = Links({key: known[key] for key in own if key in known}, given)
            known |= given
        if links != part.links:
            part.encode(links)


def _size(pieces: Sequence[Any]) -> int:
    return sum(len(memoryview(piece).cast("B")) for piece in pieces)
