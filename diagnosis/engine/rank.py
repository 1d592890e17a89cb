"""Which diagnosis comes first.

Fewer components first; among these, what was just repaired last, so that a repair that did not help is not tried for
ever (O3); then the likelier by prior fault probabilities; then software before hardware: it is quicker to restart a
driver than to switch a robot's base off (T54).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

from ..model import Component


class Key(NamedTuple):
    """Compared from left to right; less comes first. Keys of sets without common members add up."""

    size: int = 0
    repaired: int = 0
    unlikeliness: float = 0.0
    hardware: int = 0

    def plus(self, other: Key) -> Key:
        """The key of both sets together."""
        return Key(
            self.size + other.size,
            self.repaired + other.repaired,
            self.unlikeliness + other.unlikeliness,
            self.hardware + other.hardware,
        )


Ranked = tuple[Key, tuple[int, ...]]


class Ranking:
    """The keys of a model's components."""

    def __init__(self, components: Sequence[Component], repaired: Collection[str]) -> None:
        self._keys = [
            Key(1, int(component.name in repaired), unlikeliness(component.prior), int(component.kind.is_hardware))
            for component in components
        ]

    def rank(self, sets: Sequence[tuple[int, ...]]) -> list[Ranked]:
        """The sets with their keys, best first."""
        return sorted((self.key(members), members) for members in sets)

    def key(self, members: tuple[int, ...]) -> Key:
        """The key of one set."""
        keys = self._keys
        if len(members) == 1:
            return keys[members[0]]
        parts = [keys[member] for member in members]
        # Rounded, so that the order of the sum makes no difference between equals.
        odds = round(math.fsum(part.unlikeliness for part in parts), 9)
        return Key(len(parts), sum(part.repaired for part in parts), odds, sum(part.hardware for part in parts))


def unlikeliness(prior: float) -> float:
    """How much less likely "faulty" is than "works", as the logarithm of the odds; adds up over components."""
    return round(math.log((1 - prior) / prior), 9)


def combine(parts: Sequence[list[Ranked]], limit: int) -> list[Ranked]:
    """The best `limit` unions of one set of each part; each part is sorted already."""
    combined: list[Ranked] = [(Key(), ())]
    for part in parts:
        combined = _pairs(combined, part, limit)
    return combined


def _pairs(left: list[Ranked], right: list[Ranked], limit: int) -> list[Ranked]:
    """Best first, without making all pairs: a pair is looked at only after those that are better for sure."""
    if len(left) == 1:
        (key, members) = left[0]
        return [(key.plus(other), (*members, *more)) for other, more in right[:limit]]
    if not left or not right:
        return []

    def pair(i: int, j: int) -> tuple[Key, tuple[int, ...], tuple[int, ...], int, int]:
        return left[i][0].plus(right[j][0]), left[i][1], right[j][1], i, j

    best: list[Ranked] = []
    heap = [pair(0, 0)]
    while heap and len(best) < limit:
        key, members, more, i, j = heapq.heappop(heap)
        best.append((key, (*members, *more)))
        if j + 1 < len(right):
            heapq.heappush(heap, pair(i, j + 1))
        if j == 0 and i + 1 < len(left):
            heapq.heappush(heap, pair(i + 1, 0))
    return best
