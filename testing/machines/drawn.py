"""A schedule that Hypothesis draws, so that a failing example shrinks its rules and its schedule together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from hypothesis import strategies as st

from ..schedules.choices import ROUNDS, RepeatHolds

if TYPE_CHECKING:
    from hypothesis.internal.conjecture.data import ConjectureData

PAUSES: Final = (None, 0, 1, 2, 3, 5, 8, 13)
"""How many rounds of the loop the system goes on after a step of a machine; None: until it is idle."""
HOLDS: Final = 4
"""In one step so many times somebody is held up, at most."""
SEEDS: Final = st.integers(0, 2**16 - 1)
LEVELS: Final = st.integers(0, len(PAUSES) - 1)
GAPS: Final = st.integers(0, 24)
"""Choices until somebody is held up; 0: nobody is in this step any more."""
RANKS: Final = st.integers(1, 3)


class Drawn(RepeatHolds):
    """Draws who is held up, and when, and how long each step lasts. The simplest schedule is production's.

    Args:
        data: what an example of Hypothesis draws from.
    """

    def __init__(self, data: ConjectureData) -> None:
        self._data = data
        self._plan: list[tuple[int, int]] = []
        self._is_over = False
        super().__init__(self._drawn(SEEDS), {})

    def begin(self) -> None:
        """A step of the machine begins: draw now who is held up in it.

        In the middle of it nothing is drawn: Hypothesis ends an example by what it raises there, and that would be in
        the midst of the system's own code.
        """
        self._plan = []
        while not self._is_over and len(self._plan) < HOLDS and (gap := self._drawn(GAPS)):
            self._plan.append((gap, self._drawn(RANKS)))
        self._plan.reverse()

    def end(self) -> None:
        self._is_over = True
        self._plan = []

    def rank(self, order: Sequence[int]) -> int:
        if not self._plan:
            return 0
        gap, rank = self._plan.pop()
        if gap > 1:
            self._plan.append((gap - 1, rank))
            return 0
        return min(rank, len(order) - 1)

    def redrawn(self, kind: str, number: int, count: int, proposed: int) -> int:
        if kind == ROUNDS and not self._is_over:
            return self._drawn(LEVELS)
        return proposed  # Faults and delays are drawn by odds of their own, from the seed.

    def _drawn(self, strategy: st.SearchStrategy[int]) -> int:
        drawn: Any = self._data.draw(strategy)
        return int(drawn)
