"""Time limits of stops: a child's own `shutdown`; for a supervisor, what its children may take."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING, Any

from ..actors import turn_stacks
from ..actors.events import OrderHeld, StopOverdue
from ..actors.kernel import lifecycle, mailbox
from ..actors.kernel.cell import DOWN, GONE, Cell
from ..actors.kernel.lifecycle import GRACE

if TYPE_CHECKING:
    from ..actors.kernel.actor import Actor
    from .spec import ChildSpec

SLACK = 5.0
"""Seconds that a supervisor may take beyond what its children may."""
FOREVER = float("inf")
HELD_SECONDS = 5.0
"""Seconds after which it is told that an order waits for a supervisor that is suspended."""


def end_within(cell: Cell, gone: asyncio.Future[Any]) -> None:
    """See to it that a supervisor whose spec sets no limit ends within that of its children; `gone` is its end.

    When that is over something is wrong: what hangs is told (StopOverdue), and all of it is killed.
    """
    seconds = most_below(cell, cell.spec) + SLACK
    if seconds == FOREVER or gone.done():
        return
    timer = cell.node.loop.call_later(seconds, _overdue, cell, seconds)
    gone.add_done_callback(lambda _: timer.cancel())


def _overdue(cell: Cell, seconds: float) -> None:
    if cell.state not in (DOWN, GONE):
        cell.node.emit(StopOverdue(cell.path, seconds, turn_stacks.blocked_below(cell)))
        cell.kill()


@contextlib.contextmanager
def told_if_held(supervisor: Cell, order: str, child: str) -> Generator[None, None, None]:
    """While the block waits for a supervisor of this process, tell (OrderHeld) once if that is suspended.

    Args:
        supervisor: who has the order.
        order: "start" or "stop".
        child: the address of whom it is about.
    """
    node = supervisor.node
    begun = node.loop.time()
    timer: asyncio.TimerHandle

    def look() -> None:
        nonlocal timer
        more = supervisor.more
        if more is not None and more.suspended & mailbox.BY_USER:
            node.emit(OrderHeld(supervisor.path, order, child, node.loop.time() - begun))
        else:
            timer = node.loop.call_later(HELD_SECONDS, look, context=node.base_context.copy())

    timer = node.loop.call_later(HELD_SECONDS, look, context=node.base_context.copy())
    try:
        yield
    finally:
        timer.cancel()


def most(cell: Cell | None, spec: ChildSpec | None) -> float:
    """Seconds after which a child that is told to stop has ended."""
    if spec is None:
        return lifecycle.PATIENCE + GRACE
    match spec.shutdown:
        case "brutal_kill":
            return GRACE
        case "infinity":
            return most_below(cell, spec) + SLACK if spec.is_supervisor else FOREVER
        case seconds:
            return seconds + GRACE


def most_below(cell: Cell | None, spec: ChildSpec | None) -> float:
    """Seconds that the children of a supervisor may take to end: one after another, or all at once."""
    limits = list(_limits(cell, spec))
    actor = None if cell is None else cell.actor
    kind: type[Actor] | None = type(actor) if actor is not None else None if spec is None else spec.start.kind
    at_once = kind is not None and kind._is_dynamic
    return max(limits, default=0.0) if at_once else sum(limits)


def _limits(cell: Cell | None, spec: ChildSpec | None) -> Iterator[float]:
    """What each child may take: of those in this process as their specs say, elsewhere as far as it is known here."""
    from .spec import ChildSpec  # It asks here how long a child may take.

    living = dict((cell.children or {}) if cell is not None else {})
    known: dict[str, ChildSpec] = {}
    if spec is not None and (cell is None or cell.actor is None):
        known = {one.id: one for one in spec.below()}
    template = next((one for name, one in known.items() if name == "*"), None)
    for name in {**living, **known}:
        if name != "*":
            child = living.get(name)
            own = child.spec if child is not None and isinstance(child.spec, ChildSpec) else None
            yield most(child, own or known.get(name, template))
