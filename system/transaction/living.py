"""Operations on one live actor: suspend, resume, other state, other code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.control.orders import Change, ReplaceCode, ReplaceState, next_start
from ...actors.errors import SpecError, type_name
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.ref import Target
from .draft import Draft, DraftPlace, is_elsewhere
from .operation import PROTECTED, Operation, StagedWork, wrong
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
        if cell is not None and not is_elsewhere(cell):
            next_start(cell, start, keeps_arguments=keeps)
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
