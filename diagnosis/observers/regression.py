"""The trend of a value: linear regression over a sliding window, O(1) per sample."""

from __future__ import annotations

import math
from collections import deque

import msgspec


class Fit(msgspec.Struct, frozen=True):
    """A line through a window: its slope per second, and the standard error of that."""

    slope: float
    error: float


class Regression:
    """Least squares over the samples of the last `window` seconds, by sums that slide along.

    Sums of large numbers lose digits: they are made anew, about the oldest sample, once per window's worth of samples,
    so that the cost of a sample stays constant on average.

    Args:
        window: seconds, > 0.
        most: samples that are kept; of more in a window, the oldest are left out.

    >>> line = Regression(2.0)
    >>> for second in range(5):
    ...     line.add(float(second), 3.0 * second)
    >>> line.fit().slope
    3.0
    """

    def __init__(self, window: float, most: int = 10_000) -> None:
        if not window > 0 or most < 3:
            raise ValueError(f"window {window!r} must be > 0 seconds, and most {most!r} 3 or more")
        self.window, self._most = window, most
        self._samples: deque[tuple[float, float]] = deque()
        self._slid = 0
        self._is_full = False
        self._recentre()

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def is_full(self) -> bool:
        """Whether samples reach over the whole window: before, a trend would be a guess."""
        return self._is_full and len(self._samples) >= 3

    def add(self, time: float, value: float) -> None:
        """One sample, not older than the last one; others are left out."""
        if self._samples and time < self._samples[-1][0]:
            return
        self.forget(time)
        if not self._samples:
            self._recentre((time, value))
        self._samples.append((time, value))
        self._count(time, value, 1)
        if len(self._samples) > self._most:
            self._is_full = True
            self._slide()
        if self._slid > len(self._samples):
            self._recentre()

    def forget(self, now: float) -> None:
        """Leave out what is older than the window."""
        if self._samples and now - self._samples[-1][0] > self.window:  # A gap: what comes after it begins anew.
            self.clear()
        while self._samples and self._samples[0][0] < now - self.window:
            self._is_full = True
            self._slide()

    def clear(self) -> None:
        """Forget all samples of the value."""
        self._samples.clear()
        self._is_full = False
        self._recentre()

    def fit(self) -> Fit | None:
        """The line through the window; None if the samples determine none."""
        n = len(self._samples)
        if n < 3:
            return None
        spread = self._tt - self._t * self._t / n
        if not spread > 0:
            return None
        slope = (self._ty - self._t * self._y / n) / spread
        left = self._yy - self._y * self._y / n - slope * slope * spread
        return Fit(slope, math.sqrt(max(left, 0.0) / (n - 2) / spread))

    def _slide(self) -> None:
        time, value = self._samples.popleft()
        self._count(time, value, -1)
        self._slid += 1

    def _count(self, time: float, value: float, sign: int) -> None:
        t, y = time - self._origin[0], value - self._origin[1]
        self._t += sign * t
        self._y += sign * y
        self._tt += sign * t * t
        self._ty += sign * t * y
        self._yy += sign * y * y

    def _recentre(self, origin: tuple[float, float] = (0.0, 0.0)) -> None:
        self._origin = self._samples[0] if self._samples else origin
        self._t = self._y = self._tt = self._ty = self._yy = 0.0
        self._slid = 0
        for time, value in self._samples:
            self._count(time, value, 1)
