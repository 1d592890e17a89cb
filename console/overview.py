"""A running system at a glance: each actor in a row, and the processes in which they live."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import msgspec

from ..actors.control.orders import Status, status_of
from ..actors.errors import HoldfastError, NoSuchActor, type_name
from ..actors.kernel.cell import Cell
from ..actors.kernel.node import cell_kind
from ..actors.process.wire.peer import OutsideHost
from ..checkpoint.home.recorded_home import switch_of
from ..ftm.group.protected import protection_of
from ..supervision.children import Child
from ..supervision.spec import ChildSpec
from ..supervision.supervisor import Supervisor
from ..system.controls import has_process
from ..system.recovery import RecoverySupervisor

if TYPE_CHECKING:
    from ..system.system import ActorSystem

SLICE = 200
"""Actors that are looked at in one step of the loop, so that those of the program wait for a millisecond at most."""
FAR_TIMEOUT = 1.0
"""Seconds that an actor in another process has to say how it is."""


class ActorRow(msgspec.Struct, frozen=True, array_like=True):
    """One actor, or one child that is stopped."""

    path: str
    kind: str
    """The class, `module.Class`."""
    state: str
    """"running", "suspended", "restarting", "ending", "starting", "stopped", or "silent": no process answers for it."""
    place: str
    """"task" in the process of its supervisor, "process" in one of its own, or "replicas"."""
    pid: int
    """The process in which it lives, that of the leader for replicas; 0 if there is none now."""
    restarts: int
    """Lives at its address before this one."""
    queued: int
    turn: str
    """The message whose turn waits for something; empty if none does."""
    turn_seconds: float
    recovery: str
    """The name of its recovery method; empty if nothing is recorded of it."""
    mechanism: tuple[str, ...]
    """The mechanisms that protect it, outermost first."""
    names: tuple[str, ...]
    """Names beside its address."""
    restart: str
    """When its supervisor restarts it; empty if nobody does."""
    is_supervisor: bool
    allowed_bytes: int = 0
    """The memory that its own process may have; 0 if nothing bounds it."""
    rests: bool = False
    """Whether its turn rests, as it has said: in a sleep, a wait for a message, or an effect."""


class ProcessUse(msgspec.Struct, frozen=True, array_like=True):
    """What a process has used."""

    pid: int
    memory_bytes: int
    cpu_seconds: float


class SystemLook(msgspec.Struct, frozen=True):
    """All rows of a system, parents before children, at one time."""

    system: str
    pid: int
    seconds: float
    """Of a clock that only goes forward, for rates between two looks."""
    rows: list[ActorRow]
    processes: list[ProcessUse]


LOOK: msgspec.msgpack.Decoder[SystemLook] = msgspec.msgpack.Decoder(SystemLook)


@dataclasses.dataclass(frozen=True, slots=True)
class Found:
    """An address on the way through the tree."""

    path: str
    cell: Cell | None
    child: Child | None
    """As its supervisor sees it, if that lives in this process."""
    pid: int


async def look_at(system: ActorSystem, *, parts: bool, paths: Iterable[str] | None = None) -> SystemLook:
    """Every actor of a system, in one pass; those in other processes are asked all at once.

    Args:
        system: the system.
        parts: whether the parts of the runtime itself are listed too: recovery, and what mechanisms are made of.
        paths: only the actors at these addresses; addresses at which nobody is known are left out.
    """
    top = Found(f"/{system.name}", system._root, None, os.getpid())
    rows: list[ActorRow] = []
    far: dict[int, Cell] = {}
    for number, one in enumerate(walk(top, parts=parts) if paths is None else found_at(system, paths, parts=parts), 1):
        if one.cell is not None and not one.cell.is_dead and is_far(one.cell):
            far[len(rows)] = one.cell
        rows.append(row_of(one))
        if number % SLICE == 0:
            await asyncio.sleep(0)
    for begin in range(0, len(far), SLICE):
        some = dict(list(far.items())[begin : begin + SLICE])
        told = await asyncio.gather(*(_asked(system, cell) for cell in some.values()))
        for place, status in zip(some, told, strict=True):
            rows[place] = as_told(rows[place], status)
    pids = sorted({row.pid for row in rows if row.pid} | {os.getpid()})
    uses = [use for pid in pids if (use := process_use(pid)) is not None]
    return SystemLook(system.name, os.getpid(), time.monotonic(), rows, uses)


async def silent_at_root(system: ActorSystem) -> list[str]:
    """The children of the root for which no process answers."""
    root = system._root
    paths = [cell.path for cell in (root.children or {}).values()] if root is not None else []
    return [row.path for row in (await look_at(system, parts=False, paths=paths)).rows if row.state == "silent"]


def walk(top: Found, *, parts: bool) -> Iterator[Found]:
    """The address, and all below it, parents before children; children that do not run stand where they would."""
    waiting = [top]
    while waiting:
        one = waiting.pop()
        cell = one.cell
        if cell is not None and not parts and cell_kind(cell) is RecoverySupervisor:
            continue
        yield one
        if cell is None or (not parts and isinstance(cell.spec, ChildSpec) and cell.spec.mechanism is not None):
            continue
        below: dict[str, Found] = {}
        actor = cell.actor
        for child in children_of(actor):
            path = f"{one.path}/{child.spec.id}"
            below[child.spec.id] = Found(path, child.cell, child, _pid(child.cell, one.pid))
        for name, under in list((cell.children or {}).items()):
            known = below.get(name)
            below[name] = Found(
                f"{one.path}/{name}", under, None if known is None else known.child, _pid(under, one.pid)
            )
        waiting.extend(reversed(below.values()))


def found_at(system: ActorSystem, paths: Iterable[str], *, parts: bool) -> Iterator[Found]:
    """What is found at these addresses; those at which nobody is known are left out, and parts of the runtime too."""
    for path in paths:
        try:
            one = find(system, path)
        except NoSuchActor:
            continue
        if parts or one.cell is None or not is_part(one.cell):
            yield one


def is_part(cell: Cell) -> bool:
    """Whether an actor is a part of the runtime itself: of recovery, or of what a mechanism is made of."""
    while cell_kind(cell) is not RecoverySupervisor:
        above = cell.parent
        if above is None:
            return False
        if isinstance(above.spec, ChildSpec) and above.spec.mechanism is not None:
            return True
        cell = above
    return True


def find(system: ActorSystem, path: str) -> Found:
    """An address as a pass through the whole tree finds it, also one that is stopped. Raises NoSuchActor."""
    try:
        cell = system.ref(path)._cell.living
    except NoSuchActor:
        above, _, name = path.rpartition("/")
        known = children_of(system.ref(above)._cell.actor) if above else []
        child = next((one for one in known if one.spec.id == name), None)
        if child is None:
            raise
        return Found(path, child.cell, child, 0)
    parent = cell.parent
    known = children_of(parent.actor) if parent is not None else []
    child = next((one for one in known if one.cell is cell), None)
    try:
        return Found(cell.path, cell, child, system.pid_of(cell.ref))
    except NoSuchActor:  # It is between two lives.
        return Found(cell.path, cell, child, 0)


def children_of(actor: Any) -> list[Child]:
    """What a supervisor of this process knows of its children; nothing if it is no supervisor, or not up yet."""
    known = isinstance(actor, Supervisor) and "_children" in actor.__dict__
    return list(actor._children.values()) if known else []


def is_far(cell: Cell) -> bool:
    """Whether another process knows more of the actor than this one."""
    return isinstance(cell.host, OutsideHost) or has_process(cell)


def _pid(cell: Cell | None, above: int) -> int:
    if cell is None or cell.is_dead:
        return 0
    place = cell.host.place
    worker = place.process(cell)
    return int(worker.pid) if worker is not None else 0 if place.owns_processes else above


def row_of(one: Found) -> ActorRow:
    """What this process knows of an address."""
    cell, child = one.cell, one.child
    spec = child.spec if child is not None else None
    if spec is None and cell is not None and isinstance(cell.spec, ChildSpec):
        spec = cell.spec
    kind = (cell_kind(cell) if cell is not None else None) or (spec.start.kind if spec is not None else None)
    status = status_of(cell) if cell is not None and not cell.is_dead else None
    is_protected = spec is not None and spec.mechanism is not None and status is not None
    recovery = spec.recovery if spec is not None else None
    if spec is None and status is not None and cell is not None and (switch := switch_of(cell)) is not None:
        recovery = switch.method  # Its supervisor lives in another process, and has its spec.
    return ActorRow(
        one.path,
        type_name(kind) if kind is not None else "",
        _state_of(status, child),
        "task" if spec is None else "replicas" if spec.mechanism is not None else spec.isolation,
        one.pid,
        max(0, status.life - 1) if status is not None else 0,
        status.queued if status is not None else 0,
        (status.turn or "") if status is not None else "",
        status.turn_seconds if status is not None else 0.0,
        recovery.name if recovery is not None and recovery.records else "",
        protection_of(cell).stack if is_protected and cell is not None else (),
        names_of(cell),
        spec.restart if spec is not None else "",
        kind is not None and issubclass(kind, Supervisor),
        (spec.limits.memory_bytes or 0) if spec is not None and spec.limits is not None else 0,
        status is not None and bool(status.turn_rests),
    )


def _state_of(status: Status | None, child: Child | None) -> str:
    if status is None or (child is not None and child.comes):
        return child.state if child is not None else "stopped"
    return status.state


def names_of(cell: Cell | None) -> tuple[str, ...]:
    """The names of an actor beside its address."""
    more = cell.more if cell is not None else None
    return tuple(more.belongings.names) if more is not None and more.has_more else ()


async def _asked(system: ActorSystem, cell: Cell) -> Status | None:
    try:
        return await system.get_status(cell.ref, timeout=FAR_TIMEOUT)
    except HoldfastError:  # It has ended, or says nothing: its row tells which.
        return None


def as_told(row: ActorRow, status: Status | None) -> ActorRow:
    """The row with what the actor's own process says; None: it says nothing."""
    if status is None:
        return msgspec.structs.replace(row, state="silent" if row.state == "running" else row.state)
    return msgspec.structs.replace(
        row,
        kind=status.kind or row.kind,
        state=status.state,
        pid=status.pid,
        restarts=max(row.restarts, status.life - 1),
        queued=status.queued,
        turn=status.turn or "",
        turn_seconds=status.turn_seconds,
        rests=bool(status.turn_rests),
    )


def process_use(pid: int) -> ProcessUse | None:
    """What a process has used so far; None if it has ended."""
    import psutil  # only in the program that is looked at: the commands do without it

    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times = process.cpu_times()
            return ProcessUse(pid, process.memory_info().rss, times.user + times.system)
    except psutil.Error:
        return None
