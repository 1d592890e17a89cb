"""Circles of asks between turns that have begun by themselves: each waits for the next one, and none can get on."""

from __future__ import annotations

import gc
import types
from typing import TYPE_CHECKING, Final

from ..errors import AskDeadlock
from ..turn_stacks import awaited_by
from .envelope import Ask

if TYPE_CHECKING:
    from .cell import Cell
    from .loop import Suspended

LONGEST: Final = 16
"""Turns in the longest circle that is looked for when an ask is made."""
EXITS: Final = frozenset({"__exit__", "__aexit__"})


def may_wait_for(cell: Cell, other: Cell) -> bool:
    """Whether the turn at `cell` may wait for the one at `other`, by whom each actor in between has asked last."""
    at: Cell | None = cell
    for _ in range(LONGEST):
        if at is None or at is other:
            break
        more, ctx = at.more, at.ctx
        at = ctx._asked if ctx is not None and more is not None and more.turn is not None else None
    return at is other


def end_circle(ask: Ask) -> None:
    """If the asker's turn and those that wait for it stand in a circle, fail the ask in it that would run out first.

    That one cannot be answered in time any more. Nothing is failed if one of the turns may be waiting for something
    else as well, or no longer than some `with` block lets it.
    """
    row: list[Ask] = []
    cell: Cell = ask.sender
    while not row or cell is not ask.sender:
        following = _awaited_of(cell)
        if following is None or len(row) == LONGEST:
            return
        row.append(following)
        cell = following.to
    first = min(range(len(row)), key=lambda at: row[at].deadline)
    refused = row[first]
    refused.deadline = 0.0  # It stands in a mailbox: it is not run there.
    refused.fail(
        AskDeadlock(refused.to.path, tuple(one.sender.path for one in reversed(row[first + 1 :] + row[: first + 1])))
    )


def _awaited_of(cell: Cell) -> Ask | None:
    """The ask that the turn in hand waits for, and for nothing else; None if there is none that has not begun."""
    more, ctx = cell.more, cell.ctx
    if more is None or more.turn is None or ctx is None or ctx._asked is None or not ctx._may_fail_fast:
        return None
    future = more.turn.waiting
    for item in ctx._asked.queue or ():
        if isinstance(item, Ask) and item.future is future and item.sender is cell and item.to is ctx._asked:
            return None if item.is_done or _may_be_cut_short(more.turn) else item
    return None


def _may_be_cut_short(turn: Suspended) -> bool:
    """Whether a coroutine of a suspended turn is inside a `with` block, such as `asyncio.timeout`.

    The way out of the block is on the stack of its coroutine, where Python's collector finds it.
    """
    kinds = (types.MethodType, types.BuiltinMethodType, types.FunctionType)
    return any(
        isinstance(held, kinds) and held.__name__ in EXITS
        for work in awaited_by(turn.coroutine)
        for held in gc.get_referents(work)
    )
