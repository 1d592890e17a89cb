"""The page on which a checking process says in which turn it is, so that this is known when it hangs or is ended."""

from __future__ import annotations

import mmap
import struct
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from ...checkpoint.protocol import Feed

PAGE_BYTES: Final = 4096
_HEAD: Final = struct.Struct("<qqqH")  # address, turns handled, turn + 1, bytes of the message's type
_MOST: Final = 1000


class WorkerPosition(NamedTuple):
    """Where the process is: number of the address, turns handled there, the turn in hand (-1: none), its message."""

    address: int
    handled: int
    turn: int
    message: str


class Progress:
    """Says on the page where its process is."""

    def __init__(self, page: mmap.mmap) -> None:
        self._page, self._address, self._begun = page, -1, 0
        self._type, self._length = "", 0  # as they stand on the page

    def next_address(self) -> None:
        """Another address is looked at."""
        self._address, self._begun = self._address + 1, 0
        _HEAD.pack_into(self._page, 0, self._address, 0, 0, 0)

    def turn(self, turn: int, feed: Feed) -> None:
        """Say on the page which turn begins."""
        kind = feed.name or feed.kind
        if kind != self._type:
            name = kind.encode()[:_MOST]
            self._page[_HEAD.size : _HEAD.size + len(name)] = name
            self._type, self._length = kind, len(name)
        _HEAD.pack_into(self._page, 0, self._address, self._begun, turn + 1, self._length)
        self._begun += 1


def read_place(page: mmap.mmap) -> WorkerPosition:
    """Where the process is, or was."""
    address, handled, turn, length = _HEAD.unpack_from(page, 0)
    name = page[_HEAD.size : _HEAD.size + min(length, _MOST)]
    return WorkerPosition(address, handled, turn - 1, name.decode(errors="replace"))
