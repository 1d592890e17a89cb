"""Blocks of images in memory that a life and its home share: what has changed is written once, what has not stays.

Each snapshot writes its changed blocks into a segment of its own (a memfd, which has no name and goes with the last who
holds it). A life compares its state with the blocks of its last snapshot by memcmp; its home, perhaps in another
process, opens the same memory by /proc, so that nothing is sent.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import sys
from collections.abc import Iterable
from typing import Any, Final

from ...actors.errors import HoldfastError
from ...actors.shared_memory import keep_contents, keep_size, unnamed
from ...actors.values import ByteParts
from .image_parts import Chunk, digest
from .state_image import Key, outline

BLOCK: Final = 256 * 1024
PAGE: Final = mmap.PAGESIZE
_BATCH: Final = 256  # buffers per write: the system takes at most 1024
_ZEROS: Final = bytes(PAGE)
_memcmp: Any = ctypes.CDLL(None).memcmp
_memcmp.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
_memcmp.restype = ctypes.c_int

Place = tuple[int, int, int]
"""Where a block is: segment, offset, length."""
NOWHERE: Final[Place] = (0, 0, 0)
"""No block is there."""
Layout = dict[Key, list[Place]]
"""Where the pieces of an image are, in its order."""
Digests = dict[Place, bytes]
"""Of blocks that are in a store, and in memory no more, and of chunks."""


def can_share() -> bool:
    """Whether this system has memory without a name."""
    return hasattr(os, "memfd_create") and os.path.isdir("/proc/self/fd")


class Segment:
    """Some blocks; whoever holds `file` could write them, but nobody does.

    Nobody can make it shorter: whoever reads a mapping behind the end of its file dies of it (SIGBUS).

    Raises:
        OSError: the file is no memory that can be sealed.
    """

    def __init__(self, number: int, file: int, *, is_lent: bool = False) -> None:
        keep_size(file)  # Before it is measured.
        self.number, self.file = number, file
        self.size = os.fstat(file).st_size
        self.inode = os.fstat(file).st_ino
        self._access = mmap.PROT_READ if is_lent else mmap.PROT_READ | mmap.PROT_WRITE
        self._map: mmap.mmap | None = None
        self._is_lent = is_lent
        self._freed: dict[int, int] = {}  # what has been given back, by offset

    @classmethod
    def of(cls, number: int, blocks: Iterable[tuple[int, bytes | memoryview]]) -> Segment:
        """Blocks in memory of their own, each at its offset: for engines that have read them."""
        file, end = memory_file(number), 0
        try:
            for offset, block in blocks:
                os.pwrite(file, block, offset)
                end = max(end, offset + len(block))
            os.ftruncate(file, -(-end // PAGE) * PAGE)
            return cls(number, file)
        except BaseException:
            os.close(file)
            raise

    def block(self, offset: int, length: int) -> memoryview:
        """One block, where it lies."""
        if not 0 <= offset < offset + length <= self.size:
            raise HoldfastError(f"segment {self.number:x} has no bytes {offset} to {offset + length}")
        return memoryview(self._mapped())[offset : offset + length]

    def _mapped(self) -> mmap.mmap:
        """All of it, which takes room among the addresses of this process only once it is looked at."""
        if self._map is None:
            self._map = mmap.mmap(self.file, self.size, mmap.MAP_SHARED, self._access)
        return self._map

    def lend(self) -> None:
        """Let others map it: what stands in it now stays, so that none of its memory is given back any more.

        Raises:
            OSError: the system cannot promise that.
        """
        keep_contents(self.file)
        self._is_lent = True

    def keep(self, places: set[tuple[int, int]]) -> None:
        """Give back the memory of all blocks that are not among these (offset, length)."""
        if self._is_lent or not self.size:
            return
        end = 0
        for offset, length in (*sorted(places), (self.size, 0)):
            if offset - end > self._freed.get(end, 0):
                self._freed[end] = offset - end
                with contextlib.suppress(OSError):  # It is only memory that could be free.
                    self._mapped().madvise(mmap.MADV_REMOVE, end, offset - end)
            end = offset + -(-length // PAGE) * PAGE

    def close(self) -> None:
        """Let go of it; views of its blocks stay valid."""
        os.close(self.file)
        with contextlib.suppress(BufferError):  # Then it goes with the last view.
            if self._map is not None:
                self._map.close()


def can_lend() -> bool:
    """Whether other processes of this user may open what this one holds. (One that may not be debugged is root's.)"""
    return can_share() and os.stat("/proc/self/fd").st_uid == os.geteuid()


def memory_file(number: int) -> int:
    """A new file without a name, in memory."""
    return unnamed(f"holdfast {number:x}")


def new_number() -> int:
    """A number that no other segment has."""
    return int.from_bytes(os.urandom(7))


def write_changed(
    file: int,
    number: int,
    image: list[tuple[Key, Any]],
    known: Layout,
    segments: dict[int, Segment],
    digests: Digests,
) -> Layout:
    """Write into `file` the blocks that differ from the known ones; returns where all blocks of the image are.

    A known block is compared where it lies in one of the segments, or else by its digest. A chunk of entries whose
    digest is known is not even made; the digests of others are added.

    Raises:
        OSError: there is no memory for it.
    """
    layout: Layout = {}
    out: list[Any] = []
    end = 0
    for key, piece in image:
        before = known.get(key, [])
        chunk = piece if isinstance(piece, Chunk) else None
        has_size = chunk is not None and len(before) == 1 and before[0][2] == chunk.size
        if chunk is not None and has_size and chunk.is_known_by(digests.get(before[0])):
            layout[key] = before
            continue
        data: Any = piece if chunk is None else chunk.data()
        view = memoryview(data).cast("B")
        address = _address(view)
        places = layout[key] = []
        for index, begin in enumerate(range(0, len(view), BLOCK)):
            block = view[begin : begin + BLOCK]
            place = before[index] if index < len(before) else None
            if place is not None and place[2] == len(block):
                if place[0] in segments:
                    is_same = _is_same(block, address + begin if address else 0, place, segments[place[0]])
                else:
                    is_same = place in digests and digests[place] == digest(block)
                if is_same:
                    places.append(place)
                    continue
            places.append((number, end, len(block)))
            out.append(block)
            end += len(block)
            if len(block) % PAGE:
                pad = PAGE - len(block) % PAGE
                out.append(_ZEROS[:pad])
                end += pad
        if chunk is not None and len(places) == 1:
            chunk.digest = digests[places[0]] = chunk.digest or digest(view)
    _write(file, out)
    return layout


def layout_of(image: list[tuple[Key, Any]], earlier: Layout) -> Layout:
    """Where the pieces of an image may be among those of an earlier one, of which `known_places` is known."""
    layout: Layout = {}
    left: dict[Key, list[Place]] = {}
    for key, piece in image:
        if isinstance(piece, Chunk) or key == ("", 0):
            layout[key] = earlier.get(key, [])
            continue
        name = key[0], 1
        places = left.get(name, earlier.get(name, []))
        count = -(-len(memoryview(piece).cast("B")) // BLOCK)
        layout[key], left[name] = places[:count], places[count:]
    return layout


def known_places(data: ByteParts, places: list[Place]) -> Layout:
    """Where the pieces of an image are that lies at these places; the pieces of a large section that is whole are one.

    Raises:
        DamagedValue: its head cannot be read.
    """
    found: Layout = {}
    at = 0
    for key, size in outline(data):
        begin = at
        while size > 0 and at < len(places):
            size -= places[at][2]
            at += 1
        if size:  # Its blocks are others: what follows is not known.
            break
        found[key] = places[begin:at]
    return found


def _write(file: int, buffers: list[Any]) -> None:
    at = 0
    for first in range(0, len(buffers), _BATCH):
        batch = buffers[first : first + _BATCH]
        while batch:
            done = os.pwritev(file, batch, at)
            at += done
            while batch and done >= len(batch[0]):
                done -= len(batch.pop(0))
            if batch and done:
                batch[0] = memoryview(batch[0])[done:]


def _address(view: memoryview) -> int:
    """Where a buffer lies in memory; 0 if nobody knows."""
    numpy: Any = sys.modules.get("numpy")
    return int(numpy.frombuffer(view, numpy.uint8).ctypes.data) if numpy is not None and len(view) else 0


def _is_same(block: memoryview, address: int, place: Place, segment: Segment) -> bool:
    _, offset, length = place
    kept = segment.block(offset, length)
    if address:
        return bool(_memcmp(address, _address(kept), length) == 0)
    return bytes(block) == bytes(kept)


class BlocksGone(HoldfastError, text="the blocks of a snapshot are gone: {why}"):
    """The life that has written them does not hold them any more."""

    why: str


def open_segment(number: int, pid: int, file: int, inode: int, *, is_lent: bool = False) -> Segment:
    """A segment that another process holds: a life that has written it, or (`is_lent`) a home that lends it.

    Raises:
        BlocksGone: it is not there any more. HoldfastError: it cannot be had.
    """
    try:
        own = os.open(f"/proc/{pid}/fd/{file}", (os.O_RDONLY if is_lent else os.O_RDWR) | os.O_CLOEXEC)
        try:
            segment = Segment(number, own, is_lent=is_lent)
        except OSError:
            os.close(own)
            raise
    except FileNotFoundError as error:
        raise BlocksGone(str(error)) from error
    except OSError as error:
        raise HoldfastError(f"the blocks of a snapshot cannot be had: {error}") from error
    if segment.inode != inode:
        segment.close()
        raise BlocksGone("its process has closed them")
    return segment


def places_of(layout: Layout) -> list[Place]:
    """All blocks of an image, in order."""
    return [place for places in layout.values() for place in places]


def by_segment(places: Iterable[Place]) -> dict[int, set[tuple[int, int]]]:
    """Offsets and lengths, by segment."""
    found: dict[int, set[tuple[int, int]]] = {}
    for segment, offset, length in places:
        found.setdefault(segment, set()).add((offset, length))
    return found
