"""Writes changes of the tree into the recipes of supervisors, so that their restarts keep them.

A supervisor whose class has an `init` of its own is asked anew at each start, and its recipe left alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

from ...actors.kernel.actor import Start
from ...actors.kernel.cell import Cell
from ...supervision.dynamic import DynamicSupervisor
from ...supervision.respec import rebuilt, respec
from ...supervision.spec import ChildSpec, Flags
from ...supervision.supervisor import Supervisor

Specs: TypeAlias = "tuple[ChildSpec, ...]"
Edit = Callable[[Flags, Specs], tuple[Flags, Specs]]
"""What changes in a recipe: flags and children before, and after."""


def recipe_flags(cell: Cell) -> Flags | None:
    """The flags in a supervisor's recipe, if it has one with flags."""
    return recipe_parts(_recipe(cell)[1])[0]


def recipe_specs(cell: Cell) -> Specs | None:
    """The children in a supervisor's recipe, if it has one."""
    return recipe_parts(_recipe(cell)[1])[1]


def recipe(cell: Cell) -> Start[Any] | None:
    """What a supervisor's next lives begin with, if the root knows that."""
    return _recipe(cell)[1]


def keep(cell: Cell, edit: Edit) -> None:
    """Have the next lives of a supervisor begin with a changed recipe."""
    holder, start = _recipe(cell)
    flags, specs = recipe_parts(start)
    if start is None or flags is None or specs is None:
        return
    flags_after, specs_after = edit(flags, specs)
    if (flags_after, specs_after) == (flags, specs):
        return
    children: Any = start.args[1] if issubclass(start.kind, DynamicSupervisor) else specs_after
    _put(holder, cell, Start(start.kind, (flags_after, children), start.kwargs))


class Renamed:
    """Specs and recipes in which the addresses of actors that have moved, and of those below them, are the new ones."""

    def __init__(self, now: dict[str, str]) -> None:
        self._now = dict(sorted(now.items(), key=lambda one: -len(one[0])))  # Who is below comes first.
        self._made: dict[int, tuple[Any, Any]] = {}  # by the identity of the old: what was one stays one

    def keep(self, root: Cell) -> None:
        """Have all that look after others, at and below this cell, know them by their new addresses."""
        waiting = [root]
        while waiting:
            cell = waiting.pop()
            waiting.extend((cell.children or {}).values())
            if isinstance(cell.spec, ChildSpec):
                cell.spec = self._spec(cell.spec)
            if cell.more is not None and cell.more.start is not None:
                cell.more.start = self.start(cell.more.start)
            if isinstance(cell.actor, Supervisor):
                for one in cell.actor._listed().values():
                    one.spec = self._spec(one.spec)

    def _path(self, path: str) -> str:
        for was, now in self._now.items():
            if path == was or path.startswith(f"{was}/"):
                return now + path[len(was) :]
        return path

    def _spec(self, spec: ChildSpec) -> ChildSpec:
        if id(spec) not in self._made:
            bindings = {port: self._path(path) for port, path in spec.bindings.items()}
            start, new = self.start(spec.start), spec
            if bindings != spec.bindings or start is not spec.start:
                new = dataclasses.replace(spec, bindings=bindings, start=start)
            self._made[id(spec)] = (spec, new)
        new_spec: ChildSpec = self._made[id(spec)][1]
        return new_spec

    def start(self, start: Start[Any]) -> Start[Any]:
        """A recipe with them."""
        specs = recipe_parts(start)[1]
        if id(start) not in self._made:
            below = tuple(map(self._spec, specs or ()))
            new = start
            if any(one is not other for one, other in zip(below, specs or (), strict=True)):
                new = Start(start.kind, (start.args[0], below), start.kwargs)
            self._made[id(start)] = (start, new)
        new_start: Start[Any] = self._made[id(start)][1]
        return new_start


def _recipe(cell: Cell) -> tuple[Cell, Start[Any] | None]:
    """The recipe of a supervisor, and the cell in whose recipe it stands: its own, or one above it."""
    names: list[str] = []
    at: Cell | None = cell
    while at is not None:
        start = at.more.start if at.more is not None else None
        if start is not None and len(start.args) == 2 and isinstance(start.args[0], Flags):
            return at, _inner(start, names)
        names, at = [at.name, *names], at.parent
    return cell, None


def _inner(start: Start[Any], names: list[str]) -> Start[Any] | None:
    for name in names:
        specs = recipe_parts(start)[1]
        spec = next((spec for spec in specs or () if spec.id == name), None)
        if spec is None:
            return None
        start = spec.start
    return start


def recipe_parts(start: Start[Any] | None) -> tuple[Flags | None, Specs | None]:
    """Flags and children in a recipe; None where it has none, or its class has an `init` of its own."""
    if start is None or not issubclass(start.kind, Supervisor) or len(start.args) != 2:
        return None, None
    if start.kind.init is not Supervisor.init:
        return None, None
    flags, children = start.args
    if not isinstance(flags, Flags):
        return None, None
    return flags, children if isinstance(children, tuple) else ()


def _put(holder: Cell, cell: Cell, start: Start[Any]) -> None:
    names: list[str] = []
    at = cell
    while at is not holder:
        names.insert(0, at.name)
        assert at.parent is not None
        at = at.parent
    respec(holder, start if not names else _nested(holder, names, start))


def _nested(holder: Cell, names: list[str], new: Start[Any]) -> Start[Any]:
    start = holder.extra().start
    assert start is not None
    return rebuilt(start, names, lambda spec: dataclasses.replace(spec, start=new))
