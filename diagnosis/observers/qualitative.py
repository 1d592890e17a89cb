"""The trend of a value: `inc(v)`, `dec(v)` or `const(v)` (D22)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from ..literals import Literal, const, dec, inc
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
