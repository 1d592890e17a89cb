"""Charts of histories: a line for each operation, from its invocation to its outcome."""

from __future__ import annotations

import itertools
import math
import reprlib
from collections.abc import Sequence
from typing import Final

from .history import UNKNOWN, Operation

SHOWN: Final = 24
"""Operations that are shown, beside those that contradict each other."""
WIDTH: Final = 48
"""Characters of a line of time."""
BRIEF: Final = reprlib.Repr()
BRIEF.maxother = BRIEF.maxstring = BRIEF.maxtuple = 100


def as_chart(operations: Sequence[Operation], marked: Sequence[Operation] = (), order: Sequence[Operation] = ()) -> str:
    """Operations in the order in which they were invoked, as a text.

    Args:
        operations: what is shown; of many the last ones.
        marked: get a `*`.
        order: get the number of their place.
    """
    places = {id(one): place for place, one in enumerate(order, 1)}
    stars = {id(one) for one in marked}
    listed = sorted(operations, key=lambda one: (one.start, one.end))
    shown = [one for place, one in enumerate(listed) if place >= len(listed) - SHOWN or id(one) in stars]
    if not shown:
        return "  (nothing)"
    columns = _columns(shown)
    width = max(columns.values()) + 1
    names = max(len(one.client) for one in shown)
    at = max(len(_time(one)) for one in shown)
    digits = len(str(len(order)))
    lines = [f"  ... {len(listed) - len(shown)} of {len(listed)} are not shown"] if len(shown) < len(listed) else []
    for one in shown:
        place = str(places.get(id(one), "-")) if order else ""
        bar = _bar(columns[one.start], columns.get(one.end, width), width)
        outcome = "?" if one.outcome is UNKNOWN else BRIEF.repr(one.outcome)
        lines.append(
            f"{'*' if id(one) in stars else ' '} {place:>{digits}} {_time(one):>{at}} {one.client:<{names}} "
            f"{bar}  {f'{one.to} ' if one.to else ''}{BRIEF.repr(one.message)} -> {outcome}"
        )
    if order:
        lines.append(
            "numbers: the longest order there is; - has no place in it; ?: nobody knows whether it took effect"
        )
    return "\n".join(lines)


def _time(one: Operation) -> str:
    return f"{one.at:.3f}"


def _columns(operations: Sequence[Operation]) -> dict[float, int]:
    """The column of each moment: as many as there are, or as fit."""
    moments = sorted({*itertools.chain.from_iterable((one.start, one.end) for one in operations)} - {math.inf})
    scale = min(1.0, (WIDTH - 1) / max(1, len(moments) - 1))
    return {moment: int(number * scale) for number, moment in enumerate(moments)}


def _bar(start: int, end: int, width: int) -> str:
    if end >= width:
        return f"{' ' * start}[{'~' * (width - start - 1)}"
    if end == start:
        return f"{' ' * start}|{' ' * (width - start - 1)}"
    return f"{' ' * start}[{'=' * (end - start - 1)}]{' ' * (width - end - 1)}"
