"""Of parameters that are crossed, as few rows as have every pair of values that the product has.

What shows only in a process, or only in a process with one of the methods, a row for each pair shows; the product of
three or four parameters shows it many times over. The marker `pairs`, of a test or of a file, says that pairs do.
Of one parameter with many values whose tests take long, `some(n)` has so many run. `HOLDFAST_CROSSED=1` runs the
product, and all values.

Source: pairwise testing (Cohen et al., "The AETG System", IEEE TSE 1997).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence


def covering(rows: Sequence[tuple[int, ...]]) -> list[int]:
    """The numbers of some of the rows, in which all pairs of values occur that occur in all of them.

    Greedily: next is the first row of those that have the most pairs which no row has yet. The same rows have the same
    outcome. A row of fewer than two values is a pair with itself.
    """
    pairs = [
        {(*one, *other) for one, other in itertools.combinations_with_replacement(enumerate(row), 2)} | {()}
        for row in rows
    ]
    left = set[tuple[int, ...]]().union(*pairs)
    taken: list[int] = []
    while left:
        best = max(range(len(rows)), key=lambda number: len(pairs[number] & left))
        left -= pairs[best]
        taken.append(best)
    return sorted(taken)


def spread(count: int, some: int) -> list[int]:
    """The numbers of `some` of so many rows, spread evenly, with the first one.

    >>> spread(10, 4), spread(3, 5)
    ([0, 2, 5, 7], [0, 1, 2])
    """
    return [number * count // some for number in range(some)] if some < count else [*range(count)]
