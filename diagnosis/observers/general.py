"""The rate of a topic: `|f(t) - mean| < deviation` over a window means `ok(t)` (D19)."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections import deque
from collections.abc import Collection
from typing import Any, Final

from ..literals import Literal, atom_of, ok
from .observer import Manner, Observer

LEARNING: Final = 5
"""Windows from which a rate is learned that was not given."""
MOST: Final = 100_000
"""Messages of one window that are counted at most."""


@dataclasses.dataclass(slots=True)
class Learned:
    """The rate that an observer has learned; given to it, it outlives its lives.

    Who had to learn anew in a later life would take a topic that is silent by then for one that nobody knows.
    """

    mean: float | None = None
    deviation: float | None = None


class GeneralObserver(Observer):
    """Counts what comes on a topic, also nothing. Until the first window is over, nothing is known.

    Args:
        topic: what it hears.
        mean: messages per second; None learns it from the first five windows in which there were messages.
        deviation: by how much the rate may differ; half of the mean unless given, or what learning shows to be more.
        window: seconds over which messages are counted.
        learned: where to keep what was learned.
        atom: what is said; `ok(topic)` unless given.
        manner: see `Observer`.
    """

    def __init__(
        self,
        topic: str,
        mean: float | None = None,
        deviation: float | None = None,
        *,
        window: float = 2.0,
        learned: Learned | None = None,
        atom: Literal | str | None = None,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(topic, manner=manner)
        if (mean is not None and not mean > 0) or (deviation is not None and not deviation > 0) or not window > 0:
            raise ValueError(f"mean {mean!r}, deviation {deviation!r} and window {window!r} must be > 0")
        self._memory = learned or Learned()
        self._mean = self._memory.mean if mean is None else mean
        self._deviation = self._memory.deviation if deviation is None else deviation
        self._window = window
        self._atom = ok(topic) if atom is None else atom_of(atom)
        self._learned: list[float] = []
        self._next_lesson = 0.0
        self._since = -math.inf
        self._times: deque[float] = deque(maxlen=MOST)
        self._settle_limits()

    def _settle_limits(self) -> None:
        if self._mean is not None:
            self._tolerance = self._mean / 2 if self._deviation is None else self._deviation
            # One more than may come in a window is enough to know that it is too many.
            most = min(MOST, math.floor((self._mean + self._tolerance) * self._window) + 2)
            self._times = deque(self._times, maxlen=most)

    def hear(self, topic: str, message: Any) -> None:
        """Note when a message came on a topic."""
        self._times.append(self.now)

    def look(self) -> None:
        """Count the messages within the window, and say whether the rate is right."""
        now = self.now
        while self._times and self._times[0] <= now - self._window:
            self._times.popleft()
        rate = len(self._times) / self._window
        is_whole = now - max(self._since, self._began) >= self._window
        if self._mean is None and is_whole:
            self._learn(rate, now)
        if self._mean is not None:
            is_good = abs(rate - self._mean) < self._tolerance
            if is_good or is_whole:  # Of a part of a window enough is enough, but too little is not yet too little.
                self.verdict(self._atom, is_good)

    def afresh(self, names: Collection[str]) -> None:
        """Begin to count anew: what came before somebody acted would be counted for a window longer."""
        self._times.clear()
        self._since = self.now
        self.verdict(self._atom, None)

    def _learn(self, rate: float, now: float) -> None:
        if rate == 0 or now < self._next_lesson:
            return
        self._learned.append(rate)
        self._next_lesson = now + self._window
        if len(self._learned) == LEARNING:
            self._mean = statistics.fmean(self._learned)
            spread = 3 * statistics.pstdev(self._learned)
            if self._deviation is None and spread > self._mean / 2:
                self._deviation = min(spread, self._mean)  # With more, silence would be fine.
            self._memory.mean, self._memory.deviation = self._mean, self._deviation
            self._settle_limits()
