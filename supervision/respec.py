"""Replaces a child's recipe or place at run time, so that no restart brings the old one back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from ..actors.kernel.actor import Actor, Start
from ..actors.kernel.cell import DOWN, GONE, RUNNING, Cell
from ..actors.kernel.node import Node
from .children import STOPPED, STOPPING
from .spec import ChildSpec, Flags
from .supervisor import Supervisor, listed_at

Change = Callable[[ChildSpec], ChildSpec]
NO_RECIPE = (
    "its supervisor lives in another process, and no recipe here has its spec: "
    "add it by a transaction, or say it in the template"
)
"""Why a child that was started by a message, or by an `init` in another process, cannot be placed anew."""


def respec(cell: Cell, start: Start[Any], *, is_lent: bool = False) -> None:
    """The next lives at `cell` begin with `start`: its own recipe, its supervisor's spec, and the recipes above.

    Its supervisor is told, if that is in another process.

    `is_lent`: to try it only, so that no journal notes it.

    Raises:
        SpecError: the child's spec does not allow it.
    """
    spec = dataclasses.replace(cell.spec, start=start) if isinstance(cell.spec, ChildSpec) else cell.spec
    cell.extra().start = start
    if not is_lent:
        cell.table = start.kind._table  # Who sends before the next life begins sends what that handles.
        if (tap := cell.extra().tap) is not None:
            tap.attach()
    cell.host.home.has_class(cell, start.kind)
    _change(cell, spec, lambda known: dataclasses.replace(known, start=start), is_noted=not is_lent)
    cell.host.parent.begins_with(cell, start)


def replace_place(cell: Cell, spec: ChildSpec, *, is_lent: bool = False) -> None:
    """The next lives at `cell` are lived where `spec` says, also those under supervisors that are started anew.

    `is_lent`: for the time of a move only, so that no journal notes it.
    """

    def change(known: ChildSpec) -> ChildSpec:
        return dataclasses.replace(known, isolation=spec.isolation, limits=spec.limits)

    # What else has changed of it meanwhile, say its code or a binding, stays.
    _change(cell, change(cell.spec) if isinstance(cell.spec, ChildSpec) else spec, change, is_noted=not is_lent)


def replace_mechanism(cell: Cell, spec: ChildSpec, *, is_lent: bool = False) -> None:
    """The next lives at `cell` are protected as `spec` says, and live there; `is_lent` as in `replace_place`."""

    def change(known: ChildSpec) -> ChildSpec:
        return dataclasses.replace(known, isolation=spec.isolation, limits=spec.limits, mechanism=spec.mechanism)

    _change(cell, change(cell.spec) if isinstance(cell.spec, ChildSpec) else spec, change, is_noted=not is_lent)


def replace_options(cell: Cell, options: dict[str, Any]) -> None:
    """A child's spec has these options from now on, also under supervisors that are started anew."""

    def change(known: ChildSpec) -> ChildSpec:
        return dataclasses.replace(known, **options)

    _change(cell, change(cell.spec) if isinstance(cell.spec, ChildSpec) else cell.spec, change)


def rebind(cell: Cell, port: str, target: str | None) -> None:
    """The next lives at `cell` have a port bound to this address, also those under supervisors that are started anew.

    None: to nobody. Nothing is waited for: where nobody lives yet it leads to whoever comes to live there.
    """

    def change(known: ChildSpec) -> ChildSpec:
        if known.bindings.get(port) == target:
            return known
        left = {name: path for name, path in known.bindings.items() if name != port}
        if target is None:
            return dataclasses.replace(known, bindings=left, late=known.late - {port})
        return dataclasses.replace(known, bindings={**left, port: target}, late=known.late | {port})

    _change(cell, change(cell.spec) if isinstance(cell.spec, ChildSpec) else cell.spec, change)


def keep_plan(supervisor: Supervisor, flags: Flags, given: tuple[ChildSpec, ...] | None) -> None:
    """The next lives of a supervisor begin with flags and children that it was given while it worked.

    Not if its class has an `init` of its own: that is asked anew at each start. None: its children are as before.
    """
    cell = supervisor.ctx._cell
    start = cell.extra().start
    if start is None or not issubclass(start.kind, Supervisor) or start.kind.init is not Supervisor.init:
        return
    if len(start.args) == 2 and isinstance(start.args[0], Flags):
        children = start.args[1] if given is None else supervisor._recipe_with(start.args[1], given)
        respec(cell, Start(start.kind, (flags, children), start.kwargs))


def _change(cell: Cell, spec: ChildSpec | None, change: Change, *, is_noted: bool = True) -> None:
    cell.spec = spec
    _tell_parent(cell, is_noted=is_noted)
    names, above = [cell.name], cell.parent
    while above is not None:
        more = above.more
        if more is not None and more.start is not None:
            more.start = rebuilt(more.start, names, change)
            if isinstance(above.spec, ChildSpec):
                above.spec = dataclasses.replace(above.spec, start=more.start)
                _tell_parent(above)
        names, above = [above.name, *names], above.parent


def _tell_parent(cell: Cell, *, is_noted: bool = True) -> None:
    supervisor = cell.parent.actor if cell.parent is not None else None
    child = supervisor._children.get(cell.name) if isinstance(supervisor, Supervisor) else None
    if not isinstance(supervisor, Supervisor) or child is None:
        return
    if child.cell is cell and isinstance(cell.spec, ChildSpec) and child.spec is not cell.spec:
        before, child.spec = child.spec, cell.spec
        if is_noted:
            supervisor._respecified(child, before)


def rebuilt(start: Start[Any], names: list[str], change: Change) -> Start[Any]:
    """The recipe of a supervisor with another spec for the descendant at `names`; unchanged if it has none there."""
    if not issubclass(start.kind, Supervisor) or len(start.args) != 2 or not isinstance(start.args[1], tuple):
        return start
    flags, specs = start.args
    changed = tuple(_changed(spec, names, change) for spec in specs)
    return Start(start.kind, (flags, changed), start.kwargs)


def spec_below(start: Start[Any], names: list[str]) -> ChildSpec | None:
    """What the recipe of a supervisor says of the descendant at `names`; None if nothing."""
    spec: ChildSpec | None = None
    for name in names:
        if not issubclass(start.kind, Supervisor) or len(start.args) != 2 or not isinstance(start.args[1], tuple):
            return None
        spec = next((one for one in start.args[1] if one.id == name), None)
        if spec is None:
            return None
        start = spec.start
    return spec


def to_come(node: Node, path: str) -> type[Actor] | None:
    """The class of who is about to be started at an address, as a supervisor in this process has it; None: nobody is.

    Whoever is up there already is not to come. Of a supervisor that ends, or was stopped by order, all below it are:
    they come with its next life.
    """
    at = node.root
    if at is None or not path.startswith(f"{at.path}/"):
        return None
    names = path[len(at.path) + 1 :].split("/")
    while (listed := listed_at(at)) is not None:
        one = listed.get(names.pop(0))
        if one is None or (at.state is not RUNNING and not one.spec.comes_back):
            return None
        is_there = one.cell is not None and one.cell.state not in (DOWN, GONE)
        if not names:
            is_stopped = at.state is RUNNING and one.row is None and one.state in (STOPPED, STOPPING)
            return None if is_there or is_stopped else one.spec.start.kind
        if one.cell is None or listed_at(one.cell) is None:
            spec = None if is_there and one.row is None else spec_below(one.spec.start, names)
            return None if spec is None or not one.spec.comes_back else spec.start.kind
        at = one.cell
    return None


def recipe_spec(cell: Cell) -> ChildSpec | None:
    """What the nearest recipe above says of a child, of one whose supervisor lives elsewhere; None if nothing."""
    names, at = [cell.name], cell.parent
    while at is not None:
        start = at.more.start if at.more is not None else None
        spec = None if start is None else spec_below(start, names)
        if spec is not None:
            return spec
        names, at = [at.name, *names], at.parent
    return None


def _changed(spec: ChildSpec, names: list[str], change: Change) -> ChildSpec:
    if spec.id != names[0]:
        return spec
    if len(names) == 1:
        return change(spec)
    return dataclasses.replace(spec, start=rebuilt(spec.start, names[1:], change))
