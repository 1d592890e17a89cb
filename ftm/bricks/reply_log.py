"""The reply log: the outcome of each request, so that a duplicate is answered and not run again (A46, T5).

It is part of the replicated state, and bounded: who asks for an outcome that was evicted is told so, never run again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

from ...checkpoint.protocol import STASHED, TurnEnd
from .brick_messages import Logged

CAPACITY = 4096
"""Outcomes that are kept: several times what can be on its way home at a time."""


class ReplyLog:
    """Outcomes by the number of the request, oldest first."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._slack = capacity // 16
        self._entries: dict[int, Logged] = {}
        self._evicted: set[int] = set()
        self._floor = -1  # all below it that are not in `_holes` were evicted
        self.duplicates = 0

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, entries: Iterable[Logged]) -> None:
        """Outcomes, in turn order; a later one of the same request (it was stashed) takes the place of the first."""
        log = self._entries
        for entry in entries:
            number = entry[2]
            if number in log:
                del log[number]
            log[number] = entry
        if len(log) > self._capacity + self._slack:
            # Several at once: to look for the first of a dict takes as long as all that was taken out before it.
            for number in list(itertools.islice(log, len(log) - self._capacity)):
                del log[number]
                self._evict(number)

    def _evict(self, number: int) -> None:
        evicted = self._evicted
        evicted.add(number)
        while self._floor + 1 in evicted:  # Numbers have few gaps: what is remembered stays small.
            self._floor += 1
            evicted.discard(self._floor)
        if len(evicted) > 4 * self._capacity:  # Inputs that never came to a turn have left gaps.
            self._floor = min(evicted)
            evicted.discard(self._floor)

    def find(self, number: int, turn: int = -1) -> TurnEnd | None:
        """The outcome of a request, if it is there; `turn` is the one that it is replayed for.

        What was put aside in one turn, and handled in another, is replayed for both: an earlier outcome is not its own.
        """
        entry = self._entries.get(number)
        return None if entry is None or entry[3].turn < turn else entry[3]

    def was_evicted(self, number: int) -> bool:
        """Whether a request was handled so long ago that its outcome is not kept."""
        return number <= self._floor or number in self._evicted

    def is_stashed(self, number: int) -> bool:
        """Whether a request was put aside by its turn."""
        entry = self._entries.get(number)
        return entry is not None and entry[3].status == STASHED

    def entries(self) -> list[Logged]:
        """All of it, for another replica."""
        return list(self._entries.values())

    def replace(self, entries: Iterable[Logged]) -> None:
        """Take over the log of another replica."""
        self._entries = {entry[2]: entry for entry in entries}
        self._evicted.clear()
        self._floor = min(self._entries, default=-1) - 1 if len(self._entries) >= self._capacity else -1
