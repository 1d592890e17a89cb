"""A child's start recipe, replaced at run time: no restart, not even of its supervisors, brings the old one back."""

from __future__ import annotations

import dataclasses
from typing import Any

from ..actors.actor import Start
from ..actors.cell import Cell
from .spec import ChildSpec
from .supervisor import Supervisor


def respec(cell: Cell, start: Start[Any]) -> None:
    """The next lives at `cell` begin with `start`: its own recipe, its supervisor's spec, and the recipes above.

    Raises:
        SpecError: the child's spec does not allow it.
    """
    spec = None if cell.spec is None else dataclasses.replace(cell.spec, start=start)
    cell.extra().start, cell.spec = start, spec
    _tell_parent(cell)
    names, above = [cell.name], cell.parent
    while above is not None:
        more = above.more
        if more is not None and more.start is not None:
            more.start = rebuilt(more.start, names, start)
            if isinstance(above.spec, ChildSpec):
                above.spec = dataclasses.replace(above.spec, start=more.start)
                _tell_parent(above)
        names, above = [above.name, *names], above.parent


def _tell_parent(cell: Cell) -> None:
    supervisor = cell.parent.actor if cell.parent is not None else None
    child = supervisor._children.get(cell.name) if isinstance(supervisor, Supervisor) else None
    if child is not None and child.cell is cell and isinstance(cell.spec, ChildSpec):
        child.spec = cell.spec


def rebuilt(start: Start[Any], names: list[str], new: Start[Any]) -> Start[Any]:
    """The recipe of a supervisor with `new` for the descendant at `names`; unchanged if that one is not in it."""
    if not issubclass(start.kind, Supervisor) or len(start.args) != 2:
        return start
    flags, specs = start.args
    if not isinstance(specs, tuple):
        return start  # Of a dynamic supervisor: its children are in no recipe.
    changed = tuple(_changed(spec, names, new) for spec in specs)
    return Start(start.kind, (flags, changed), start.kwargs)


def _changed(spec: ChildSpec, names: list[str], new: Start[Any]) -> ChildSpec:
    if spec.id != names[0]:
        return spec
    inner = new if len(names) == 1 else rebuilt(spec.start, names[1:], new)
    return dataclasses.replace(spec, start=inner)
