"""Labels whose number is bounded, and the histograms and counters that are kept between two scrapes."""

from __future__ import annotations

import bisect
import threading
from collections.abc import Iterable, Sequence

OTHER = "other"
"""The label of all that there was no place for any more."""


class Labels:
    """The values of one label: the first `most` keep their names, and all that come later are one.

    Without a limit each new address would be a new time series, which the monitoring keeps for months.
    """

    def __init__(self, most: int, chosen: Sequence[str] = ()) -> None:
        self._most, self._known = most, set(chosen)

    def of(self, value: str) -> str:
        """The label of a value: itself, or "other" if it came too late."""
        if value in self._known:
            return value
        if len(self._known) >= self._most:
            return OTHER
        self._known.add(value)
        return value


class Tallies:
    """Counters of one family, by the values of their labels.

    Args:
        known: labels that are counted from 0 on; others come with the first count.
    """

    def __init__(self, known: Iterable[tuple[str, ...]] = ()) -> None:
        self._counts: dict[tuple[str, ...], float] = dict.fromkeys(known, 0.0)

    def add(self, *labels: str, by: float = 1) -> None:
        """Count once more, or by so much."""
        self._counts[labels] = self._counts.get(labels, 0.0) + by

    def values(self) -> dict[tuple[str, ...], float]:
        """The counts so far, by labels."""
        return dict(self._counts)


class Spread:
    """A histogram: how many values were at most so large, and their sum.

    Args:
        bounds: upper bounds of the buckets, rising.
        counts: how many values were in each so far, and how many were larger than all bounds; left out, none.
        total: their sum so far.
    """

    def __init__(self, bounds: Sequence[float], counts: Sequence[int] = (), total: float = 0.0) -> None:
        self.bounds = tuple(bounds)
        self._counts = list(counts) or [0] * (len(bounds) + 1)
        self._sum = total
        self._lock = threading.Lock()  # A store is called in threads, too.

    def add(self, value: float) -> None:
        """Count a value in its bucket."""
        with self._lock:
            self._counts[bisect.bisect_left(self.bounds, value)] += 1
            self._sum += value

    def buckets(self) -> tuple[list[tuple[str, float]], float]:
        """The values up to each bound, as Prometheus wants them, and their sum."""
        with self._lock:
            counts, total = list(self._counts), self._sum
        found: list[tuple[str, float]] = []
        so_far = 0
        for bound, count in zip((*map(str, self.bounds), "+Inf"), counts, strict=True):
            so_far += count
            found.append((bound, so_far))
        return found, total
