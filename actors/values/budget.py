"""Budgets: limits on what received bytes may become in memory, checked before anything is built."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Final, cast

import msgpack

from ..errors import DamagedValue

MOST_CONTAINERS: Final = 1_000_000
"""Lists and dicts in one value or frame: each takes 60 bytes and more, and may be one byte here."""
MOST_STEPS: Final = 64
"""Items at which a frame is looked before all of it is."""
MOST_CLASHES: Final = 64
"""Different keys with one hash: more are chosen so, and each costs as many steps as there are others."""
MANY_KEYS: Final = 512
"""Keys from which on it is looked whether they are spread."""
MOST_SEEN: Final = 65_536
"""Large ints that are remembered to find those that clash."""


class TooMany(Exception):
    """There are more containers than may be."""


def check_containers(data: bytes | memoryview, most: int = MOST_CONTAINERS) -> None:
    """See whether MessagePack bytes hold more containers than may be. Costs nothing to speak of where they cannot.

    Raises:
        TooMany: they do. Whatever msgpack raises: they are no MessagePack.
    """
    if len(data) <= most or _is_payload(memoryview(data), most):
        return
    left = most

    def seen(parts: object) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise TooMany(f"it holds more than {most} lists and dicts")

    scan = cast("Callable[..., Any]", msgpack.unpackb)
    scan(data, raw=True, list_hook=seen, object_pairs_hook=seen, ext_hook=_nothing, strict_map_key=False)


def _nothing(code: int, data: bytes) -> None:
    return None


def _is_payload(data: memoryview, most: int) -> bool:
    """Whether, as far as a few steps show, most of it is text, bytes or arrays, in which there are no containers."""
    at, left, items = 0, len(data), 1
    for _ in range(MOST_STEPS):
        if not items or left <= most or at >= len(data):
            break
        head, items = data[at], items - 1
        at += 1
        if head in _SIZED:
            width, extra = _SIZED[head]
            size = int.from_bytes(data[at : at + width], "big") + extra
            at += width + size
            left -= size
        elif 0x90 <= head <= 0x9F:
            items += head & 0x0F
        elif 0x80 <= head <= 0x8F:
            items += 2 * (head & 0x0F)
        elif 0xDC <= head <= 0xDF:
            width = 2 if head % 2 == 0 else 4
            items += int.from_bytes(data[at : at + width], "big") * (1 if head < 0xDE else 2)
            at += width
        elif 0xA0 <= head <= 0xBF:
            at += head & 0x1F
        else:
            at += _FIXED.get(head, 0)
    return left <= most


_SIZED: Final = {0xC4: (1, 0), 0xC5: (2, 0), 0xC6: (4, 0), 0xC7: (1, 1), 0xC8: (2, 1), 0xC9: (4, 1)} | {
    0xD9: (1, 0),
    0xDA: (2, 0),
    0xDB: (4, 0),
}
"""Heads of bytes, extensions and text: how wide the length is, and what it leaves out."""
_FIXED: Final = {0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8} | {
    0xD4: 2,
    0xD5: 3,
    0xD6: 5,
    0xD7: 9,
    0xD8: 17,
}


class LargeInts:
    """Makes the ints that msgpack has no type for; those that were chosen to clash as keys are refused."""

    def __init__(self) -> None:
        self._seen: dict[int, int] = {}
        self._clashes = 0

    def make(self, code: int, data: bytes) -> int:
        """The int.

        Raises:
            DamagedValue: it is none, or one of many with the same hash.
        """
        if code != 0:
            raise DamagedValue(f"it has an extension value with code {code}")
        number = int.from_bytes(data, "big", signed=True)
        if self._seen.setdefault(hash(number), number) != number:
            self._clashes += 1
            if self._clashes > MOST_CLASHES:
                raise DamagedValue("it has numbers that are chosen to clash")
        if len(self._seen) > MOST_SEEN:
            self._seen.clear()
        return number


def spread(keys: Iterable[Any]) -> None:
    """See whether keys have hashes of their own, before a set or dict is made of them.

    Raises:
        DamagedValue: too many have the same.
    """
    if max(Counter(map(hash, keys)).values(), default=0) > MOST_CLASHES:
        raise DamagedValue("it has keys that are chosen to clash")
