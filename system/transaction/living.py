"""Operations on live actors: suspend, resume, other state, other code, bindings and names."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.control.orders import Change, ReplaceCode, ReplaceState, check_start, next_start
from ...actors.errors import ActorStopped, NameTaken, NoSuchActor, SpecError, type_name
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.cell import RUNNING
from ...actors.kernel.ref import Target
from ...actors.values.path_parts import check_beside
from ...supervision.respec import rebind
from ...supervision.spec import ChildSpec
from .draft import Draft, DraftPlace, is_elsewhere
from .operation import PROTECTED, Operation, StagedWork, text_of, wrong
from .rework import Rework

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ..system import ActorSystem


class OnLiving(Operation):
    """Base of operations on one live actor."""

    on_parts: ClassVar[bool] = False
    """Whether it may be a part of a mechanism."""

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._found = draft.find(self._at, parts=self.on_parts)
        self.target, self.between_turns_of = place.path, (place,)
        place.check_lived_in(system._node)

    def cell(self, system: ActorSystem) -> Cell:
        """Who lives there now. Raises NoSuchActor."""
        return self._place.living(system._node)


class OnSharedWork(OnLiving):
    """Base of operations on one actor that are carried out together: the first one has the work for the others too."""

    _work: StagedWork | None = None

    @property
    def work(self) -> StagedWork:
        return self if self._work is None else self._work

    async def prepare(self, system: ActorSystem) -> None:
        if self._work is not None:
            await self._work.prepare(system)

    @property
    def waits_for(self) -> str:
        return "" if self._work is None else self._work.waits_for

    def ready(self, system: ActorSystem) -> str:
        return "" if self._work is None else self._work.ready(system)

    def commit(self, system: ActorSystem) -> None:
        if self._work is not None:
            self._work.commit(system)

    async def finish(self, system: ActorSystem) -> None:
        if self._work is not None:
            await self._work.finish(system)

    async def let_go(self, system: ActorSystem) -> bool:
        return self._work is not None and await self._work.let_go(system)

    async def release(self, system: ActorSystem) -> None:
        if self._work is not None:
            await self._work.release(system)


class OnRework(OnSharedWork):
    """Base of operations that hold an actor until the transaction is over."""

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        if place.rework is None:
            place.rework = self._work = Rework(place)


class SuspendActor(OnRework):
    """Have an actor handle no message until it is resumed."""

    verb: ClassVar[str] = "suspend"
    on_parts: ClassVar[bool] = True

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        assert self._place.rework is not None
        self._place.is_suspended = self._place.rework.suspended = True


class ResumeActor(OnRework):
    """Have it handle messages again."""

    verb: ClassVar[str] = "resume"
    on_parts: ClassVar[bool] = True

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        assert self._place.rework is not None
        self._place.is_suspended = self._place.rework.suspended = False


class ReplaceActorState(OnRework):
    """Put another state in the place of an actor's."""

    verb: ClassVar[str] = "replace state of"

    def __init__(self, target: Target, change: Change) -> None:
        super().__init__(target)
        self._change = change

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        self._place.rework_of().add(ReplaceState(self._change))


class ReplaceActorCode(OnRework):
    """Have an actor go on as another class, now and after restarts."""

    verb: ClassVar[str] = "replace code of"

    def __init__(self, target: Target, new: type[Actor] | Start[Any], change: Change | None) -> None:
        super().__init__(target)
        self._new, self._change = new, change

    @property
    def text(self) -> str:
        kind = self._new.kind if isinstance(self._new, Start) else self._new
        return f"replace code of {self.target} by {type_name(kind)}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        new = self._new
        start = new if isinstance(new, Start) else Start(new) if _is_actor(new) else None
        if start is None:
            raise SpecError(self.target, f"replace_code takes an Actor class or start(Class, ...), not {new!r}")
        place = self._place
        cell, keeps = place.cell, not isinstance(new, Start)
        if cell is not None and isinstance(cell.spec, ChildSpec) and not is_elsewhere(cell):
            next_start(cell, start, keeps_arguments=keeps)
        elif (spec := place.know_spec()) is not None:
            old = spec.start
            check_start(place.path, spec, Start(start.kind, old.args, old.kwargs) if keeps else start)
        place.rework_of().add(ReplaceCode(start, keeps, self._change))
        place.kind = start.kind


def check_unprotected(place: DraftPlace) -> None:
    """Refuse what would change one replica of a protected actor, and not the others. Raises SpecError."""
    if place.spec is not None and place.spec.mechanism is not None:
        raise wrong(
            place.path,
            PROTECTED,
        )


def _is_actor(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, Actor)


class Bind(Operation):
    """Point a binding elsewhere; its owner sees that from its next turn on."""

    verb: ClassVar[str] = "bind"

    def __init__(self, owner: Target, port: str, target: Target) -> None:
        super().__init__(owner)
        self._port, self._to = port, target
        self._owner: DraftPlace | None = None
        self._bound: DraftPlace | None = None

    @property
    def text(self) -> str:
        to = self._bound.path if self._bound is not None else text_of(self._to)
        return f"bind {self._port} of {self.target} to {to}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        owner = self._owner = draft.find(self._at)
        self._bound = draft.find(self._to)
        self.target = owner.path
        for place in (owner, self._bound):
            place.check_lived_in(system._node, before_commit=False)
        kind = owner.kind
        if kind is not None and self._port not in kind._bindings:
            known = ", ".join(sorted(kind._bindings)) or "none"
            raise wrong(owner.path, f"{type_name(kind)} has no binding {self._port!r} (it has: {known})")
        owner.bindings[self._port] = self._bound

    def ready(self, system: ActorSystem) -> str:
        assert self._owner is not None
        assert self._bound is not None
        for place in (self._owner, self._bound):
            if not place.comes_last:
                place.living(system._node)
        return ""

    def commit(self, system: ActorSystem) -> None:
        assert self._owner is not None
        assert self._bound is not None
        owner, target = self._owner.living(system._node), self._bound.living(system._node)
        system._node.bind(owner, self._port, target)
        rebind(owner, self._port, target.path)


class Unbind(Operation):
    """Point a binding nowhere; its owner sees that from its next turn on."""

    verb: ClassVar[str] = "unbind"

    def __init__(self, owner: Target, port: str) -> None:
        super().__init__(owner)
        self._port = port
        self._owner: DraftPlace | None = None

    @property
    def text(self) -> str:
        return f"unbind {self._port} of {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        owner = self._owner = draft.find(self._at)
        self.target = owner.path
        owner.check_lived_in(system._node)
        if self._port not in owner.bindings:
            raise wrong(owner.path, f"its binding {self._port!r} points nowhere already, as far as is known here")
        if owner.cell is not None and not owner.cell.host.place.is_here:
            raise wrong(owner.path, "it lives in another process, which keeps a binding: bind it to somebody else")
        del owner.bindings[self._port]
        if owner.spec is not None and not owner.is_planned:  # It may be started before its target from now on.
            left = {port: path for port, path in owner.spec.bindings.items() if port != self._port}
            owner.spec = dataclasses.replace(owner.spec, bindings=left)

    def ready(self, system: ActorSystem) -> str:
        assert self._owner is not None
        self._owner.living(system._node)
        return ""

    def commit(self, system: ActorSystem) -> None:
        assert self._owner is not None
        owner = self._owner.living(system._node)
        more = owner.extra()
        more.bindings.pop(self._port, None)
        rebind(owner, self._port, None)
        if more.turn is not None and more.turn.rebinds is not None:
            more.turn.rebinds.pop(self._port, None)


class RegisterName(Operation):
    """Give an actor a name beside its address."""

    verb: ClassVar[str] = "register"

    def __init__(self, name: str, target: Target) -> None:
        super().__init__(target)
        self._name = name

    @property
    def text(self) -> str:
        return f"register {self.target} as {self._name!r}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        self.target = place.path
        check_beside(place.path, self._name)
        place.check_lived_in(system._node)
        holder = holder_of(self._name, draft)
        if holder is not None and holder is not place:
            raise NameTaken(self._name)
        if place.cell is not None and place.cell.state is not RUNNING:
            raise ActorStopped(place.path)
        if holder is None:
            place.names.append(self._name)
        draft.arrangement.name(self._name, self, draft.named.get(self._name), place)


class UnregisterName(Operation):
    """Free a name."""

    verb: ClassVar[str] = "unregister"

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._name = name

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        holder = holder_of(self._name, draft)
        if holder is None:
            raise NoSuchActor(self._name)
        holder.names.remove(self._name)
        draft.arrangement.name(self._name, self, draft.named.get(self._name), None)


def holder_of(name: str, draft: Draft) -> DraftPlace | None:
    """Who has a name at this point."""
    return next((place for place in draft.root.walk() if name in place.names), None)
