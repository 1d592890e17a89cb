"""Images that a life maps instead of being sent them: their memory is shared until the life changes it.

Each block is mapped privately (copy on write), so nobody else sees what the life does to it, and the home's snapshot
stays as it is. Blocks of one piece come to lie one behind the other, wherever they are; so a large array lies in one
piece, and stays there.
"""

from __future__ import annotations

import ctypes
import mmap
import os
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from ...actors.errors import HoldfastError
from ...actors.values import ByteParts
from ..protocol import Lent
from .shared_blocks import PAGE, Place, Segment, open_segment

MAP_FIXED: Final = 0x10
_mmap: Any = ctypes.CDLL(None, use_errno=True).mmap
_mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_int64)
_mmap.restype = ctypes.c_void_p


class MappedImage(NamedTuple):
    """An image as a life has it; whoever has it closes the segments."""

    data: ByteParts
    places: list[Place]
    segments: dict[int, Segment]


def map_image(lent: Lent) -> MappedImage:
    """Map what a home lends.

    Raises:
        HoldfastError: it is not there any more. OSError: there is no room for it.
    """
    segments: dict[int, Segment] = {}
    try:
        for number, file, inode in lent.segments:
            segments[number] = open_segment(number, lent.pid, file, inode, is_lent=True)
        return MappedImage(ByteParts(_parts(lent.places, segments)), lent.places, segments)
    except BaseException:
        for segment in segments.values():
            segment.close()
        raise


def _parts(places: list[Place], segments: dict[int, Segment]) -> list[memoryview]:
    """The image in memory: one part for each run of blocks that fill their pages."""
    memory = mmap.mmap(-1, sum(map(_room, places)), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    at = 0
    for number, offset, length in _runs(places):
        segment = segments.get(number)
        if segment is None or offset % PAGE or not 0 <= offset < offset + length <= segment.size:
            raise HoldfastError(f"segment {number:x} has no bytes {offset} to {offset + length}")
        access, how = mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_PRIVATE | MAP_FIXED
        if _mmap(address + at, length, access, how, segment.file, offset) != address + at:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), "a snapshot cannot be mapped")
        at += length
    view, begin, end, parts = memoryview(memory), 0, 0, list[memoryview]()
    for place in places:
        end += place[2]
        if place[2] % PAGE:
            parts.append(view[begin:end])
            begin = end = end + _room(place) - place[2]
    return [*parts, view[begin:end]]


def _room(place: Place) -> int:
    """The bytes of the pages that a block takes."""
    return -(-place[2] // PAGE) * PAGE


def _runs(places: list[Place]) -> Iterator[Place]:
    """The places, those together that lie one behind the other in one segment; lengths are in whole pages."""
    run: Place | None = None
    for place in places:
        number, offset, _ = place
        if run is not None and run[0] == number and run[1] + run[2] == offset:
            run = number, run[1], run[2] + _room(place)
            continue
        if run is not None:
            yield run
        run = number, offset, _room(place)
    if run is not None:
        yield run
