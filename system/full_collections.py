"""Fewer full garbage collections while a tree starts: what it builds stays, and each of them looks at all of it."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Generator
from typing import Final

SELDOM: Final = 1_000
"""Collections of the middle generation between two full ones while a tree starts: some seven million new objects."""


@contextlib.contextmanager
def seldom_collected() -> Generator[None]:
    """Have full collections be rarer within this block; the young generations are collected as always.

    Thresholds belong to the process. Where a program, or a start that is under way, has made full collections as rare
    as that or switched them off, nothing is changed, and what was changed here is put back unless another one has
    changed it since.
    """
    young, middle, full = gc.get_threshold()
    if not 0 < full < SELDOM:
        yield
        return
    ours = young, middle, SELDOM
    gc.set_threshold(*ours)
    try:
        yield
    finally:
        if gc.get_threshold() == ours:
            gc.set_threshold(young, middle, full)
