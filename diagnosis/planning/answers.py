"""The interface of planners: what they may use, and what they answer."""

from __future__ import annotations

import threading
import time
from typing import Protocol, TypeAlias

import msgspec

from .language import PlanLiteral, Problem


class Step(msgspec.Struct, frozen=True, order=True, array_like=True):
    """One action, done to these objects.

    >>> str(Step("power_up", ("ja",)))
    'power_up(ja)'
    """

    action: str
    args: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.action}({','.join(self.args)})"


class Plan(msgspec.Struct, frozen=True):
    """What to do.

    Attributes:
        stages: one after another; the steps of a stage may be done at the same time, and in any order.
        cost: the sum over all steps.
        is_optimal: there is no plan of fewer stages, and none cheaper among those of as many; False: not known.
        unmet: goals that were given up because they cannot be had.
    """

    stages: tuple[tuple[Step, ...], ...]
    cost: int = 0
    is_optimal: bool = True
    unmet: tuple[PlanLiteral, ...] = ()

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps, stage after stage."""
        return tuple(step for stage in self.stages for step in stage)


class Unsolvable(msgspec.Struct, frozen=True):
    """It is proven that no plan reaches these goals: none of them, if `is_each`; else not all of them together."""

    goals: tuple[PlanLiteral, ...]
    is_each: bool
    why: str


class TimedOut(msgspec.Struct, frozen=True):
    """No plan was found in time, or the planner gave up: whether there is one is not known."""

    seconds: float
    why: str = "the time was up"


Outcome: TypeAlias = Plan | Unsolvable | TimedOut


class OutOfTime(Exception):
    """The budget is used up; it never leaves a planner, which answers `TimedOut`."""


class Budget:
    """The time a planner has; it may be cut short from another thread."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._ends = time.monotonic() + seconds  # Real time: the thread computes, whatever the loop's clock says.
        self._cancelled = threading.Event()

    @property
    def left(self) -> float:
        """Seconds left, at least 0."""
        return 0.0 if self._cancelled.is_set() else max(0.0, self._ends - time.monotonic())

    def cancel(self) -> None:
        """Nobody waits for the answer any more."""
        self._cancelled.set()

    def check(self) -> None:
        """Raise OutOfTime if nothing is left."""
        if not self.left:
            raise OutOfTime


class Planner(Protocol):
    """Finds plans. Called in a worker thread, perhaps in several at a time."""

    def solve(self, problem: Problem, budget: Budget, /) -> Outcome:
        """A plan for all goals, the proof that there is none, or neither in time.

        It looks at the budget often enough to end soon after it: a thread cannot be stopped from outside.

        Raises:
            PlanningError: the problem is beyond what this planner takes.
        """
        ...
