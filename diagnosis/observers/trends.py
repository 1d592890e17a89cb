"""Trends of values: `inc(v)`, `dec(v)` or `const(v)` (D22), and whether two are alike: `matched(v1,v2)` (D23)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import msgspec

from ..literals import Literal, const, dec, inc, matched
from .observer import Manner, Observer
from .regression import Fit, Regression
from .verdicts import Filter, Read, reader


def trend(value: str, fit: Fit, slope: float, significance: float = 0.0) -> Literal | None:
    """The trend that a line shows; None if it is too uncertain to say.

    Args:
        value: its name.
        fit: the line.
        slope: per second; a line that is steeper rises or falls.
        significance: by how many standard errors it must be steeper, or flatter.

    >>> str(trend("yaw", Fit(0.5, 0.0), 0.1)), trend("yaw", Fit(0.12, 0.05), 0.1, 2.0)
    ('inc(yaw)', None)
    """
    margin = significance * fit.error
    if abs(fit.slope) + margin <= slope:
        return const(value)
    if fit.slope - margin > slope:
        return inc(value)
    if fit.slope + margin < -slope:
        return dec(value)
    return None


class QualitativeObserver(Observer):
    """Says how a value moves. Unknown until there are samples over the whole window, and while none come.

    Args:
        value: its name in the model.
        topic: where it is published.
        read: where it is in a message.
        slope: per second; what is less steep is constant.
        window: seconds.
        significance: see `trend`.
        filter: makes a filter that the values go through.
        manner: see `Observer`.
    """

    def __init__(
        self,
        value: str,
        topic: str,
        read: Read,
        *,
        slope: float,
        window: float,
        significance: float = 0.0,
        filter: Callable[[], Filter] | None = None,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(topic, manner=manner)
        if not slope > 0:
            raise ValueError(f"slope is {slope!r}; a value that is quite constant is never seen: it must be > 0")
        self._value, self._read, self._slope, self._significance = value, reader(read), slope, significance
        self._line = Regression(window)
        self._new_filter = filter
        self._filter = filter() if filter is not None else None

    def hear(self, topic: str, message: Any) -> None:
        """Take in one sample of the value."""
        value = self._read(message)
        if value is not None:
            self._line.add(self.now, value if self._filter is None else self._filter(value))

    def afresh(self, names: Collection[str]) -> None:
        """A line through before and after would be neither's."""
        self._line.clear()
        self._filter = self._new_filter() if self._new_filter is not None else None

    def look(self) -> None:
        """Say which trend the value has now."""
        self._line.forget(self.now)
        fit = self._line.fit() if self._line.is_full else None
        said = None if fit is None else trend(self._value, fit, self._slope, self._significance)
        self.say(inc(self._value), said)


class Source(msgspec.Struct, frozen=True):
    """A value: its name in the model, its topic, and where it is in a message."""

    value: str
    topic: str
    read: Read


class BinaryQualitativeObserver(Observer):
    """Compares the slopes of two values over the same window; unknown while either is.

    Args:
        one, other: the values.
        tolerance: by how much the slopes may differ, per second.
        window: seconds.
        significance: by how many standard errors they must differ more, or less, to be believed.
        manner: see `Observer`.
    """

    def __init__(
        self,
        one: Source,
        other: Source,
        *,
        tolerance: float,
        window: float,
        significance: float = 0.0,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(one.topic, other.topic, manner=manner)
        if not tolerance > 0:
            raise ValueError(f"tolerance is {tolerance!r}; it must be > 0")
        self._atom = matched(one.value, other.value)
        self._tolerance, self._significance = tolerance, significance
        self._lines = [(source.topic, reader(source.read), Regression(window)) for source in (one, other)]

    def hear(self, topic: str, message: Any) -> None:
        """A sample of one of them, or of both."""
        for its_topic, read, line in self._lines:
            if topic == its_topic and (value := read(message)) is not None:
                line.add(self.now, value)

    def afresh(self, names: Collection[str]) -> None:
        """A line through before and after would be neither's."""
        for _, _, line in self._lines:
            line.clear()

    def look(self) -> None:
        """Say whether the two trends are alike."""
        self.verdict(self._atom, self._are_alike())

    def _are_alike(self) -> bool | None:
        fits = []
        for _, _, line in self._lines:
            line.forget(self.now)
            fit = line.fit() if line.is_full else None
            if fit is None:
                return None
            fits.append(fit)
        apart = abs(fits[0].slope - fits[1].slope)
        margin = self._significance * (fits[0].error ** 2 + fits[1].error ** 2) ** 0.5
        if apart + margin <= self._tolerance:
            return True
        return False if apart - margin > self._tolerance else None
