"""Ranks diagnoses: which one comes first.

Fewer components first; among these, what was just repaired last, so that a repair that did not help is not tried for
ever (O3); then the likelier by prior fault probabilities; then software before hardware: it is quicker to restart a
driver than to switch a robot's base off (T54).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

from ..model import Component
from .breath import breathing


class Key(NamedTuple):
    """Compared from left to right; less comes first. Keys of sets without common members add up (`total`)."""

    size: int = 0
    repaired: int = 0
    unlikeliness: float = 0.0
    hardware: int = 0


Ranked = tuple[Key, tuple[int, ...]]


class Ranking:
    """The keys of a model's components."""

    def __init__(self, components: Sequence[Component], repaired: Collection[str]) -> None:
        self._components, self._repaired = components, repaired
        self._keys: dict[int, Key] = {}

    def singles(self, members: Sequence[int]) -> list[Ranked]:
        """Each member as a set of its own, best first."""
        return sorted((self._key(member), (member,)) for member in members)

    def set(self, members: Sequence[int]) -> Ranked:
        """The members as one set."""
        return total([self._key(member) for member in members]), tuple(members)

    def _key(self, member: int) -> Key:
        key = self._keys.get(member)
        if key is None:
            component = self._components[member]
            is_hardware, is_repaired = component.kind.is_hardware, component.name in self._repaired
            key = self._keys[member] = Key(1, int(is_repaired), unlikeliness(component.prior), int(is_hardware))
        return key


def total(keys: Sequence[Key]) -> Key:
    """The key of a set from those of its parts."""
    if len(keys) == 1:
        return keys[0]
    sizes, repaired, odds, hardware = zip(*keys, strict=True) if keys else ((), (), (), ())
    # Rounded, so that the order of the sum makes no difference between equals.
    return Key(sum(sizes), sum(repaired), round(math.fsum(odds), 9), sum(hardware))


def unlikeliness(prior: float) -> float:
    """How much less likely "faulty" is than "works", as the logarithm of the odds; adds up over components."""
    return round(math.log((1 - prior) / prior), 9)


def products(lists: Sequence[list[Ranked]]) -> Iterator[Ranked]:
    """All unions of one set of each list, best first, made one by one; the lists are sorted already."""
    fixed = [choices[0] for choices in lists if len(choices) == 1]
    open_ = [choices for choices in lists if len(choices) != 1]
    if not all(open_):
        return
    base = [total([key for key, _ in fixed])] if fixed else []
    members = tuple(member for _, some in fixed for member in some)

    def at(places: tuple[int, ...]) -> tuple[Key, tuple[int, ...]]:
        return total([*base, *(choices[place][0] for choices, place in zip(open_, places, strict=True))]), places

    heap = [at((0,) * len(open_))]
    while heap:
        key, places = heapq.heappop(heap)
        chosen = (choices[place][1] for choices, place in zip(open_, places, strict=True))
        yield key, (*members, *(member for some in chosen for member in some))
        # Only from the last place that has moved onwards, so that each combination is reached in one way.
        moved = max((number for number, place in enumerate(places) if place), default=0)
        for number in range(moved, len(places)):
            if places[number] + 1 < len(open_[number]):
                heapq.heappush(heap, at((*places[:number], places[number] + 1, *places[number + 1 :])))


def merged(rows: Iterable[Iterator[Ranked]], limit: int) -> list[Ranked]:
    """The best `limit` of all rows, each of which is sorted."""
    heap: list[tuple[Key, int, Ranked, Iterator[Ranked]]] = []
    for number, row in enumerate(breathing(rows, 32)):
        first = next(row, None)
        if first is not None:
            heap.append((first[0], number, first, row))
    heapq.heapify(heap)
    best: list[Ranked] = []
    for _ in breathing(range(limit), 64):
        if not heap:
            break
        _, number, chosen, row = heap[0]
        best.append(chosen)
        following = next(row, None)
        if following is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following[0], number, following, row))
    return best
