"""A ring of past events: the newest ones, bounded by count and by bytes. The oldest is dropped first."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from .past_event import PastEvent


class EventRing:
    """Keeps the newest past events.

    Args:
        most: how many are kept.
        most_bytes: how much memory they may take together, about; a single larger one is kept alone.

    Attributes:
        dropped: how many have given way to newer ones.
    """

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._events: deque[tuple[PastEvent, int]] = deque()
        self._bytes = 0
        self.dropped = 0

    def add(self, event: PastEvent) -> None:
        """Keep one more, and drop the oldest ones beyond the bounds."""
        size = event.size_bytes
        self._events.append((event, size))
        self._bytes += size
        while len(self._events) > self._most or (self._bytes > self._most_bytes and len(self._events) > 1):
            _, size = self._events.popleft()
            self._bytes -= size
            self.dropped += 1

    def __len__(self) -> int:
        return len(self._events)

    @property
    def oldest(self) -> int:
        """The number of the oldest event; 0 if there is none."""
        return self._events[0][0].number if self._events else 0

    @property
    def bytes(self) -> int:
        """The memory that the events take together, about."""
        return self._bytes

    def after(self, number: int) -> Iterator[PastEvent]:
        """The events with larger numbers, oldest first."""
        newer: list[PastEvent] = []
        for event, _ in reversed(self._events):
            if event.number <= number:
                break
            newer.append(event)
        return reversed(newer)
