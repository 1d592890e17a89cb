"""Operations on supervisors and their children: add, remove, reorder, and a supervisor's flags."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import ActorStopped, AskTimeout, HoldfastError
from ...actors.kernel.actor import Start
from ...actors.kernel.cell import Cell
from ...actors.kernel.ref import ActorRef
from ...supervision.admin import (
    AlreadyPresent,
    Boxed,
    ChangeSupervisor,
    DeleteChild,
    MaxChildren,
    NoSuchChild,
    NotSupported,
    StartChild,
    TerminateChild,
)
from ...supervision.change import check_subtree
from ...supervision.dynamic import check_dynamic
from ...supervision.spec import NAMELESS, ChildSpec, Flags, Plan, check_spec, child
from ...supervision.supervisor import Supervisor
from .draft import Draft, Place, Target, check_awake, is_elsewhere
from .lasting import Specs, in_order, keep, recipe_specs, with_child, without
from .operation import Operation, wrong
from .turns import arrange, between_turns

if TYPE_CHECKING:
    from ..system import ActorSystem

START_TIMEOUT = 3600.0
"""Seconds a child may take to start; the transaction's own time limit is shorter."""


def text_of(target: Target) -> str:
    """A target as text."""
    return target if isinstance(target, str) else target.path


class Add(Operation):
    """Start one more child of a supervisor."""

    verb: ClassVar[str] = "add"

    def __init__(self, supervisor: Target, spec: ChildSpec) -> None:
        super().__init__(f"{text_of(supervisor)}/{spec.id}")
        self._at, self.spec = supervisor, spec
        self._place: Place | None = None
        self._above: Place | None = None
        self._asked = False  # the supervisor has been asked, and it is not known that it refused

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        above, spec = await draft.supervisor(self._at), self.spec
        check_child(above, spec)
        check_awake(above)
        if above.cell is not None and is_elsewhere(above.cell):
            check_subtree(above.path, (spec,))
            Boxed(spec).packed()
        self._above, self.between_turns_of = above, (above,)
        self._place = _planned(draft, above, spec)
        self.target = self._place.path

    async def do(self, system: ActorSystem) -> None:
        above, place = self._above, self._place
        assert above is not None
        assert place is not None
        supervisor: ActorRef[Supervisor] = ActorRef(above.living(system.node))
        self._asked = True
        try:
            ref = await supervisor.ask(StartChild(self.spec), START_TIMEOUT)
        except AskTimeout:
            raise
        except HoldfastError:
            self._asked = False  # It has refused, or the start has failed: nothing is left of it.
            raise
        if ref is not None:
            _fill(place, ref._cell)
            if is_elsewhere(supervisor._cell):
                _grant(place)

    async def undo(self, system: ActorSystem) -> None:
        above = self._above
        if not self._asked or above is None:
            return
        supervisor = above.living(system.node)
        cell = (supervisor.children or {}).get(self.spec.id)
        if cell is not None and not cell.host.is_up(cell):
            cell.kill()  # Its start would hold up its supervisor, and us, for as long as it likes.
        await forget(supervisor, self.spec.id)

    def verify(self, system: ActorSystem) -> None:
        if self._above is not None:
            self._above.living(system.node)

    def seal(self, system: ActorSystem) -> None:
        assert self._above is not None
        if self.spec.restart != "temporary" and not self._above.is_dynamic:
            keep(self._above.living(system.node), with_child(self.spec))


def check_child(above: Place, spec: ChildSpec) -> None:
    """Whether a supervisor in the draft can take this child.

    Raises:
        SpecError, NotSupported, AlreadyPresent, MaxChildren: why not.
    """
    if above.is_partitioned:
        raise NotSupported("the children of a partition supervisor are its partitions: use ResizePartitions")
    actor = above.actor
    if getattr(actor, "_template", None) is not None:
        raise wrong(above.path, "it has a template: ask it with StartChild(args=...)")
    check_spec(above.path, spec, above.flags.auto_shutdown if above.flags is not None else None)
    if spec.id in above.children:
        raise AlreadyPresent(spec.id)
    most = above.flags.max_children if above.flags is not None else None
    if most is not None and len(above.children) >= most:
        raise MaxChildren(most)


def _planned(draft: Draft, above: Place, spec: ChildSpec) -> Place:
    """The place of a child to be, and of those that come with it."""
    place = above.children[spec.id] = Place(spec.id, above, None, spec)
    place.is_planned = True
    for port, path in spec.bindings.items():
        place.bindings[port] = draft.find(path)
    flags, children = (*spec.start.args, None, None)[:2] if spec.is_supervisor else (None, None)
    place.flags = flags if isinstance(flags, Flags) else None
    for inner in children if isinstance(children, tuple) else ():
        if isinstance(inner, ChildSpec):
            _planned(draft, place, inner)
    return place


def _fill(place: Place, cell: Cell) -> None:
    """The place is lived in now: later steps find who does."""
    place.cell = cell
    for name, below in (cell.children or {}).items():
        if name in place.children:
            _fill(place.children[name], below)


def _grant(place: Place) -> None:
    """Who is started in another process is bound, there, to what its spec names: it is the root that says so."""
    for one in place.walk():
        if one.cell is not None and one.spec is not None:
            for port, path in one.spec.bindings.items():
                one.cell.node.bind(one.cell, port, one.cell.node.cell_at(path))


async def forget(supervisor: Cell, name: str) -> None:
    """Stop a child, and have its supervisor forget it."""
    ref: ActorRef[Supervisor] = ActorRef(supervisor)
    try:
        await ref.ask(TerminateChild(name), START_TIMEOUT)
        await ref.ask(DeleteChild(name), START_TIMEOUT)
    except (NoSuchChild, ActorStopped):
        pass  # It was temporary, or its supervisor is dynamic or has ended: nothing is left of it.


class Remove(Operation):
    """Stop an actor for good. That cannot be undone, so it is done when everything else has been."""

    verb: ClassVar[str] = "remove"

    def __init__(self, target: Target) -> None:
        super().__init__(text_of(target))
        self._at = target
        self.place: Place | None = None

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self.place = draft.find(self._at)
        above = place.parent
        if above is None:
            raise wrong(place.path, "the root is not removed: leave the system")
        if above.is_partitioned:
            raise NotSupported("the children of a partition supervisor are its partitions: use ResizePartitions")
        if place.is_planned:
            raise wrong(place.path, "it is added by this very transaction")
        self.target = place.path
        place.is_leaving = True

    async def do(self, system: ActorSystem) -> None:
        """Nothing: it goes when there is no way back."""

    async def undo(self, system: ActorSystem) -> None:
        """Nothing was done."""

    def seal(self, system: ActorSystem) -> None:
        above = self.place.parent if self.place is not None else None
        if above is not None and self.place is not None and above.cell is not None and above.is_supervisor:
            keep(above.living(system.node), without(self.place.name))

    async def finish(self, system: ActorSystem) -> None:
        place = self.place
        assert place is not None
        cell, above = place.cell, place.parent
        if cell is not None and not cell.is_dead:
            await system.stop(cell.ref)
        elif above is not None and above.is_supervisor:
            await forget(above.living(system.node), place.name)


class Reorder(Operation):
    """Give a supervisor's children another start order; nobody is restarted."""

    verb: ClassVar[str] = "reorder"

    def __init__(self, supervisor: Target, ids: list[str]) -> None:
        super().__init__(text_of(supervisor))
        self._at, self._ids = supervisor, ids
        self._place: Place | None = None
        self._before: list[str] | None = None
        self._cells_before: list[str] = []
        self._specs: Specs | None = None  # of a supervisor in another process

    @property
    def text(self) -> str:
        return f"reorder the children of {self.target}: {', '.join(self._ids)}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._place = await draft.supervisor(self._at)
        self.target, self.between_turns_of = place.path, (place,)
        if place.is_dynamic or place.is_partitioned:
            raise NotSupported("its children have no order of their own")
        missing = [name for name in self._ids if name not in place.children]
        if missing:
            raise NoSuchChild(missing[0])
        if len(set(self._ids)) != len(self._ids):
            raise wrong(place.path, f"an id comes twice in {self._ids!r}")
        if place.cell is not None and is_elsewhere(place.cell):
            self._specs = recipe_specs(place.cell)
            if self._specs is None or set(self._ids) - {spec.id for spec in self._specs}:
                raise NotSupported("it lives in another process, and its specs are known there only")
        rest = [name for name in place.children if name not in self._ids]
        place.children = {name: place.children[name] for name in (*self._ids, *rest)}

    async def do(self, system: ActorSystem) -> None:
        assert self._place is not None
        cell = self._place.living(system.node)
        if self._specs is not None:
            self._before = [spec.id for spec in self._specs]
            await self._tell(cell, self._ids)
        else:
            await between_turns(cell, self._arrange)

    def _arrange(self, supervisor: Supervisor) -> None:
        self._before = list(supervisor._children)
        self._cells_before = list(supervisor.ctx.cell.children or ())
        put_in_order(supervisor, self._ids)
        arrange(supervisor.ctx.cell, list(supervisor._children))

    async def undo(self, system: ActorSystem) -> None:
        before = self._before
        if before is None or self._place is None:
            return
        cell = self._place.living(system.node)
        if self._specs is not None:
            await self._tell(cell, before)
            return

        def back(supervisor: Supervisor) -> None:
            put_in_order(supervisor, before)
            arrange(supervisor.ctx.cell, self._cells_before)

        await between_turns(cell, back)

    async def _tell(self, cell: Cell, ids: list[str]) -> None:
        """A supervisor in another process takes its specs in the new order; none of them changes."""
        specs = {spec.id: spec for spec in self._specs or ()}
        ref: ActorRef[Supervisor] = ActorRef(cell)
        await ref.ask(ChangeSupervisor(children=[specs[name] for name in ids if name in specs]), START_TIMEOUT)

    def seal(self, system: ActorSystem) -> None:
        assert self._place is not None
        keep(self._place.living(system.node), in_order(self._ids))


def put_in_order(supervisor: Supervisor, ids: list[str]) -> None:
    """Sort a supervisor's children; those that are not named come behind."""
    known = supervisor._children
    first = {name: known[name] for name in ids if name in known}
    supervisor._children = {**first, **{name: one for name, one in known.items() if name not in first}}


class SetFlags(Operation):
    """Change some of a supervisor's flags: strategy, intensity, period."""

    verb: ClassVar[str] = "set"

    def __init__(self, supervisor: Target, **wanted: Any) -> None:
        super().__init__(text_of(supervisor))
        self._at, self._wanted = supervisor, wanted
        self._place: Place | None = None
        self._before: dict[str, Any] | None = None
        self._flags: Flags | None = None  # of a supervisor in another process, as they were

    @property
    def text(self) -> str:
        return f"set {', '.join(f'{name}={value!r}' for name, value in self._wanted.items())} of {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._place = await draft.supervisor(self._at)
        self.target, self.between_turns_of = place.path, (place,)
        if place.flags is None:
            raise NotSupported(
                "it lives in another process and its class has an init of its own: only it knows its flags"
            )
        if place.cell is not None and is_elsewhere(place.cell):
            self._flags = place.flags
        place.flags = dataclasses.replace(place.flags, **self._wanted)
        if place.is_dynamic:
            check_dynamic(place.path, Plan.of(place.flags, ()))

    async def do(self, system: ActorSystem) -> None:
        assert self._place is not None
        await self._set(self._place.living(system.node), self._take)

    def _take(self, flags: Flags) -> Flags:
        self._before = {name: getattr(flags, name) for name in self._wanted}
        return dataclasses.replace(flags, **self._wanted)

    async def undo(self, system: ActorSystem) -> None:
        before = self._before
        if before is not None and self._place is not None:
            await self._set(self._place.living(system.node), lambda flags: dataclasses.replace(flags, **before))

    async def _set(self, cell: Cell, edit: Callable[[Flags], Flags]) -> None:
        if self._flags is None:
            await between_turns(cell, lambda supervisor: setattr(supervisor, "_flags", edit(supervisor._flags)))
            return
        self._flags = edit(self._flags)
        ref: ActorRef[Supervisor] = ActorRef(cell)
        await ref.ask(ChangeSupervisor(flags=self._flags), START_TIMEOUT)

    def seal(self, system: ActorSystem) -> None:
        assert self._place is not None
        keep(self._place.living(system.node), self._edit)

    def _edit(self, flags: Flags, specs: Specs) -> tuple[Flags, Specs]:
        return dataclasses.replace(flags, **self._wanted), specs


def named_spec(supervisor: Target, spec: ChildSpec | Start[Any], taken: set[str], system: ActorSystem) -> ChildSpec:
    """The spec of a child to be added, with an id: a dynamic supervisor's child may come without.

    Raises:
        SpecError: it is no spec.
    """
    made = child(None, spec) if isinstance(spec, Start) else spec
    if not isinstance(made, ChildSpec):
        raise wrong("add", f"takes child(...), start(...) or supervisor(...), not {spec!r}")
    if made.id != NAMELESS:
        return made
    path = text_of(supervisor)
    above = system.node.find(path)
    known = set((above.children if above is not None else None) or ())
    prefix, number = made.start.kind.__name__.lower(), 1
    while f"{prefix}-{number}" in known or f"{path}/{prefix}-{number}" in taken:
        number += 1
    return dataclasses.replace(made, id=f"{prefix}-{number}")
