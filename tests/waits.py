"""Sees every turn that a supervisor waits in: whoever must answer does not wait for what it supervises."""

from __future__ import annotations

from typing import Any

from holdfast.actors.kernel.cell import Cell
from holdfast.actors.kernel.loop import RunLoop
from holdfast.actors.turn_stacks import stack_of
from holdfast.supervision.supervisor import Supervisor


class Waits:
    """What supervisors of the package have waited for in turns of their own, in this process."""

    def __init__(self) -> None:
        self._hold = RunLoop.hold
        self.seen: list[str] = []

    def hold(self, loop: RunLoop, cell: Cell, item: Any, turn: Any, waiting: Any) -> None:
        """In place of `RunLoop.hold`, which is called where a turn begins to wait."""
        kind = type(cell.actor)
        is_ours = issubclass(kind, Supervisor) and kind.__module__.startswith("holdfast.")
        if is_ours and item is not None:  # (No item: it ends.)
            self.seen.append("\n".join([f"{cell.path} in the turn of {item!r}:", *stack_of(turn)]))
        self._hold(loop, cell, item, turn, waiting)
