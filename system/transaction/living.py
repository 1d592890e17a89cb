"""Operations on live actors: suspend, resume, other state, other code, another process."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.control.live_state import Opaque
from ...actors.control.orders import Change, Migrate, next_start
from ...actors.errors import ControlFailed, SpecError, type_name
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.cell import Cell
from ...supervision.spec import Isolation
from .draft import Draft, Place, Target, is_elsewhere
from .operation import Operation, wrong
from .structure import text_of

if TYPE_CHECKING:
    from ..system import ActorSystem


class OnLiving(Operation):
    """Base of operations on one live actor."""

    on_parts: ClassVar[bool] = False
    """Whether it may be a part of a mechanism."""

    def __init__(self, target: Target) -> None:
        super().__init__(text_of(target))
        self._at = target
        self._place: Place | None = None

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._place = draft.find(self._at, parts=self.on_parts)
        self.target, self.between_turns_of = place.path, (place,)
        place.check_lived_in(system.node)

    def cell(self, system: ActorSystem) -> Cell:
        """Who lives there now. Raises NoSuchActor."""
        assert self._place is not None
        return self._place.living(system.node)


class Suspend(OnLiving):
    """Have an actor handle no message until it is resumed."""

    verb: ClassVar[str] = "suspend"
    on_parts: ClassVar[bool] = True
    _done = False

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        assert self._place is not None
        self._place.is_suspended = True

    async def do(self, system: ActorSystem) -> None:
        cell = self.cell(system)
        status = await system.get_status(cell.ref)
        if status.state != "suspended":
            self._done = True
            await system.suspend(cell.ref)

    async def undo(self, system: ActorSystem) -> None:
        if self._done:
            await system.resume(self.cell(system).ref)


class Resume(OnLiving):
    """Have it handle messages again."""

    verb: ClassVar[str] = "resume"
    on_parts: ClassVar[bool] = True
    _done = False

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        assert self._place is not None
        self._place.is_suspended = False

    async def do(self, system: ActorSystem) -> None:
        cell = self.cell(system)
        status = await system.get_status(cell.ref)
        if status.state == "suspended":
            self._done = True
            await system.resume(cell.ref)

    async def undo(self, system: ActorSystem) -> None:
        if self._done:
            await system.suspend(self.cell(system).ref)


class Held(OnLiving):
    """Base of operations that hold the messages of an actor until there is no way back, or all is as before.

    What it handled in between would be lost with the new state when that is undone.
    """

    _held = False  # it is we who have suspended it
    _before: Any = None
    _is_known = False  # whether `_before` is the state to go back to

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        assert self._place is not None
        if self._place.is_supervisor:
            raise wrong(self.target, "a supervisor is changed by its own operations: add, remove, strategy ...")
        check_unprotected(self._place)

    async def _hold(self, system: ActorSystem) -> Cell:
        cell = self.cell(system)
        status = await system.get_status(cell.ref)
        if status.state != "suspended":
            self._held = True
            await system.suspend(cell.ref)
        self._before = await system.get_state(cell.ref)
        where = opaque_in(self._before)
        if where is not None:
            raise ControlFailed(cell.path, self.verb, f"its state could not be put back: {where} cannot be copied")
        return cell

    async def _release(self, system: ActorSystem) -> None:
        if self._held:
            self._held = False
            await system.resume(self.cell(system).ref)

    async def finish(self, system: ActorSystem) -> None:
        await self._release(system)


class ReplaceState(Held):
    """Put another state in the place of an actor's."""

    verb: ClassVar[str] = "replace state of"

    def __init__(self, target: Target, change: Change) -> None:
        super().__init__(target)
        self._change = change

    async def do(self, system: ActorSystem) -> None:
        cell = await self._hold(system)
        self._is_known = True
        await system.replace_state(cell.ref, self._change)

    async def undo(self, system: ActorSystem) -> None:
        if self._is_known:
            await system.replace_state(self.cell(system).ref, functools.partial(given, self._before))
        await self._release(system)


class ReplaceCode(Held):
    """Have an actor go on as another class, now and after restarts."""

    verb: ClassVar[str] = "replace code of"

    def __init__(self, target: Target, new: type[Actor] | Start[Any], migrate: Migrate | None) -> None:
        super().__init__(target)
        self._new, self._migrate = new, migrate
        self._old: Start[Any] | None = None

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
        assert self._place is not None
        cell = self._place.cell
        if cell is not None and is_elsewhere(cell) and cell.extra().start is None:
            raise wrong(self.target, "its class is known in its own process only, so the old one could not be put back")
        if cell is not None and not is_elsewhere(cell):
            next_start(cell, start, keeps_arguments=not isinstance(new, Start))
        self._place.kind = start.kind

    async def do(self, system: ActorSystem) -> None:
        cell = await self._hold(system)
        self._old = cell.extra().start
        self._is_known = True
        await system.replace_code(cell.ref, self._new, self._migrate)

    async def undo(self, system: ActorSystem) -> None:
        if self._is_known and self._old is not None:
            back = functools.partial(given, self._before)
            await system.replace_code(self.cell(system).ref, self._old, back)
        await self._release(system)


def check_unprotected(place: Place) -> None:
    """Refuse what would change one replica of a protected actor, and not the others. Raises SpecError."""
    if place.spec is not None and place.spec.mechanism is not None:
        raise wrong(place.path, "it is protected by a mechanism: detach that, and attach it again after")


def _is_actor(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, Actor)


def given(state: Any, *_: Any) -> Any:
    """The state to go back to; a function of a module, for it may have to run in another process."""
    return state


def opaque_in(state: Any, where: str = "state") -> str | None:
    """Where in a copied state something stands that could not be copied; None if nowhere."""
    if isinstance(state, Opaque):
        return where
    items = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, (list, tuple)) else ()
    return next((found for key, value in items if (found := opaque_in(value, f"{where}[{key!r}]")) is not None), None)


class Isolate(OnLiving):
    """Have an actor live in a process of its own, or as a task of this one."""

    verb: ClassVar[str] = "isolate"

    def __init__(self, target: Target, isolation: Isolation) -> None:
        super().__init__(target)
        self._to: Isolation = isolation
        self._before: Isolation | None = None
        self._moving: asyncio.Task[None] | None = None

    @property
    def text(self) -> str:
        return f"have {self.target} live in a {self._to}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        await super().check(system, draft)
        place = self._place
        assert place is not None
        if self._to not in ("task", "process"):
            raise SpecError(self.target, f"isolation must be one of task, process, not {self._to!r}")
        if place.spec is None:
            raise wrong(self.target, "nobody supervises it: it has no isolation to change")
        check_unprotected(place)
        place.spec = dataclasses.replace(place.spec, isolation=self._to)

    async def do(self, system: ActorSystem) -> None:
        cell = self.cell(system)
        before: Isolation = cell.spec.isolation
        if before != self._to:
            self._before = before
            moving = system.set_isolation(cell.ref, self._to)
            self._moving = system.node.loop.create_task(moving, name=f"isolation of {cell.path}")
            await asyncio.shield(self._moving)

    async def undo(self, system: ActorSystem) -> None:
        if self._before is None:
            return
        if self._moving is not None:
            await asyncio.wait((self._moving,))  # Whoever is cancelled gives up waiting; the move comes to its end.
            if not self._moving.cancelled():
                self._moving.exception()
        cell = self.cell(system)
        if cell.spec.isolation != self._before:  # Else it stayed where it was.
            await system.set_isolation(cell.ref, self._before)
