"""Footprints: what one step of a run has touched, for the search that leaves out orders which make no difference."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, Any, Final

from ...actors.kernel.cell import Cell
from ...actors.kernel.node import Node

if TYPE_CHECKING:
    from .control import ControlledLoop

Footprint = frozenset[Hashable]
"""The actors that one step has touched."""
ALL: Final[Footprint] = frozenset({"all"})
"""A step whose effects are not known to be messages alone."""


class Footprints:
    """Compares how the actors of a node are before and after a step."""

    def __init__(self, node: Node, loop: ControlledLoop) -> None:
        self._node, self._loop = node, loop
        self._before: dict[Cell, tuple[Any, ...]] = {}
        self._touched: set[Hashable] = set()
        self._begun = (0, 0)

    def begin(self) -> None:
        """A step begins: note how everything is."""
        self._before, self._touched, self._begun = self._state(), set(), self._outside()

    def touch(self, cell: Cell | None) -> None:
        """An actor has a turn; None: something else happens, which may touch everything."""
        if self._before:
            self._touched |= ALL if cell is None else {cell.path}

    def footprint(self) -> Footprint:
        """The actors that the steps since then have touched; ALL if anything else may have changed."""
        if self._outside() != self._begun or "all" in self._touched:
            return ALL
        after = self._state()
        if after.keys() != self._before.keys():
            return ALL
        changed = {cell.path for cell, state in after.items() if state != self._before[cell]}
        return frozenset(self._touched | changed)

    def _outside(self) -> tuple[int, int]:
        return len(self._loop.due), self._loop.scheduled_timers()

    def _state(self) -> dict[Cell, tuple[Any, ...]]:
        found: dict[Cell, tuple[Any, ...]] = {}
        cells = [self._node.root] if self._node.root is not None else []
        for cell in cells:  # It grows meanwhile.
            more = cell.more
            urgent = len(more.urgent or ()) if more is not None else 0
            queue = cell.queue
            found[cell] = (len(queue) if queue is not None else -1, cell.state, cell.life, urgent)
            cells += (cell.children or {}).values()
        return found
