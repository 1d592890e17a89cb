"""Operations on what connects actors: bindings and names."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import ActorStopped, NameTaken, NoSuchActor, type_name
from ...actors.kernel.cell import RUNNING
from ...actors.kernel.ref import Target
from ...actors.values.path_parts import check_beside
from ...supervision.respec import rebind
from .draft import Draft, DraftPlace
from .operation import Operation, text_of, wrong

if TYPE_CHECKING:
    from ..system import ActorSystem


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
