"""Addresses that actors have left: whoever knows only the old one still reaches them."""

from __future__ import annotations

import functools
from collections.abc import Callable

from ...actors.kernel.cell import GONE, Cell
from ...actors.kernel.node import Node


class Moved:
    """Where those who were moved live now. An address is forgotten here when somebody else comes to live there."""

    def __init__(self, node: Node, outside: Callable[[str], Cell | None]) -> None:
        self._node, self._outside = node, outside
        self._cells: dict[str, Cell] = {}
        self._watched: set[str] = set()

    def leave(self, path: str, cell: Cell) -> None:
        """The actor at `path` has another address now, and all who move with it have theirs."""
        for old, other in list(self._cells.items()):
            if other.path == path:  # Who was restarted since it came here has another cell now, and goes on with it.
                self._cells[old] = cell
        self._cells.pop(cell.path, None)
        if self._at(path) is None:
            self._cells[path] = cell
            if path not in self._watched:
                self._watched.add(path)
                self._node.awaited.setdefault(path, []).append(functools.partial(self._forget, path))

    def _forget(self, path: str) -> None:
        self._watched.discard(path)
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
        return cell if cell.state is not GONE else self._at(cell.path)

    def _at(self, path: str) -> Cell | None:
        at: Cell | None = self._node.root
        for name in path.split("/")[2:]:
            at = (at.children or {}).get(name) if at is not None else None
        return at
