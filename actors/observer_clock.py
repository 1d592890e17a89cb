"""A clock for observers that wait for others: it stands still while the observer itself is late (T3)."""

from __future__ import annotations


class OwnClock:
    """Time as the observer has lived it: if it comes later than it meant to, the rest does not count.

    A late observer hears everything late. What it was late itself is no silence of others.
    """

    def __init__(self, now: float, period: float) -> None:
        self._real, self._own, self._period = now, 0.0, period
        self.lag = 0.0  # all that was taken out so far

    def tick(self, now: float) -> float:
        """The observer looks; it meant to look again after one period. Returns the time on this clock."""
        late = max(0.0, now - self._real - self._period)
        self.lag += late
        self._own += max(0.0, now - self._real) - late
        self._real = now
        return self._own

    def look_every(self, period: float) -> None:
        """It means to look so often from now on."""
        self._period = period

    def at(self, now: float) -> float:
        """The time on this clock between two looks."""
        return self._own + min(max(0.0, now - self._real), self._period)
