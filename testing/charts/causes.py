"""Which turns of a run lead to its failure: those that it shows, and all that these follow from.

It shows what the failing statement of the test looks at (refs, futures of asks, probes, actors), and the actors that
the error names; if there are none, all that the test has heard. A turn follows from the one that sent what it handles,
from the earlier turns of the same actor, from the replies that it waited for, from that which set its timer or started
its actor. A turn that waits for a reply that did not come follows from whatever the one who was asked has done instead.
"""

from __future__ import annotations

import asyncio
import dis
from collections.abc import Iterable, Iterator
from types import CodeType, TracebackType
from typing import Any, Final

from ...actors.kernel.actor import Actor
from ...actors.kernel.ref import ActorRef
from ..library_code import is_file_of_library
from ..probes import Probe
from .chart_recorder import NEVER, ChartRow, Recorder, paths_in

WITHIN: Final = 100
"""Members of a container that are looked at."""


def leading(recorder: Recorder, failure: BaseException) -> list[ChartRow]:
    """The turns that lead to a failure, in order, without those of the library; all of these if none is known to."""
    shown = {*_named(recorder, failure)}
    rows = [recorder.last[path] for path in shown if path in recorder.last]
    rows += [order.row for path in shown for order in recorder.orders.get(path, ())]
    rows += [row for path, row in recorder.heard if path in shown]
    if not rows:
        rows = [row for _, row in recorder.heard]
        rows += [number for number, row in enumerate(recorder.rows) if row.is_probe]
    found = _behind(recorder, rows) if rows else {*range(len(recorder.rows))}
    led = [row for number, row in enumerate(recorder.rows) if number in found and not row.is_library]
    return led or [row for row in recorder.rows if not row.is_library]


def _behind(recorder: Recorder, rows: Iterable[int]) -> set[int]:
    """These turns, and all that they follow from."""
    until: dict[int, int] = {}
    unanswered: dict[int, list[str]] = {}
    for sent in recorder.sent:
        if not sent.is_answered and sent.row >= 0:
            unanswered.setdefault(sent.row, []).append(sent.to)
    waiting = [(row, NEVER) for row in rows]
    while waiting:
        number, moment = waiting.pop()
        if until.get(number, -1) >= moment:
            continue
        until[number] = moment
        waiting += [(cause.row, cause.until) for cause in recorder.rows[number].causes if cause.at <= moment]
        waiting += [(recorder.last[to], NEVER) for to in unanswered.get(number, ()) if to in recorder.last]
    return {*until}


def _named(recorder: Recorder, failure: BaseException) -> Iterator[str]:
    """The addresses of the actors that a failure is about."""
    yield from (path for error, path in recorder.refused if error is failure)
    text = str(failure)
    yield from (path for path in paths_in(text) if path in recorder.last or path in recorder.orders)
    frames: list[TracebackType] = []
    trace = failure.__traceback__
    while trace is not None:
        if not is_file_of_library(trace.tb_frame.f_code.co_filename):
            frames.append(trace)
        trace = trace.tb_next
    for frame in reversed(frames):  # The innermost that looks at any.
        found = [path for value in _values(frame) for path in _paths(recorder, value)]
        if found:
            yield from found
            return


def _values(trace: TracebackType) -> Iterator[Any]:
    """What the names of the statement that has raised stand for."""
    frame = trace.tb_frame
    names = names_of_statement(frame.f_code, trace.tb_lasti)
    found = [scope[name] for name in names for scope in (frame.f_locals, frame.f_globals) if name in scope]
    yield from found
    for value in found:  # `self.account`
        own: dict[str, Any] = getattr(value, "__dict__", {})
        yield from (own[name] for name in names if name in own)


def names_of_statement(code: CodeType, raised_at: int) -> dict[str, None]:
    """The names that stand in the lines of the instruction that has raised, in order."""
    instructions = [*dis.get_instructions(code)]
    lines = next((_lines(one) for one in instructions if one.offset == raised_at), None)
    if lines is None:
        return {}
    names: dict[str, None] = {}
    for one in instructions:
        own = _lines(one)
        is_near = own is not None and own[0] <= lines[1] and own[1] >= lines[0]
        if is_near and one.opname.startswith("LOAD_") and isinstance(one.argval, str):
            names[one.argval] = None
    return names


def _lines(one: dis.Instruction) -> tuple[int, int] | None:
    positions = one.positions
    if positions is None or positions.lineno is None:
        return None
    return positions.lineno, positions.end_lineno or positions.lineno


def _paths(recorder: Recorder, value: Any, *, is_inside: bool = False) -> Iterator[str]:
    """The addresses that a value stands for."""
    match value:
        case ActorRef():
            yield value.path
        case Probe():
            yield value.ref.path
        case Actor():
            yield value.ctx.path
        case asyncio.Future():
            if id(value) in recorder.asks:
                yield recorder.asks[id(value)][1]
        case dict() if not is_inside:
            for one in [*value.values()][:WITHIN]:
                yield from _paths(recorder, one, is_inside=True)
        case list() | tuple() | set() | frozenset() if not is_inside:
            for one in [*value][:WITHIN]:
                yield from _paths(recorder, one, is_inside=True)
        case _:
            pass
