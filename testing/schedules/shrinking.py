"""Shrinking: the same failure with as few choices as possible that differ from what production would do.

Latencies go first, then faults, then turns: each kind as a whole, then in halves, quarters, and singly, as long as the
failure stays; what is left is all that it takes. Then each of these choices is made smaller, and comes earlier, if the
failure stays. Of schedules of equally few choices the one with the fewest turns wins, then that of the fewest actors,
then that of the smallest choices: latencies are as short as they may be. Source: delta debugging (Zeller and
Hildebrandt, IEEE TSE 2002).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

from .choices import DELAY, FAULT, HOLD, LATENCY, LOSS, MOMENT, TURN, Taken

SECONDS = 10.0
"""Real seconds that shrinking may take."""
RUNS = 1000
SMALLER = 100
"""Runs in which choices are made smaller, beside those in which they become fewer."""
ORDER = (LATENCY, FAULT, LOSS, DELAY, MOMENT, TURN, HOLD)

Item = tuple[str, int, int]
now = time.perf_counter
"""The real clock: that of a run is the seed's."""


class FailedRun(NamedTuple):
    """A run that fails: the choices that it has really made, and the turns and the actors that it took."""

    taken: Taken
    turns: int
    actors: int


class Best(NamedTuple):
    """A schedule that fails, and what it takes."""

    items: list[Item]
    turns: float
    actors: float

    @property
    def cost(self) -> tuple[float, ...]:
        """What makes it better than another: the smallest wins."""
        drawn = sum(choice for _, _, choice in self.items)
        return len(self.items), self.turns, self.actors, drawn, sum(number for _, number, _ in self.items)


class Shrinking:
    """The attempts to make one schedule smaller.

    Args:
        taken: one that fails.
        fails: runs a schedule. Returns what it took if it fails in the same way, or None.
        seconds: how long to try, on the real clock.
    """

    def __init__(self, taken: Taken, fails: Callable[[Taken], FailedRun | None], seconds: float) -> None:
        self.best = Best(_items(taken), float("inf"), float("inf"))
        self._fails, self._end, self._left = fails, now() + seconds, RUNS

    def goes_on(self) -> bool:
        """Whether there is time for another run."""
        return self._left > 0 and now() < self._end

    def is_better(self, items: list[Item]) -> bool:
        """Run a schedule; if it fails too, and is better, it is the best."""
        self._left -= 1
        made = self._fails(_taken(items))
        if made is None:
            return False
        found = _items(made.taken)
        candidate = Best(found if len(found) <= len(items) else items, made.turns, made.actors)
        if candidate.cost >= self.best.cost:
            return False
        self.best = candidate
        return True

    def make_fewer(self) -> None:
        """Leave out choices, in halves, quarters, and singly."""
        if not self.best.items or self.is_better([]):
            return
        for kind in ORDER:
            others = [item for item in self.best.items if item[0] != kind]
            if 0 < len(others) < len(self.best.items) and self.goes_on():
                self.is_better(others)
        size = max(1, len(self.best.items) // 2)
        while self.best.items and self.goes_on():
            at, shorter = 0, False
            while at < len(self.best.items) and self.goes_on():
                best = self.best.items
                if self.is_better(best[:at] + best[at + size :]):
                    shorter = True
                else:
                    at += size
            if not shorter:
                if size == 1:
                    break
                size = max(1, size // 2)

    def make_smaller(self) -> None:
        """Make each choice smaller and earlier."""
        self._left = min(self._left, SMALLER)
        for index in range(len(self.best.items)):
            for part in (2, 1):
                if index < len(self.best.items):
                    self._lower(index, part)

    def _lower(self, index: int, part: int) -> None:
        """Make a part of one choice, its number or what was chosen, as small as it may be."""
        count, least = len(self.best.items), 0
        while self.goes_on() and index < len(self.best.items) == count:
            item = self.best.items[index]
            number = int(item[part])
            if number - least < 2:
                break
            middle = (least + number) // 2
            changed = (item[0], item[1], middle) if part == 2 else (item[0], middle, item[2])
            others = [other for place, other in enumerate(self.best.items) if place != index]
            if changed[:2] in {other[:2] for other in others} or not self.is_better(_items(_taken([*others, changed]))):
                least = middle


def shrink(taken: Taken, fails: Callable[[Taken], FailedRun | None], seconds: float = SECONDS) -> Taken:
    """The smallest schedule found that still fails; see `Shrinking`."""
    shrinking = Shrinking(taken, fails, seconds)
    shrinking.make_fewer()
    shrinking.make_smaller()
    return _taken(shrinking.best.items)


def _items(taken: Taken) -> list[Item]:
    """Later turns first: without them the rest is as in production, and the earlier ones keep their numbers."""
    return [
        (kind, number, choice) for kind in ORDER for number, choice in sorted(taken.get(kind, {}).items(), reverse=True)
    ]


def _taken(items: list[Item]) -> Taken:
    taken: Taken = {}
    for kind, number, choice in items:
        taken.setdefault(kind, {})[number] = choice
    return taken
