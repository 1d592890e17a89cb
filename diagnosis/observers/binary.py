"""Two trends that should be alike: `matched(v1,v2)` (D23)."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import msgspec

from ..literals import matched
from .observer import Manner, Observer
from .regression import Regression
from .verdicts import Read, reader


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
