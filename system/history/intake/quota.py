"""The quota of the history: how many events it records in a storm of them, so that it takes no part in the storm."""

from __future__ import annotations


class EventQuota:
    """A bucket of tokens: it is full at first, and again after a quiet while.

    Args:
        burst: tokens in a full bucket.
        per_second: tokens that come each second.
        now: seconds on any clock that does not go back.

    >>> quota = EventQuota(2, 1.0, 0.0)
    >>> [quota.take(0.0), quota.take(0.0), quota.take(0.5), quota.take(1.5)]
    [True, True, False, True]
    """

    def __init__(self, burst: int, per_second: float, now: float) -> None:
        self._burst, self._per_second, self._then = float(burst), per_second, now
        self._left = float(burst)

    def take(self, now: float, *, least: float = 1.0, cost: float = 1.0) -> bool:
        """Take `cost` tokens, if at least `least` of them are there."""
        if now > self._then:
            self._left = min(self._burst, self._left + (now - self._then) * self._per_second)
            self._then = now
        if self._left < least:
            return False
        self._left -= cost
        return True

    def has(self, now: float, least: float) -> bool:
        """Whether so many tokens are there."""
        return self._left + max(0.0, now - self._then) * self._per_second >= min(least, self._burst)
