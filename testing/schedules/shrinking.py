"""Shrinking: the same failure with as few choices as possible that differ from what production would do.

Latencies go first, then faults, then turns: each kind as a whole, then in halves, quarters, and singly, as long as the
failure stays; what is left is all that it takes. Source: delta debugging (Zeller and Hildebrandt, IEEE TSE 2002).
"""

from __future__ import annotations

import time
from collections.abc import Callable

from .choices import DELAY, FAULT, HOLD, LATENCY, LOSS, MOMENT, TURN, Taken

SECONDS = 10.0
"""Real seconds that shrinking may take."""
RUNS = 1000
ORDER = (LATENCY, FAULT, LOSS, DELAY, MOMENT, TURN, HOLD)

Item = tuple[str, int, int]
now = time.perf_counter
"""The real clock: that of a run is the seed's."""


def shrink(taken: Taken, fails: Callable[[Taken], Taken | None], seconds: float = SECONDS) -> Taken:
    """The smallest schedule found that still fails.

    Args:
        taken: one that fails.
        fails: runs a schedule. Returns the choices that the run has really made if it fails in the same way, or None.
        seconds: how long to try, on the real clock.
    """
    end, runs = now() + seconds, 0
    best = _items(taken)

    def tried(items: list[Item]) -> list[Item] | None:
        nonlocal runs
        runs += 1
        made = fails(_taken(items))
        if made is None:
            return None
        found = _items(made)
        return found if len(found) <= len(items) else items

    if best and (made := tried([])) is not None:
        return _taken(made)
    for kind in ORDER:
        others = [item for item in best if item[0] != kind]
        if 0 < len(others) < len(best) and now() < end and (made := tried(others)) is not None:
            best = made if len(made) < len(best) else best
    size = max(1, len(best) // 2)
    while best and now() < end and runs < RUNS:
        at, shorter = 0, False
        while at < len(best) and now() < end and runs < RUNS:
            made = tried(best[:at] + best[at + size :])
            if made is not None and len(made) < len(best):
                best, shorter = made, True
            else:
                at += size
        if not shorter:
            if size == 1:
                break
            size = max(1, size // 2)
    return _taken(best)


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
