"""What suspended turns and background work wait for: their stacks as text, and circles of turns that ask each other.

Turns in a circle have begun by themselves: else the chain of an ask tells of it (`ActorContext._turn_in`).
"""

from __future__ import annotations

import gc
import linecache
import sys
import types
from collections.abc import Coroutine, Iterator
from types import CodeType, FrameType
from typing import TYPE_CHECKING, Any, Final

from .errors import AskDeadlock
from .kernel.envelope import Ask, message_in

if TYPE_CHECKING:
    from .kernel.cell import Cell
    from .kernel.loop import Suspended

OURS = __name__.partition(".")[0]
"""The package whose frames are not the user's."""
DRIVEN = "driven_turn"
"""The local in which a generator of ours holds the coroutine that it sends to by hand: Python sees no await there."""
LONGEST: Final = 16
"""Turns in the longest circle that is looked for when an ask is made."""
EXITS: Final = frozenset({"__exit__", "__aexit__"})


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
    for at, code, frame in _awaited(work):
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
    for _, code, frame in _awaited(work):
        if code is None or frame is None:
            continue
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package != OURS and package not in sys.stdlib_module_names:
            source = linecache.getline(code.co_filename, frame.f_lineno).strip()
            found = f"{code.co_filename.rpartition('/')[2]}:{frame.f_lineno}" + (f", {source}" if source else "")
    return found


def _awaited(work: Coroutine[Any, Any, Any]) -> Iterator[tuple[Any, CodeType | None, FrameType | None]]:
    """A coroutine and what it awaits, outermost first, each with its code and frame; last what has no code."""
    at: Any = work
    while at is not None:
        frame: FrameType | None
        code: CodeType
        match at:
            case object(cr_frame=frame, cr_code=code, cr_await=inner):
                pass
            case object(gi_frame=frame, gi_code=code, gi_yieldfrom=inner):
                pass
            case _:
                yield at, None, None
                return
        yield at, code, frame
        at = frame.f_locals.get(DRIVEN) if inner is None and frame is not None else inner


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
        for work, _, _ in _awaited(turn.coroutine)
        for held in gc.get_referents(work)
    )
