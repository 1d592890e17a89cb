"""A ring of what is numbered, past events or lines: the newest ones, bounded by count and by bytes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, Protocol, TypeVar

MOST_RUNS = 16
"""Runs of numbers that are kept apart of those that are gone."""


class Numbered(Protocol):
    """What a ring keeps: it has a number that rises, and knows how much memory it takes."""

    @property
    def number(self) -> int:
        """Larger than those of all that came before."""
        ...

    @property
    def size_bytes(self) -> int:
        """The memory that it takes, about."""
        ...


N = TypeVar("N", bound=Numbered)


class GoneNumbers:
    """How many numbers are gone, and how many of these are larger than a given one.

    Numbers that follow each other are one run. Only the newest runs are kept apart, and the older ones become one: of
    those it is not known any more where in it each number was, so that rather too many are counted than too few.

    Attributes:
        count: how many are gone.

    >>> gone = GoneNumbers()
    >>> for number in (1, 2, 3, 7, 8):
    ...     gone.add(number)
    >>> gone.count, gone.after(2), gone.after(7), gone.after(8)
    (5, 3, 1, 0)
    """

    __slots__ = ("_runs", "count")

    def __init__(self) -> None:
        self.count = 0
        self._runs: list[tuple[int, int, int]] = []  # first, last, how many

    def add(self, first: int, last: int | None = None, count: int = 1) -> None:
        """One more number is gone; or `count` numbers from `first` to `last`."""
        runs = self._runs
        self.count += count
        if last is None and runs and runs[-1][1] == first - 1:
            begin, _, already = runs[-1]
            runs[-1] = begin, first, already + 1
            return
        runs.append((first, first if last is None else last, count))
        if len(runs) > MOST_RUNS:
            (one, to, many), (other, until, more) = runs[:2]
            runs[:2] = [(min(one, other), max(to, until), many + more)]

    def after(self, number: int) -> int:
        """How many of them are larger than this one."""
        return sum(min(count, last - number) for _, last, count in self._runs if last > number)


class EventRing(Generic[N]):
    """Keeps the newest past events, or lines.

    Args:
        most: how many are kept.
        most_bytes: how much memory they may take together, about; a single larger one is kept alone.

    Attributes:
        gone: which have given way to newer ones.
    """

    __slots__ = ("_bytes", "_events", "_most", "_most_bytes", "gone")

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._events: deque[tuple[N, int]] = deque()
        self._bytes = 0
        self.gone = GoneNumbers()

    def add(self, event: N) -> None:
        """Keep one more, and drop the oldest ones beyond the bounds."""
        size = event.size_bytes
        self._events.append((event, size))
        self._bytes += size
        if len(self._events) > self._most or self._bytes > self._most_bytes:
            self.shrink(self._most_bytes)

    def forget(self, is_meant: Callable[[N], bool]) -> None:
        """Drop those that are meant."""
        kept: deque[tuple[N, int]] = deque()
        for one in self._events:
            if is_meant(one[0]):
                self.gone.add(one[0].number)
            else:
                kept.append(one)
        self._events, self._bytes = kept, sum(size for _, size in kept)

    def shrink(self, most_bytes: int) -> None:
        """Drop the oldest ones beyond so many bytes; the newest one stays."""
        events = self._events
        while len(events) > self._most or (self._bytes > most_bytes and len(events) > 1):
            event, size = events.popleft()
            self._bytes -= size
            self.gone.add(event.number)

    def __len__(self) -> int:
        return len(self._events)

    @property
    def dropped(self) -> int:
        """How many have given way to newer ones."""
        return self.gone.count

    @property
    def oldest(self) -> int:
        """The number of the oldest event; 0 if there is none."""
        return self._events[0][0].number if self._events else 0

    @property
    def newest(self) -> int:
        """The number of the newest event; 0 if there is none."""
        return self._events[-1][0].number if self._events else 0

    @property
    def bytes(self) -> int:
        """The memory that the events take together, about."""
        return self._bytes

    def after(self, number: int) -> Iterator[N]:
        """The events with larger numbers, oldest first."""
        newer: list[N] = []
        for event, _ in reversed(self._events):
            if event.number <= number:
                break
            newer.append(event)
        return reversed(newer)
