"""Turns samples into stable verdicts: limits with hysteresis, filters, and n of m (T52)."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeAlias, TypeVar

import msgspec

T = TypeVar("T")

Read: TypeAlias = str | Callable[[Any], Any]
"""Where a value is in a message: a path such as `pose.x` or `values.0`, or a function."""
Filter: TypeAlias = Callable[[float], float]


class Agreement(msgspec.Struct, frozen=True):
    """A verdict changes when `least` of the last `of` samples say so.

    Raises:
        ValueError: not 1 <= least <= of.
    """

    least: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.least <= self.of:
            raise ValueError(f"{self.least} of {self.of}: there must be 1 <= least <= of")


class Debounce(Generic[T]):
    """Lets a change through when enough samples agree.

    >>> debounce = Debounce[str](Agreement(2, 3))
    >>> [debounce(word) for word in ("a", "a", "b", "a", "b", "b")]
    [None, 'a', 'a', 'a', 'b', 'b']
    """

    def __init__(self, agreement: Agreement) -> None:
        self._least = agreement.least
        self._votes: deque[T] = deque(maxlen=agreement.of)
        self.settled: T | None = None

    def __call__(self, vote: T | None) -> T | None:
        """The verdict after one more sample; None, "unknown", counts at once and is forgotten with all before."""
        if vote is None:
            self.clear()
            return None
        self._votes.append(vote)
        if vote != self.settled and self._votes.count(vote) >= self._least:
            self.settled = vote
        return self.settled

    def clear(self) -> None:
        """Forget the samples that were counted so far."""
        self._votes.clear()
        self.settled = None


class Limits(msgspec.Struct, frozen=True):
    """Values that are good: above `low` and below `high`. One that was bad is good again only `hysteresis` further in.

    >>> limits = Limits(high=40.0, hysteresis=2.0)
    >>> limits.holds(39.0, True), limits.holds(39.0, False), limits.holds(37.0, False)
    (True, False, True)
    """

    low: float = -math.inf
    high: float = math.inf
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        if not self.low + self.hysteresis < self.high - self.hysteresis or self.hysteresis < 0:
            raise ValueError(f"nothing is between {self.low:g} and {self.high:g} with hysteresis {self.hysteresis:g}")

    def holds(self, value: float, was: bool | None = None) -> bool:
        """Say whether the value is good; `was` is the verdict before, if there is one."""
        margin = self.hysteresis if was is False else 0.0
        return self.low + margin < value < self.high - margin


class Median:
    """The median of the last `size` values: single outliers do not count.

    >>> median = Median(3)
    >>> [median(value) for value in (1.0, 1.0, 99.0, 1.0)]
    [1.0, 1.0, 1.0, 1.0]
    """

    def __init__(self, size: int) -> None:
        self._values: deque[float] = deque(maxlen=size)

    def __call__(self, value: float) -> float:
        self._values.append(value)
        return statistics.median(self._values)


class Smooth:
    """An exponential average: each new value counts `weight`, 0 to 1.

    >>> smooth = Smooth(0.5)
    >>> smooth(0.0), smooth(8.0), smooth(8.0)
    (0.0, 4.0, 6.0)
    """

    def __init__(self, weight: float) -> None:
        if not 0 < weight <= 1:
            raise ValueError(f"weight is {weight!r}; it must be > 0 and <= 1")
        self._weight, self._value = weight, math.nan

    def __call__(self, value: float) -> float:
        old = self._value
        self._value = value if math.isnan(old) else old + self._weight * (value - old)
        return self._value


def reader(read: Read) -> Callable[[Any], float | None]:
    """A function that takes a value out of a message; what is not there, or no finite number, is None.

    >>> reader("cpu.0")({"cpu": [41.5]}), reader("cpu.temperature")({"cpu": [41.5]})
    (41.5, None)
    """
    find = read if callable(read) else _finder(tuple(read.split(".")))

    def number(message: Any) -> float | None:
        found = find(message)
        if not isinstance(found, (int, float)):
            return None
        return float(found) if math.isfinite(found) else None

    return number


def _finder(path: tuple[str, ...]) -> Callable[[Any], Any]:
    def find(message: Any) -> Any:
        for name in path:
            message = _part(message, name)
        return message

    return find


def _part(whole: Any, name: str) -> Any:
    if isinstance(whole, Mapping):
        return whole.get(name)
    if isinstance(whole, Sequence) and not isinstance(whole, str) and name.lstrip("-").isdigit():
        index = int(name)
        return whole[index] if -len(whole) <= index < len(whole) else None
    return getattr(whole, name, None)
