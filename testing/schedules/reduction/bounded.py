"""The bounded search: every schedule in which at most so many times somebody is held up, fewest first.

Whoever is held up comes again when nobody else could run. Most bugs need one or two such delays, and their number
bounds the search of a system whose schedules cannot all be tried. It asks nothing of what the actors share.

Source: delay-bounded scheduling: Emmi, Qadeer, Rakamaric, POPL 2011; bounds that grow: CHESS, Musuvathi, Qadeer 2007.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

from ..choices import HOLD, Choices, RepeatHolds
from .search import SEED

Holds = tuple[tuple[int, int], ...]
"""At which choices how many of those in front are held up, in order."""


class HeldSchedule(RepeatHolds):
    """A run in which these are held up, and nobody else.

    Attributes:
        widths: of each choice up to the end of the test: how many could be held up there.
    """

    def __init__(self, holds: Holds) -> None:
        super().__init__(SEED, {HOLD: dict(holds)})
        self.given = holds
        self.widths: dict[int, int] = {}
        self._is_over = False

    def rank(self, order: Sequence[int]) -> int:
        if not self._is_over:
            self.widths[self.steps] = len(order) - 1
        return super().rank(order)

    def end(self) -> None:
        self._is_over = True

    def more(self) -> Iterator[Holds]:
        """The same with one hold more, none of them before the last one."""
        last, ranks = (self.given[-1][0] if self.given else 0), dict(self.given)
        for choice, width in self.widths.items():
            if choice >= last and (rank := ranks.get(choice, 0)) < width:
                yield tuple({**ranks, choice: rank + 1}.items())


class HoldBound:
    """One number of holds after the other, up to `most`."""

    def __init__(self, most: int) -> None:
        self._most, self._holds = most, 0
        self._present: deque[Holds] = deque([()])
        self._next: deque[Holds] = deque()
        self._is_over = False

    def choices(self, seed: int) -> Choices | None:
        return None if self._is_over else HeldSchedule(self._present[0])

    def learn(self, choices: Choices, trace: Sequence[tuple[str, str]]) -> None:
        assert isinstance(choices, HeldSchedule)
        self._present.popleft()
        if self._holds < self._most:
            self._next += choices.more()
        if not self._present:
            self._is_over = not self._next
            if self._next:
                self._holds += 1
                self._present, self._next = self._next, self._present

    def covered(self, runs: int) -> str:
        """What has been tried, in words."""
        if self._is_over:
            return f"all schedules with at most {in_words(self._most)}: {runs}, complete"
        done = f", all with at most {in_words(self._holds - 1)}" if self._holds else ""
        return f"{runs} schedules were tried{done}, and there are more with {in_words(self._holds)}"


def in_words(holds: int) -> str:
    """So many holds.

    >>> in_words(1), in_words(2)
    ('1 hold', '2 holds')
    """
    return f"{holds} hold{'' if holds == 1 else 's'}"
