"""Splits items into groups that share nothing with each other (union-find)."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import TypeVar

from .breath import breathing

T = TypeVar("T")


def connected(items: Sequence[T], keys_of: Callable[[T], Iterable[Hashable]]) -> list[list[T]]:
    """The items in groups of which no two have a key in common; groups and items in the order of the items.

    >>> connected(["ab", "c", "bd", "ce"], set)
    [['ab', 'bd'], ['c', 'ce']]
    """
    parent = list(range(len(items)))

    def root(number: int) -> int:
        while parent[number] != number:
            parent[number] = number = parent[parent[number]]
        return number

    owner: dict[Hashable, int] = {}
    for number, item in enumerate(breathing(items)):
        for key in keys_of(item):
            first = owner.setdefault(key, number)
            if first != number:
                parent[root(number)] = root(first)
    groups: dict[int, list[T]] = {}
    for number, item in enumerate(breathing(items)):
        groups.setdefault(root(number), []).append(item)
    return list(groups.values())
