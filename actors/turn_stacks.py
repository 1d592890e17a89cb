"""Stacks of suspended turns and of background work, as text: what each of them waits for."""

from __future__ import annotations

import linecache
import sys
from collections.abc import Coroutine, Iterator
from typing import TYPE_CHECKING, Any

from .kernel.context import awaited
from .kernel.envelope import message_in

if TYPE_CHECKING:
    from .kernel.cell import Cell

OURS = __name__.partition(".")[0]
"""The package whose frames are not the user's."""


def blocked_below(top: Cell) -> str:
    """The suspended turns of an actor and of those below it in this process, parents first, with their stacks.

    Empty if there are none: then what is waited for is in another process, or is no turn.
    """
    return "\n".join(line for cell in _cells(top) for line in _of(cell))


def _cells(top: Cell) -> Iterator[Cell]:
    yield top
    for child in list((top.children or {}).values()):
        yield from _cells(child)


def _of(cell: Cell) -> Iterator[str]:
    turn = cell.more.turn if cell.more is not None else None
    if turn is not None:
        what = "its end" if turn.item is None else type(message_in(turn.item)).__name__
        seconds = cell.node.loop.time() - turn.since
        yield f"{cell.path} ({cell.state}) has been in the turn of {what} for {seconds:.1f} s:"
        yield from stack_of(turn.coroutine)
    for work in cell.actor._outside() if cell.actor is not None else ():
        yield f"{cell.path} ({cell.state}) waits outside its turns:"
        yield from stack_of(work)


def stack_of(work: Coroutine[Any, Any, Any]) -> Iterator[str]:
    """Where a coroutine waits, outermost first, as in a traceback; behind the last one, for what."""
    for at, code, frame in awaited(work):
        if code is None:
            yield f"    waits for {at!r}"
        elif frame is not None:
            yield f'  File "{code.co_filename}", line {frame.f_lineno}, in {code.co_qualname}'
            source = linecache.getline(code.co_filename, frame.f_lineno).strip()
            if source:
                yield f"    {source}"


def waits_at(work: Coroutine[Any, Any, Any]) -> str:
    """The line of the user's code at which a coroutine waits, `shop.py:41, receipt = await reader.readline()`.

    It is the innermost that is neither of this package nor of Python's library; "" if there is none.
    """
    found = ""
    for _, code, frame in awaited(work):
        if code is None or frame is None:
            continue
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package != OURS and package not in sys.stdlib_module_names:
            source = linecache.getline(code.co_filename, frame.f_lineno).strip()
            found = f"{code.co_filename.rpartition('/')[2]}:{frame.f_lineno}" + (f", {source}" if source else "")
    return found
