"""What is lost or held up by a change, in sentences that are told before it is done; and whom the change is for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final

from ..overview import ActorRow

MANY_CHILDREN: Final = 10
"""Children from which on it is asked before their supervisor is suspended."""
MOST_NAMED: Final = 5
"""Actors that are named before something is lost; the others are counted."""


def tops(rows: list[ActorRow]) -> list[ActorRow]:
    """Those that are below no other one of them: the others end with those."""
    paths = {row.path for row in rows}
    return [row for row in rows if not any(above in paths for above in _above(row.path))]


def _above(path: str) -> list[str]:
    found: list[str] = []
    while path := path.rpartition("/")[0]:
        found.append(path)
    return found


def _ending(rows: list[ActorRow], all_rows: list[ActorRow]) -> list[ActorRow]:
    """The actors that end: these, and all below them."""
    paths = {row.path for row in rows}
    return [row for row in all_rows if row.path in paths or any(above in paths for above in _above(row.path))]


def held_up_by(rows: list[ActorRow], all_rows: list[ActorRow]) -> list[str]:
    """What waits while these are suspended, in words: of the root, and of supervisors with many children."""
    children = Counter(row.path.rpartition("/")[0] for row in all_rows)
    return [
        f"while {row.path} is suspended it starts, stops and restarts none of its {children[row.path]} children: "
        f"what ends stays down, and what it is asked for waits, until `holdfast resume {row.path}`"
        for row in rows
        if row.is_supervisor and (row.path.count("/") == 1 or children[row.path] >= MANY_CHILDREN)
    ]


def lost_by(rows: list[ActorRow], all_rows: list[ActorRow]) -> list[str]:
    """What is lost when these end for good, in words."""
    return lost_states(rows, all_rows) + _lost_messages(rows, all_rows)


def lost_states(rows: list[ActorRow], all_rows: list[ActorRow]) -> list[str]:
    """Whose state is lost when they end, in words."""
    lost = [
        row.path
        for row in _ending(rows, all_rows)
        if not (row.is_supervisor or row.recovery) and row.state != "stopped"
    ]
    if not lost:
        return []
    more = f" and {len(lost) - MOST_NAMED} more" if len(lost) > MOST_NAMED else ""
    return [f"without recovery, the state is lost of {', '.join(lost[:MOST_NAMED])}{more}"]


def _lost_messages(rows: list[ActorRow], all_rows: list[ActorRow]) -> list[str]:
    """How many waiting messages are handed back when they end, in words."""
    count = sum(row.queued for row in _ending(rows, all_rows))
    return [f"{count} waiting messages are handed back"] if count else []


WARNINGS: Final[dict[str, Callable[[list[ActorRow], list[ActorRow]], list[str]]]] = {
    "suspend": held_up_by,
    "restart": lost_states,
    "stop": lost_by,
    "remove": lost_by,
}
"""Of each change that may do harm what is said before it is done; of the others nothing is."""
