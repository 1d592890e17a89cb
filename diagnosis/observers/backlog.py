"""Whether a mailbox only grows: more comes than is handled, and that does not end.

Nothing here knows how many messages are many. A mailbox is compared with what it has come back from before.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Final

SHORTEST: Final = 10.0
"""Seconds for which a mailbox may grow, whatever was usual."""
LONGER: Final = 4.0
"""Times the longest rise that has ended, after which one is too long."""
MORE: Final = 2
"""Times the most messages that were ever worked off, by which it must have grown."""
SLICE: Final = 0.5
"""Seconds of a slice of time at first; the longer a rise takes, the longer are its slices."""
SLICES: Final = 32
"""Slices of one rise that are kept; an even number."""
QUARTERS: Final = 4


@dataclasses.dataclass(slots=True)
class Backlog:
    """What was seen of the messages that wait at one actor.

    A burst makes the least that waits smaller from one quarter of the time to the next, however large it was. Where it
    becomes larger in each, more comes than is handled. A rise ends when half of it has been worked off.

    >>> backlog = Backlog()
    >>> for second in range(16):
    ...     backlog.take(1 + 5 * second, float(second))
    >>> backlog.has_grown
    True

    Attributes:
        trough, since: messages that waited when this rise began, and when that was, in seconds of any clock.
        peak: most messages that have waited in it.
        worked_off: most messages by which it has ever become smaller before it rose again.
        longest: seconds of the longest rise that has ended.
        slices: the least that has waited in each slice of this rise, the oldest first.
        least: the least that has waited in this slice.
        ends: when this slice ends.
        slice: seconds of a slice.
        has_grown: it only grew, and has not become smaller since.
        is_empty: nothing waits.
    """

    trough: int = 0
    since: float | None = None
    peak: int = 0
    worked_off: int = 0
    longest: float = 0.0
    slices: list[int] = dataclasses.field(default_factory=list[int])
    least: int = 0
    ends: float = 0.0
    slice: float = SLICE
    has_grown: bool = False
    is_empty: bool = False

    def take(self, waiting: int, now: float) -> None:
        """Take down how many messages wait now: at `now` seconds, not before those of the last call."""
        self.is_empty = not waiting
        if waiting == self.trough == self.peak and not self.slices:  # As most are, at most times: nothing waits.
            self.since, self.least, self.ends = now, waiting, now + self.slice
            return
        if self.since is None:
            self._begin(waiting, now)
        self.peak = max(self.peak, waiting)
        self.worked_off = max(self.worked_off, self.peak - waiting)
        rise = self.peak - self.trough
        if waiting <= self.trough or MORE * (self.peak - waiting) >= rise:
            if rise > 0 and self.since is not None:
                self.longest = max(self.longest, now - self.since)
            self._begin(waiting, now)
            return
        self.least = min(self.least, waiting)
        if now >= self.ends:
            self._end_slice(waiting, now)

    def clear(self) -> None:
        """Forget what waits, such as after a restart; what was usual is kept."""
        self.since, self.has_grown, self.is_empty = None, False, False

    def _begin(self, waiting: int, now: float) -> None:
        self.trough = self.peak = self.least = waiting
        self.since, self.ends, self.slice = now, now + SLICE, SLICE
        self.slices, self.has_grown = [], False

    def _end_slice(self, waiting: int, now: float) -> None:
        self.slices.append(self.least)
        if len(self.slices) == SLICES:
            self.slices = [min(self.slices[at : at + 2]) for at in range(0, SLICES, 2)]
            self.slice *= 2
        self.least, self.ends = waiting, now + self.slice
        size = len(self.slices) // QUARTERS
        if size < 2:
            return
        kept = self.slices[-QUARTERS * size :]
        lows = [min(kept[at : at + size]) for at in range(0, len(kept), size)]
        is_larger = all(one < other for one, other in itertools.pairwise(lows))
        assert self.since is not None  # a slice ends in a rise
        is_long = now - self.since > max(SHORTEST, LONGER * self.longest)
        still_rises = self.slices[-1] == max(self.slices)
        has_grown = is_larger and still_rises and is_long and lows[-1] - self.trough > MORE * self.worked_off
        self.has_grown = has_grown or (self.has_grown and lows[-1] >= lows[-2])
