"""Operations on supervisors and their children: add, remove, reorder, and a supervisor's flags."""

from __future__ import annotations

import dataclasses
import itertools
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import ActorStopped, NameTaken, StartFailed
from ...actors.kernel.actor import Start
from ...actors.kernel.cell import Cell
from ...actors.kernel.ref import ActorRef, Target
from ...supervision.admin import (
    AlreadyPresent,
    AlreadyStarted,
    Boxed,
    MaxChildren,
    NoSuchChild,
    NotSupported,
    RemoveChild,
    StartChild,
)
from ...supervision.dynamic import DynamicSupervisor, check_dynamic
from ...supervision.services.partition import UniformSupervisor
from ...supervision.spec import NAMELESS, ChildSpec, Flags, Plan, check_spec, child
from ...supervision.supervisor import Supervisor
from ...supervision.supervisor_changes import check_subtree
from .arrangement import planned_spec
from .draft import START_TIMEOUT, Draft, DraftPlace, check_awake, is_elsewhere
from .lasting import recipe_specs
from .operation import Operation, text_of, wrong

if TYPE_CHECKING:
    from ..system import ActorSystem


CANDIDATES = itertools.count(1)
"""Each child that a transaction starts is known by a number, should its supervisor end before it has answered."""


class Newcomer:
    """A child that is added. Its supervisor starts it before the commit, and gives it up if there is none.

    If that supervisor is added too it begins with it; where somebody lives until the commit it is started behind it.
    """

    def __init__(self, place: DraftPlace) -> None:
        self.place = place
        place.candidate = next(CANDIDATES)
        self._asked: Cell | None = None  # the supervisor that was asked
        self._life = 0  # of that supervisor
        self._is_over = False  # it has been up, and has ended by itself as it may

    @property
    def _above(self) -> DraftPlace | None:
        """Its supervisor; None if that one is not asked to start it before the commit."""
        place, above = self.place, self.place.parent
        assert above is not None
        return None if above.is_planned or place.comes_last or self._is_over else above

    async def prepare(self, system: ActorSystem) -> None:
        """Have the supervisor start it, unless that has done so in this very life."""
        above, place = self._above, self.place
        if above is None:
            return
        cell = above.living(system._node)
        if self._asked is cell and self._life == cell.coming_life and place.name in (cell.children or {}):
            return  # It is being restarted.
        self._asked, self._life = cell, cell.coming_life
        ref = await self._start(cell, in_force=False)
        if ref is None:
            self._is_over = True  # It did not want to be started.
            return
        fill(place, ref._cell)
        if is_elsewhere(cell):
            _grant(place)

    async def _start(self, above: Cell, *, in_force: bool) -> ActorRef[Any] | None:
        supervisor: ActorRef[Supervisor] = ActorRef(above)
        spec = planned_spec(self.place, in_force=in_force)
        ref: ActorRef[Any] | None = await supervisor.ask(
            StartChild(spec, candidate=self.place.candidate), START_TIMEOUT
        )
        return ref

    def ready(self, system: ActorSystem) -> str:
        """Whether it is up, as the child of the life that its supervisor lives now."""
        above, place = self._above, self.place
        if above is None:
            return ""
        supervisor = above.living(system._node)
        if supervisor is not self._asked or supervisor.coming_life != self._life:
            return f"{above.path} has been restarted"
        cell = (supervisor.children or {}).get(place.name)
        if cell is None and place.cell is not None:
            reason, spec = place.cell.extra().reason, place.spec
            if place.cell.is_dead and reason.is_clean and spec is not None and spec.restart != "permanent":
                self._is_over = True
                return ""
            raise StartFailed(place.path, f"it has ended: {reason}")
        if cell is None or not cell.host.is_up(cell):
            return f"{place.path} is being started"
        fill(place, cell)
        return ""

    async def finish(self, system: ActorSystem) -> None:
        """Start it where its address was not free before."""
        if not self.place.comes_last:
            return
        assert self.place.parent is not None
        try:
            await self._start(self.place.parent.living(system._node), in_force=True)
        except (AlreadyPresent, AlreadyStarted):
            pass  # Its supervisor was restarted, and knows it from its recipe.

    async def release(self, *, erase: bool = True) -> None:
        """Nothing is left of it, nor, with `erase`, of what was recorded at its address and below it."""
        if self._asked is None or self._asked.is_dead:
            return  # What was started has ended with it.
        supervisor: ActorRef[Supervisor] = ActorRef(self._asked)
        try:
            await supervisor.ask(
                RemoveChild(self.place.name, erase=erase, candidate=self.place.candidate), START_TIMEOUT
            )
        except ActorStopped:
            pass  # The same.


class AddChild(Operation):
    """Start one more child of a supervisor, and those that come with it."""

    verb: ClassVar[str] = "add"

    def __init__(self, supervisor: Target, spec: ChildSpec) -> None:
        super().__init__(supervisor, spec.id)
        self.spec = spec
        self._newcomers: list[Newcomer] = []

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        above, spec = await draft.supervisor(self._at), self.spec
        check_child(above, spec)
        check_awake(above)
        if above.cell is not None and is_elsewhere(above.cell):
            check_subtree(above.path, (spec,))
            Boxed(spec).packed()
        self.between_turns_of = (above,)
        self._newcomers = [Newcomer(place) for place in _planned(draft, above, spec).walk()]
        self.target = self._newcomers[0].place.path
        draft.arrangement.touch(above, self)

    async def prepare(self, system: ActorSystem) -> None:
        for one in self._newcomers:
            await one.prepare(system)

    def ready(self, system: ActorSystem) -> str:
        return next((why for one in self._newcomers if (why := one.ready(system))), "")

    async def finish(self, system: ActorSystem) -> None:
        for one in self._newcomers:
            await one.finish(system)

    async def release(self, system: ActorSystem) -> None:
        for one in reversed(self._newcomers):
            await one.release()


def check_not_uniform(above: DraftPlace) -> None:
    """Raises NotSupported: the children of this supervisor are all alike, and none of them comes or goes alone."""
    if above.kind is not None and issubclass(above.kind, UniformSupervisor):
        raise NotSupported(above.kind.instead)


def check_child(above: DraftPlace, spec: ChildSpec) -> None:
    """Whether a supervisor in the draft can take this child.

    Raises:
        SpecError, NotSupported, AlreadyPresent, MaxChildren: why not.
    """
    check_not_uniform(above)
    actor = above.actor
    if isinstance(actor, DynamicSupervisor) and actor._template is not None:
        raise wrong(above.path, "it has a template: ask it with StartChild(args=...)")
    check_spec(above.path, spec, above.flags.auto_shutdown if above.flags is not None else None)
    if spec.id in above.children:
        raise AlreadyPresent(spec.id)
    most = above.flags.max_children if above.flags is not None else None
    if most is not None and len(above.children) >= most:
        raise MaxChildren(most)


def _planned(draft: Draft, above: DraftPlace, spec: ChildSpec) -> DraftPlace:
    """The place of a child to be, and of those that come with it.

    Raises:
        NameTaken: its name is somebody's now (it is started before the others change), or another one's to be.
    """
    name = None if spec.register is None else spec.register.text
    if name is not None and (name in draft.node.names or any(name in other.names for other in draft.root.walk())):
        raise NameTaken(name)
    place = above.children[spec.id] = DraftPlace(spec.id, above, None, spec)
    place.is_planned, place.is_stopped = True, False
    place.names += [] if name is None else [name]
    for port, path in spec.bindings.items():
        place.bindings[port] = draft.find(path)
    flags, children = (*spec.start.args, None, None)[:2] if spec.is_supervisor else (None, None)
    place.flags = flags if isinstance(flags, Flags) else None
    for inner in children if isinstance(children, tuple) else ():
        if isinstance(inner, ChildSpec):
            _planned(draft, place, inner)
    return place


def fill(place: DraftPlace, cell: Cell) -> None:
    """A place is lived in now: later steps find who does."""
    place.cell = cell
    for name, below in (cell.children or {}).items():
        if name in place.children:
            fill(place.children[name], below)


def _grant(place: DraftPlace) -> None:
    """Who is started in another process is bound, there, to what its spec names: it is the root that says so."""
    for one in place.walk():
        if one.cell is not None and one.spec is not None:
            for port, path in one.spec.bindings.items():
                one.cell.node.bind(one.cell, port, one.cell.node.cell_at(path))


class RemoveActor(Operation):
    """Stop an actor for good, when all else is in force."""

    verb: ClassVar[str] = "remove"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._found = draft.find(self._at)
        above = place.parent
        if above is None:
            raise wrong(place.path, "the root is not removed: leave the system")
        check_not_uniform(above)
        if place.is_planned:
            raise wrong(place.path, "it is added by this very transaction")
        self.target = place.path
        place.is_leaving = True
        if above.is_supervisor:
            draft.arrangement.touch(above, self, only_recipe=True)

    def commit(self, system: ActorSystem) -> None:
        system._mechanism_notes.gone(self._place.path)

    async def finish(self, system: ActorSystem) -> None:
        place = self._place
        cell, above = place.now(system._node), place.parent
        if cell is not None:
            await system.stop(cell.ref)
        elif above is not None and above.is_supervisor:  # It does not run; its spec is there.
            supervisor: ActorRef[Supervisor] = ActorRef(above.living(system._node))
            try:
                await supervisor.ask(RemoveChild(place.name), START_TIMEOUT)
            except (NoSuchChild, ActorStopped):
                pass  # Its supervisor was restarted, and does not know it any more.


class OnSupervisor(Operation):
    """Base of operations on what a supervisor is made of. One in another process is told when it is in force."""

    verb: ClassVar[str] = "set"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._found = await draft.supervisor(self._at)
        self.target, self.between_turns_of = place.path, (place,)
        draft.arrangement.touch(place, self, is_told=True)


class Reorder(OnSupervisor):
    """Give a supervisor's children another start order; nobody is restarted."""

    verb: ClassVar[str] = "reorder"

    def __init__(self, supervisor: Target, ids: list[str]) -> None:
        super().__init__(supervisor)
        self._ids = ids

    @property
    def text(self) -> str:
        return f"reorder the children of {self.target}: {', '.join(self._ids)}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        if place.is_dynamic or place.is_partitioned:
            raise NotSupported("its children have no order of their own")
        missing = [name for name in self._ids if name not in place.children]
        if missing:
            raise NoSuchChild(missing[0])
        if len(set(self._ids)) != len(self._ids):
            raise wrong(place.path, f"an id comes twice in {self._ids!r}")
        if place.cell is not None and is_elsewhere(place.cell):
            specs = recipe_specs(place.cell)
            if specs is None or set(self._ids) - {spec.id for spec in specs}:
                raise NotSupported("it lives in another process, and its specs are known there only")
        first = {name: place.children[name] for name in self._ids}
        place.children = {**first, **place.children}


class SetFlags(OnSupervisor):
    """Change some of a supervisor's flags: strategy, intensity, period."""

    def __init__(self, supervisor: Target, **wanted: Any) -> None:
        super().__init__(supervisor)
        self._wanted = wanted

    @property
    def text(self) -> str:
        return f"set {', '.join(f'{name}={value!r}' for name, value in self._wanted.items())} of {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        if place.flags is None:
            raise NotSupported(
                "it lives in another process and its class has an init of its own: only it knows its flags"
            )
        place.flags = dataclasses.replace(place.flags, **self._wanted)
        place.wanted.update(self._wanted)
        if place.is_dynamic:
            check_dynamic(place.path, Plan.of(place.flags, ()))


def named_spec(supervisor: Target, spec: ChildSpec | Start[Any], taken: set[str], system: ActorSystem) -> ChildSpec:
    """The spec of a child to be added, with an id: a dynamic supervisor's child may come without.

    Raises:
        SpecError: it is no spec.
    """
    made = child(None, spec) if isinstance(spec, Start) else spec
    if not isinstance(made, ChildSpec):
        raise wrong("add", f"takes child(...), start(...) or supervisor(...), not {spec!r}")
    made = dataclasses.replace(made, comes_back=True, made_up=False)  # As it was told of another child, perhaps.
    if made.id != NAMELESS:
        return made
    path = text_of(supervisor)
    above = system._node.find(path)
    known = set((above.children if above is not None else None) or ())
    prefix, number = made.start.kind.__name__.lower(), 1
    while f"{prefix}-{number}" in known or f"{path}/{prefix}-{number}" in taken:
        number += 1
    return dataclasses.replace(made, id=f"{prefix}-{number}")
