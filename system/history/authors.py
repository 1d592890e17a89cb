"""Authors: who has called for a change, so that the history can say who has stopped an actor."""

from __future__ import annotations

import contextvars

from ...actors.kernel.ref import current

PROGRAM = "the program"
OPERATOR = "an operator"
ACTING: contextvars.ContextVar[str] = contextvars.ContextVar("acting", default=PROGRAM)
"""On whose behalf code runs that belongs to no actor."""


def author() -> str:
    """Who calls: the address of the actor in whose turn this runs, else the program, an operator, or a transaction."""
    caller = current.get(None)
    return caller._cell.path if caller is not None else ACTING.get()
