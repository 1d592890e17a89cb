"""Advice: what repair would have done, what happened instead, and how good the advice was."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final, NamedTuple

from ..planning import Step

RIGHT: Final = "right"
"""Somebody did what was advised, and the fault went."""
WRONG: Final = "wrong"
"""Somebody acted upon others, and the fault went."""
NEEDLESS: Final = "needless"
"""The fault went, and nobody had done anything."""


class Advice(NamedTuple):
    """A plan that was told of and not carried out, at `time` seconds on the loop clock."""

    time: float
    steps: tuple[Step, ...]


@dataclasses.dataclass(slots=True)
class Score:
    """How good the advice was, so that a person can decide to switch repair on.

    Attributes:
        right, wrong, needless: cases by what became of the advice.
        missed: restarts by order of components for which nothing was advised.
        seconds_saved: by which the advice came before somebody did what it said, all cases together.
    """

    right: int = 0
    wrong: int = 0
    needless: int = 0
    missed: int = 0
    seconds_saved: float = 0.0

    @property
    def precision(self) -> float | None:
        """The share of the advice that was right; None: there was none so far."""
        told = self.right + self.wrong + self.needless
        return self.right / told if told else None

    @property
    def recall(self) -> float | None:
        """The share of what people had to do that was advised; None: they did nothing so far."""
        needed = self.right + self.wrong + self.missed
        return self.right / needed if needed else None

    def add(self, verdict: str, saved: float) -> None:
        """One more case has ended."""
        self.right += verdict == RIGHT
        self.wrong += verdict == WRONG
        self.needless += verdict == NEEDLESS
        self.seconds_saved += saved


def judge_advice(advice: Advice, others: Mapping[str, float]) -> tuple[str, float]:
    """What became of advice when the fault has gone, and the seconds by which it came first.

    Args:
        advice: the last one of the case.
        others: when each component was started by somebody else, in seconds on the loop clock.

    >>> judge_advice(Advice(1.0, (Step("restart_child", ("a",)),)), {"a": 5.0})
    ('right', 4.0)
    """
    after = {name: when for name, when in others.items() if when >= advice.time}
    named = {step.args[0] for step in advice.steps if step.args}
    if hit := named & set(after):
        return RIGHT, min(after[name] for name in hit) - advice.time
    return (WRONG if after else NEEDLESS), 0.0
