"""Addresses that actors have left: whoever knows only the old one still reaches them."""

from __future__ import annotations

from collections.abc import Callable

from ...actors.kernel.cell import GONE, Cell
from ...actors.kernel.node import Node


class Moved:
    """Where those who were moved live now. An address is forgotten here when somebody else comes to live there."""

    def __init__(self, node: Node, outside: Callable[[str], Cell | None]) -> None:
        self._node, self._outside = node, outside
        self._cells: dict[str, Cell] = {}

    def leave(self, path: str, cell: Cell) -> None:
        """The actor at `path` has another address now."""
        # Who was restarted since it came here has another cell now, and goes on with it.
        known = {old: cell if other.path == path else other for old, other in self._cells.items()}
        self._cells = {old: other for old, other in known.items() if old != cell.path}
        self._cells[path] = cell

    def forget(self, path: str) -> None:
        """Nobody ever had this address."""
        self._cells.pop(path, None)

    def find(self, path: str) -> Cell | None:
        """What the node asks when nobody lives at `path` now."""
        found = self._outside(path)
        if found is not None or not self._cells:
            return found
        above, names = path, list[str]()
        while above and above not in self._cells:
            above, _, name = above.rpartition("/")
            names.insert(0, name)
        cell = self._living(self._cells[above]) if above else None
        for name in names:
            cell = (cell.children or {}).get(name) if cell is not None else None
        return cell

    def _living(self, cell: Cell) -> Cell | None:
        """The cell, or who lives at its address now (never found through an address that was left: no circles)."""
        if cell.state is not GONE:
            return cell
        at: Cell | None = self._node.root
        for name in cell.path.split("/")[2:]:
            at = (at.children or {}).get(name) if at is not None else None
        return at
