"""Bytes that lie in several pieces of memory, as one value that is read from front to back."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from ..errors import DamagedValue


class ByteParts:
    """What is left of the bytes. Views of them may be kept only by a reader that was told so."""

    __slots__ = ("_parts", "_size")

    def __init__(self, parts: Iterable[memoryview]) -> None:
        self._parts = deque(part for part in parts if len(part))
        self._size = sum(map(len, self._parts))

    def __len__(self) -> int:
        return self._size

    @property
    def first(self) -> int:
        """The next byte, if there is one."""
        return self._parts[0][0]

    def again(self) -> ByteParts:
        """The same bytes, to be read from here on once more."""
        return ByteParts(self._parts)

    def take(self, size: int) -> memoryview | ByteParts:
        """Take the next bytes: a view where they lie in one piece, else a value of their own.

        Raises:
            DamagedValue: there are not so many.

        >>> parts = ByteParts([memoryview(b"abc"), memoryview(b"de")])
        >>> bytes(parts.take(2)), bytes(parts.take(2).joined()), len(parts)
        (b'ab', b'cd', 1)
        """
        if not 0 <= size <= self._size:
            raise DamagedValue("it is cut short")
        if not size:
            return memoryview(b"")
        taken: list[memoryview] = []
        self._size -= size
        while size:
            part = self._parts.popleft()
            if len(part) > size:
                self._parts.appendleft(part[size:])
                part = part[:size]
            taken.append(part)
            size -= len(part)
        return taken[0] if len(taken) == 1 else ByteParts(taken)

    def joined(self) -> memoryview:
        """All that is left in one piece: a copy, unless it lies in one."""
        parts = self._parts
        return parts[0] if len(parts) == 1 else memoryview(b"".join(parts))


def in_one(data: memoryview | ByteParts) -> memoryview:
    """The same bytes in one piece. Raises TypeError: they are none."""
    return data.joined() if isinstance(data, ByteParts) else memoryview(data)
