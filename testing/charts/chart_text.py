"""The chart of a run as characters: who handled what, from whom, when, and how that changed the actor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from .chart_recorder import ChartRow

SHOWN: Final = 40
"""Turns that the text shows, the last ones."""
WIDEST: Final = 6
"""Columns of the text; where more actors take part, each row names who acts instead."""
COLUMN: Final = 20


def columns(rows: Sequence[ChartRow]) -> list[str]:
    """Who takes part, in order of appearance."""
    found: dict[str, None] = {}
    for row in rows:
        if row.source:
            found[row.source] = None
        found[row.name] = None
    return list(found)


def short(path: str) -> str:
    """The end of an address, behind the program that it is in, if that has a name."""
    program, colon, address = path.rpartition(":")
    return f"{program}{colon}{address.rsplit('/', 1)[-1] or address}"


def heading(led: Sequence[ChartRow], rows: Sequence[ChartRow]) -> str:
    """How many turns are shown, and what is left out."""
    count = "1 turn" if len(led) == 1 else f"{len(led)} turns"
    last = f"the last {SHOWN} of the {count}" if len(led) > SHOWN else f"the {count}"
    chosen = {*map(id, led)}
    others = [row for row in rows if id(row) not in chosen and not row.is_library]
    actors = {row.name for row in others} - {row.name for row in led}
    if not others:
        return f"{last} of the run:" if led else ""
    turns = "1 turn" if len(others) == 1 else f"{len(others)} turns"
    of = f", of {len(actors)} other actor{'' if len(actors) == 1 else 's'} and these" if actors else ""
    if actors and all(row.name in actors for row in others):
        of = f" of {len(actors)} other actor{'' if len(actors) == 1 else 's'}"
    return f"{last} that lead{'s' if len(led) == 1 else ''} to it ({turns}{of} left out):"


def as_text(led: Sequence[ChartRow], rows: Sequence[ChartRow]) -> str:
    """The last turns as a chart of characters: `*` is the turn, an arrow leads there from the sender's column.

    Args:
        led: the turns that are shown.
        rows: all turns of the run.
    """
    shown = led[-SHOWN:]
    if not shown:
        return ""
    names = columns(shown)
    lines = [heading(led, rows)]
    if len(names) > WIDEST:
        for row in shown:
            source = f"{row.source} -> " if row.source else ""
            lines.append(f"  {row.at:>9.3f}  {source}{row.name}: {row.what}{_change(row)}")
        return "\n".join(lines)
    width = min(COLUMN, max(len(short(name)) for name in names) + 3)
    lines.append("  " + " " * 11 + "".join(short(name)[: width - 1].ljust(width) for name in names))
    for row in shown:
        cells = ["|".ljust(width)] * len(names)
        to = names.index(row.name)
        text = list("".join(cells))
        if row.source and row.source != row.name:
            start = names.index(row.source)
            low, high = sorted((start, to))
            text[low * width + 1 : high * width] = "-" * ((high - low) * width - 1)
            text[start * width] = "+"
            text[to * width + (1 if to < start else -1)] = "<" if to < start else ">"
        text[to * width] = "x" if row.crashed else "*"
        lines.append(f"  {row.at:>9.3f}  {''.join(text)} {row.what}{_change(row)}")
    return "\n".join(lines)


def _change(row: ChartRow) -> str:
    return f"   [{row.change}]" if row.change else ""
