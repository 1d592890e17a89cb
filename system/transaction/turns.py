"""Work between two turns of a supervisor, ahead of its messages: what it decides sees all of it or none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from ...actors.control.orders import Order
from ...actors.control.orders_lane import order
from ...actors.kernel.cell import Cell
from ...supervision.supervisor import Supervisor

T = TypeVar("T")
PATIENCE = 30.0
"""Seconds a supervisor may take to come to it; the transaction's own time limit is mostly shorter."""


class Between(Order):
    """Work between two turns."""

    verb: ClassVar[str] = "change"

    def __init__(self, work: Callable[[Any], object]) -> None:
        self._work = work

    def run(self, cell: Cell, actor: Any) -> object:
        return self._work(actor)


async def between_turns(cell: Cell, work: Callable[[Supervisor], T]) -> T:
    """Have `work(supervisor)` done between two turns of the supervisor at `cell`, which lives in this process.

    Raises:
        ActorStopped, AskTimeout: it was not done. What `work` raises; ControlFailed if that is no HoldfastError.
    """
    result: T = await order(cell, Between(work), PATIENCE)
    return result


def arrange(cell: Cell, names: list[str]) -> None:
    """Put the addresses below a cell into this order; those that are not named come behind."""
    below = cell.children or {}
    first = {name: below[name] for name in names if name in below}
    cell.children = {**first, **{name: child for name, child in below.items() if name not in first}}
