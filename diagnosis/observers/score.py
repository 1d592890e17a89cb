"""An observer that scores published messages; their average must be high enough."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from ..literals import Literal, atom_of, ok
from .observer import Manner, Observer
from .verdicts import Limits, Read, Smooth, reader


class ScoreObserver(Observer):
    """Says whether the average score of a topic's messages is good. Unknown while none come.

    Args:
        topic: what it hears.
        score: where the score is in a message, or a function that gives it, such as the share of valid points in a
            scan.
        limits: of the average.
        weight: of each new message in the average.
        least: messages before anything is said.
        atom: what is said; `ok(topic)` unless given.
        manner: see `Observer`.
    """

    def __init__(
        self,
        topic: str,
        score: Read,
        limits: Limits,
        *,
        weight: float = 0.1,
        least: int = 5,
        atom: Literal | str | None = None,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(topic, manner=manner)
        self._score, self._limits, self._weight, self._least = reader(score), limits, weight, least
        self._atom = ok(topic) if atom is None else atom_of(atom)
        self._last = 0.0
        self.afresh(())

    def afresh(self, names: Collection[str]) -> None:
        """Forget the scores, so that the average begins anew."""
        self._average, self._count = Smooth(self._weight), 0

    def hear(self, topic: str, message: Any) -> None:
        """Score one more message of the topic."""
        score = self._score(message)
        if score is None:
            return
        self._count, self._last = self._count + 1, self.now
        average = self._average(score)
        if self._count >= self._least:
            self.verdict(self._atom, self._limits.holds(average, self.said(self._atom)))

    def look(self) -> None:
        """Scores from long ago say nothing."""
        if self.now - self._last > self.manner.time_to_live:
            self.verdict(self._atom, None)
