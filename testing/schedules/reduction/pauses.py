"""Loops of a test that do nothing but wait: `for _ in range(20): await asyncio.sleep(0)`.

Each round is a step, and any number of turns may come between two. A round that reads and changes nothing but the
loop's own variables has nothing to do with any of them.
"""

from __future__ import annotations

import asyncio
import dis
import functools
import inspect
import types
from collections.abc import Iterator
from typing import Any, Final

HARMLESS: Final = frozenset(
    [
        "CACHE",
        "RESUME",
        "NOP",
        "POP_TOP",
        "PUSH_NULL",
        "COPY",
        "SWAP",
        "LOAD_CONST",
        "LOAD_SMALL_INT",
        "FOR_ITER",
        "END_FOR",
        "SEND",
        "END_SEND",
        "YIELD_VALUE",
        "GET_AWAITABLE",
        "PRECALL",
        "EXTENDED_ARG",
        "COMPARE_OP",
        "BINARY_OP",
        "IS_OP",
        "UNARY_NOT",
        "UNARY_NEGATIVE",
        "TO_BOOL",
        "NOT_TAKEN",
        "POP_ITER",
    ]
)
JUMPS: Final = frozenset((*dis.hasjrel, *dis.hasjabs))
PLAIN: Final = (int, float, str, bytes, type(None))
"""What a variable of such a loop may hold: nothing that anybody else could change."""

Pause = tuple[tuple[int, int], ...]
"""Where the frames of a task stand, from the outermost on."""


def pause_of(task: asyncio.Task[Any]) -> Pause | None:
    """Where a task waits in a loop for nothing but its next step; None: it waits elsewhere, or the loop does more."""
    at: list[tuple[int, int]] = []
    coro: Any = task.get_coro()
    while inspect.iscoroutine(coro) and (frame := coro.cr_frame) is not None:
        inner: Any = coro.cr_await
        at.append((id(coro), frame.f_lasti))
        if inspect.iscoroutine(inner) and inner.cr_code is asyncio.sleep.__code__:
            zero = inspect.isgenerator(inner.cr_await)  # Not a future: it sleeps for no time.
            return tuple(at) if zero and _only_waits(frame) else None
        coro = inner
    return None


def _only_waits(frame: types.FrameType) -> bool:
    names = _variables(frame.f_code, frame.f_lasti)
    if names is None:
        return False
    known = frame.f_globals
    sleeps = known.get("asyncio") is asyncio or known.get("sleep") is asyncio.sleep
    return sleeps and all(type(frame.f_locals.get(name)) in (*PLAIN, bool) for name in names)


@functools.lru_cache(maxsize=1024)
def _variables(code: types.CodeType, at: int) -> frozenset[str] | None:
    """The variables of a loop that comes to this point again; None: there is none, or it does more than wait."""
    names, calls, sleeps = set[str](), 0, 0
    for step in _between(code, at):
        name = step.opname
        if name.startswith(("LOAD_FAST", "STORE_FAST")):
            if name.startswith("LOAD_FAST"):
                names.update((step.argval,) if isinstance(step.argval, str) else step.argval)
        elif name in ("CALL", "CALL_FUNCTION"):
            calls += 1
        elif name == "LOAD_GLOBAL" and step.argval in ("asyncio", "sleep"):
            sleeps += step.argval == "sleep"
        elif name in ("LOAD_ATTR", "LOAD_METHOD") and step.argval == "sleep":
            sleeps += 1
        elif name not in HARMLESS and step.opcode not in JUMPS:
            return None
    return frozenset(names) if calls == sleeps == 1 else None


def _between(code: types.CodeType, at: int) -> Iterator[dis.Instruction]:
    """The instructions on any way from one to the same one again."""
    steps = list(dis.get_instructions(code))
    numbers = {step.offset: number for number, step in enumerate(steps)}
    if at not in numbers:
        return
    follow: list[list[int]] = []
    for number, step in enumerate(steps):
        after = [numbers[step.argval]] if step.opcode in JUMPS else []
        ends = step.opname.startswith(("RETURN_V", "RETURN_C", "RAISE", "RERAISE", "JUMP_F", "JUMP_B"))
        follow.append(after if ends or number + 1 == len(steps) else [*after, number + 1])
    lead: list[list[int]] = [[] for _ in steps]
    for number, after in enumerate(follow):
        for one in after:
            lead[one].append(number)
    there = _reached(follow, numbers[at])
    back = _reached(lead, numbers[at])
    yield from (steps[number] for number in sorted(there & back))


def _reached(follow: list[list[int]], begin: int) -> set[int]:
    found, left = {begin}, [begin]
    while left:
        for one in follow[left.pop()]:
            if one not in found:
                found.add(one)
                left.append(one)
    return found
