"""The shelf: past events in the store, in a few small notes of which the oldest gives way, for the next root."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence

import msgspec

from .past_event import PastEvent

CHUNK_BYTES = 8 * 1024
"""Bytes after which a note is left as it is, and the next one is begun."""
PAGES_BYTES = 8 * 1024
"""Bytes that a store writes for a note besides those in it, about: pages are written whole."""
EVENTS = msgspec.msgpack.Decoder(list[PastEvent])


class EventShelf:
    """Keeps past events in notes of a store: what does not fit makes the oldest note go.

    Args:
        prefix: how the names of the notes begin.
        notes: what the store has under this prefix.
        write: has the store keep a note, or forget it (None).
        most_bytes: all notes together have at most so many, but always one.
    """

    def __init__(
        self,
        prefix: str,
        notes: Mapping[str, bytes],
        write: Callable[[str, bytes | None], None],
        most_bytes: int,
    ) -> None:
        self._prefix, self._write, self._most_bytes = prefix, write, most_bytes
        self._sizes: deque[tuple[str, int]] = deque((name, len(notes[name])) for name in sorted(notes))
        self._open: list[msgspec.Raw] = []
        self._open_bytes = 0
        last = self._sizes[-1][0].removeprefix(prefix) if self._sizes else ""
        self._next = int(last) + 1 if last.isascii() and last.isdigit() else 1

    def put(self, events: Sequence[PastEvent]) -> int:
        """Write these events behind the others; returns how many bytes were written for them.

        Raises:
            HoldfastError: the store refuses; they may be put again, and those that it has taken are there twice then.
        """
        size = 0
        packed: deque[msgspec.Raw] = deque()
        for event in reversed(events):  # More than fits need not be written.
            one = msgspec.Raw(msgspec.msgpack.encode(event))
            size += len(one)
            if packed and size > self._most_bytes:
                break
            packed.appendleft(one)
        written = 0
        while packed:
            part = list(self._open)
            part_bytes = self._open_bytes
            while packed and (part_bytes < CHUNK_BYTES or not part):
                part_bytes += len(packed[0])
                part.append(packed.popleft())
            written += self._put_part(part, part_bytes)
        return written

    def forget(self, notes: Mapping[str, bytes], is_meant: Callable[[PastEvent], bool]) -> None:
        """Write those of these notes anew that have an event which is meant, without it.

        Raises:
            HoldfastError: the store refuses; it may be tried again.
        """
        for name in sorted(notes):
            events = events_in({name: notes[name]})
            left = [msgspec.Raw(msgspec.msgpack.encode(event)) for event in events if not is_meant(event)]
            if len(left) == len(events):
                continue
            data = msgspec.msgpack.encode(left)
            self._write(name, data)
            self._sizes = deque((one, len(data) if one == name else size) for one, size in self._sizes)
            if name == f"{self._prefix}{self._next:012d}":
                self._open, self._open_bytes = left, sum(map(len, left))

    def _put_part(self, part: list[msgspec.Raw], part_bytes: int) -> int:
        """Write the open note anew, with more in it; when it is full, the next one is opened."""
        name = f"{self._prefix}{self._next:012d}"
        data = msgspec.msgpack.encode(part)
        self._write(name, data)
        if self._sizes and self._sizes[-1][0] == name:
            self._sizes.pop()
        self._sizes.append((name, len(data)))
        self._open, self._open_bytes = part, part_bytes
        if part_bytes >= CHUNK_BYTES:
            self._next += 1
            self._open, self._open_bytes = [], 0
        while len(self._sizes) > 1 and sum(size for _, size in self._sizes) > self._most_bytes:
            self._write(self._sizes[0][0], None)
            self._sizes.popleft()
        return len(data) + PAGES_BYTES


def events_in(notes: Mapping[str, bytes]) -> list[PastEvent]:
    """The past events in the notes of a shelf, oldest first; a note that cannot be read is passed over."""
    found: list[PastEvent] = []
    for name in sorted(notes):
        try:
            found += EVENTS.decode(notes[name])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            continue
    return found
