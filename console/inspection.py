"""One actor of a running system, in full: what `holdfast inspect` shows."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import msgspec

from ..actors.control.orders import status_of
from ..actors.errors import AskTimeout, type_name
from ..actors.kernel.cell import Cell
from ..actors.kernel.node import cell_kind
from ..checkpoint.method import Method
from ..checkpoint.recovery_file import METHODS
from ..ftm.replica.replica import Replica
from ..supervision.intensity import recent_restarts
from ..supervision.spec import ChildSpec
from ..supervision.supervisor import Supervisor
from .overview import FAR_TIMEOUT, as_told, find, is_far, process_use, row_of

if TYPE_CHECKING:
    from ..system.system import ActorSystem


async def inspected(system: ActorSystem, path: str, timeout: float) -> dict[str, Any]:
    """All that can be said of one actor, as plain data; of a child that is stopped only what its spec says.

    Raises:
        NoSuchActor: nobody is known at the address.
    """
    one = find(system, path)
    cell = one.cell
    if cell is None or cell.is_dead:
        return {"actor": msgspec.structs.asdict(row_of(one)), "spec": _spec_words(one.child and one.child.spec)}
    row = row_of(one)
    try:
        status = await system.get_status(cell.ref, timeout=min(timeout, FAR_TIMEOUT))
        seen = {"turn": status.turn or "", "turn_seconds": status.turn_seconds}
        row = as_told(row, status) if is_far(cell) else msgspec.structs.replace(row, **seen)
    except AskTimeout:  # Its process is blocked, or stopped: what is known here is all there is.
        status, row = status_of(cell), as_told(row, None)
    more = cell.more
    ties = more.ties if more is not None and more.has_more else None
    protection = await system.protection(cell.ref)
    use = process_use(row.pid) if row.pid else None
    return {
        "actor": msgspec.structs.asdict(row),
        "life": status.life,
        "turn_at": status.turn_at,
        "turn_rests": status.turn_rests,
        "bindings": dict(status.bindings),
        "links": sorted(ties.links.values()) if ties is not None else [],
        "monitors": sorted({each.watcher.path for each in ties.monitors if each.active}) if ties is not None else [],
        "spec": _spec_words(cell.spec),
        "supervises": _supervises(cell),
        "protection": msgspec.to_builtins(protection) if protection.is_protected else None,
        "bricks": bricks_of(cell) if protection.is_protected else {},
        "process": None if use is None else msgspec.structs.asdict(use),
    }


def bricks_of(cell: Cell) -> dict[str, dict[str, str]]:
    """What the replicas of a protected actor are made of: of each replica its parts by name, and their classes."""
    found: dict[str, dict[str, str]] = {}
    group = (cell.children or {}).get("ftm")
    for name, replica in list((group.children or {}).items()) if group is not None else ():
        if cell_kind(replica) is Replica:
            parts = list((replica.children or {}).items())
            found[name] = {part: type_name(kind) if (kind := cell_kind(one)) is not None else "" for part, one in parts}
    return found


def _spec_words(spec: object) -> dict[str, Any]:
    """What a child spec says, as text."""
    if not isinstance(spec, ChildSpec):
        return {}
    said = {name: getattr(spec, name) for name in ("restart", "shutdown", "isolation", "start_timeout")}
    given = {name: getattr(spec, name) for name in ("recovery", "mailbox", "backoff", "limits", "mechanism")}
    return said | {name: _set_words(value) for name, value in given.items() if value is not None}


def _set_words(value: object) -> str:
    """A setting as text: of a method, its name and what differs from its defaults."""
    if not isinstance(value, Method):
        return str(value)
    default = METHODS[value.name]() if value.name in METHODS else value
    names = (field.name for field in dataclasses.fields(value))
    changed = [name for name in names if getattr(value, name) != getattr(default, name)]
    return f"{value.name}({', '.join(f'{name}={getattr(value, name)!r}' for name in changed)})"


def _supervises(cell: Cell) -> dict[str, Any] | None:
    """A supervisor's flags, how many restarts it has used up, and how many children there are."""
    actor = cell.actor
    if not isinstance(actor, Supervisor) or "_children" not in actor.__dict__:
        return None
    flags, now = actor._flags, cell.node.loop.time()
    return {
        "strategy": flags.strategy,
        "intensity": flags.intensity,
        "period": flags.period,
        "restarts": len(recent_restarts(actor._restarts, now, flags.period)),
        "children": len(actor._children),
    }
