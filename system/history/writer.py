"""The writer of the history: has the store keep past events, a few times a second; a store that fails is left alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

from ...actors.errors import HoldfastError
from ...actors.events import Event
from .past_event import PastEvent
from .shelf import EventShelf, events_in
from .tracks import BOUNDS, TrackName, track_of

if TYPE_CHECKING:
    import asyncio

    from ...actors.kernel.node import Node

PACE = 0.25
"""Seconds between two writes while events come."""
BURST_BYTES, BYTES_PER_SECOND = 512 * 1024, 8 * 1024
"""Bytes that are written at that pace, and how many each second for as long as events go on after that."""
LONGEST_PACE = 5.0
"""Seconds between two writes at most, which is what a kill may take along."""
RETRY = 30.0
"""Seconds until a store is tried again that has refused."""
MOST_UNWRITTEN = 2_000
"""Events that wait for the store; the oldest are not written if there are more."""


class HistoryNotKept(Event, frozen=True, eq=False):
    """The store does not take the history: it is kept in memory only, until the store takes it again."""

    reason: str


class NoteStore(Protocol):
    """What keeps the notes of a system."""

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small fact; None forgets it."""
        ...

    def notes(self, prefix: str) -> Mapping[str, bytes]:
        """The facts whose keys begin so."""
        ...


def prefix(track: TrackName) -> str:
    """How the names of the notes of a track begin."""
    return f"history {track} "


def stored(store: NoteStore) -> list[PastEvent]:
    """What a store has of earlier roots, oldest first, each event once."""
    found = [event for name in BOUNDS for event in events_in(store.notes(prefix(name)))]
    by_number = {event.number: event for event in found}
    return [by_number[number] for number in sorted(by_number)]


class SpentBytes:
    """How much was written lately: many events that go on for long are written more seldom, and more of them at once.

    Args:
        now: seconds on any clock that does not go back.

    >>> spent = SpentBytes(0.0)
    >>> spent.add(BURST_BYTES, 0.0), spent.add(BYTES_PER_SECOND, 0.0), spent.add(BURST_BYTES, 0.0)
    (0.25, 1.0, 5.0)
    """

    def __init__(self, now: float) -> None:
        self._bytes, self._then = 0.0, now

    def add(self, written: int, now: float) -> float:
        """So much was written just now; returns the seconds until the next write."""
        self._bytes = max(0.0, self._bytes - (now - self._then) * BYTES_PER_SECOND) + written
        self._then = now
        return min(LONGEST_PACE, max(PACE, (self._bytes - BURST_BYTES) / BYTES_PER_SECOND))


class HistoryWriter:
    """Writes past events to the store, beside the turns: soon after the first one, then a few times a second.

    A store that refuses is told of once, and left alone for a while.
    """

    def __init__(self, node: Node, store: NoteStore) -> None:
        self._node, self._store = node, store
        self._shelves: dict[TrackName, EventShelf] = {
            name: EventShelf(prefix(name), store.notes(prefix(name)), store.note, bounds.stored_bytes)
            for name, bounds in BOUNDS.items()
        }
        self._unwritten: deque[PastEvent] = deque(maxlen=MOST_UNWRITTEN)
        self._timer: asyncio.TimerHandle | None = None
        self._due = 0.0  # the next write is not before
        self._spent = SpentBytes(node.loop.time())
        self._has_failed = self._is_closed = False

    def add(self, event: PastEvent) -> None:
        """Have an event written soon."""
        self._unwritten.append(event)
        self._wake()

    def _wake(self) -> None:
        """In nobody's name: whoever told the event may be an actor in its turn."""
        if self._timer is None and not self._is_closed:
            loop = self._node.loop
            delay = max(0.0, self._due - loop.time())
            self._timer = loop.call_later(delay, self._write, context=self._node.base_context.copy())

    def stored(self) -> list[PastEvent]:
        """What the store has, and what it is to have soon."""
        return [*stored(self._store), *self._unwritten]

    def forget(self, is_meant: Callable[[PastEvent], bool]) -> None:
        """Have the store forget the events that are meant.

        Raises:
            HoldfastError: it refuses; it may be tried again.
        """
        left = [event for event in self._unwritten if not is_meant(event)]
        self._unwritten.clear()
        self._unwritten.extend(left)
        for name, shelf in self._shelves.items():
            shelf.forget(self._store.notes(prefix(name)), is_meant)

    def _write(self) -> None:
        self._timer = None
        events, written = list(self._unwritten), 0
        self._unwritten.clear()
        try:
            for name, shelf in self._shelves.items():
                wanted = [event for event in events if track_of(event.kind) == name]
                if wanted:
                    written += shelf.put(wanted)
        except HoldfastError as error:
            self._due = self._node.loop.time() + RETRY
            self._unwritten.extend(events)
            self._wake()
            if not self._has_failed:
                self._has_failed = True
                self._node.emit(HistoryNotKept(f"/{self._node.name}", str(error)))
        else:
            now, self._has_failed = self._node.loop.time(), False
            self._due = now + self._spent.add(written, now)

    def close(self) -> None:
        """Write what is left; a store that refuses now is not told of any more."""
        self._is_closed = True
        if self._timer is not None:
            self._timer.cancel()
        self._has_failed = True
        if self._unwritten:
            self._write()
