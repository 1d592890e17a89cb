"""Operations on whether a child runs: stop one whose spec stays, start it again."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import NoSuchActor
from ...actors.kernel.cell import Cell
from ...actors.kernel.ref import ActorRef
from ...supervision.admin import NotSupported, RestartChild, TerminateChild
from ...supervision.supervisor import Supervisor
from .draft import Draft, Place, Target, check_awake, is_elsewhere
from .lasting import changed, keep
from .operation import Operation, wrong
from .structure import START_TIMEOUT, busy, child_of, text_of

if TYPE_CHECKING:
    from ..system import ActorSystem


class OnChild(Operation):
    """Base: a child of a supervisor of this process, by its name."""

    def __init__(self, target: str) -> None:
        super().__init__(target)
        self._above: Place | None = None
        self._place: Place | None = None
        self._name = ""

    def _take(self, above: Place, place: Place, *, starts: bool) -> None:
        self._above, self._place, self._name = above, place, place.name
        self.target, self.between_turns_of = f"{above.path}/{place.name}", (above,)
        if above.is_dynamic or above.is_partitioned:
            raise NotSupported("a child without a place of its own cannot be stopped for a while: remove it")
        if above.cell is None or is_elsewhere(above.cell):
            raise wrong(self.target, "its supervisor lives in another process")
        check_awake(above)
        assert place.spec is not None
        place.spec = dataclasses.replace(place.spec, autostart=starts)
        place.is_stopped = not starts

    def _supervisor(self, system: ActorSystem) -> Cell:
        """Who looks after it at this instant: another step may move it."""
        assert self._above is not None
        cell = self._place.cell if self._place is not None else None
        if cell is not None and not cell.is_dead and cell.parent is not None:
            return cell.parent
        return self._above.living(system.node)

    def ready(self, system: ActorSystem) -> str:
        supervisor = self._supervisor(system)
        if why := busy(supervisor):
            return why
        if child_of(supervisor, self._name) is None:
            raise NoSuchActor(self.target)
        return ""

    def _put(self, system: ActorSystem, *, starts: bool) -> None:
        """From now on its supervisor starts it with the others, or does not."""
        supervisor = self._supervisor(system)
        one = child_of(supervisor, self._name)
        assert one is not None
        one.spec = dataclasses.replace(one.spec, autostart=starts)
        if one.cell is not None:
            one.cell.spec = one.spec
        keep(supervisor, changed(self._name, autostart=starts))

    async def _stop(self, supervisor: Cell) -> None:
        above: ActorRef[Supervisor] = ActorRef(supervisor)
        await above.ask(TerminateChild(self._name), START_TIMEOUT)


class StopChild(OnChild):
    """Stop a child; its spec stays, and says that it is not started until it is started by order."""

    verb: ClassVar[str] = "stop"

    def __init__(self, target: Target) -> None:
        super().__init__(text_of(target))
        self._at = target

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        place.check_lived_in(system.node)
        if place.parent is None or not place.parent.is_supervisor or place.spec is None:
            raise wrong(place.path, "no supervisor looks after it")
        if place.is_planned:
            raise wrong(place.path, "it is added by this very transaction")
        if place.spec.restart == "temporary":
            raise wrong(place.path, "its spec is temporary, and would not stay: remove it")
        self._take(place.parent, place, starts=False)
        stopped = set(place.walk())
        for owner in draft.staying():
            bound = next((to for to in owner.bindings.values() if to in stopped), None)
            if bound is not None and owner not in stopped:
                raise wrong(owner.path, f"a binding of it would point at {bound.path}, which is stopped")

    def commit(self, system: ActorSystem) -> None:
        self._put(system, starts=False)

    async def finish(self, system: ActorSystem) -> None:
        await self._stop(self._supervisor(system))


class StartAgain(OnChild):
    """Start a child again that was stopped."""

    verb: ClassVar[str] = "start"

    def __init__(self, supervisor: Target, name: str) -> None:
        super().__init__(f"{text_of(supervisor)}/{name}")
        self._at, self._name = supervisor, name
        self._asked: Cell | None = None  # the supervisor that was asked
        self._life = 0
        self._is_over = False  # it did not want to be started

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        above = await draft.supervisor(self._at)
        place = above.children.get(self._name)
        if place is None or place.spec is None:
            raise NoSuchActor(self.target)
        if not place.is_stopped:
            raise wrong(self.target, "it runs")
        self._take(above, place, starts=True)
        if place.cell is not None and not place.cell.is_dead:
            raise wrong(self.target, "it is stopped by this very transaction")

    async def prepare(self, system: ActorSystem) -> None:
        supervisor = self._supervisor(system)
        if self._is_over or (self._asked is supervisor and self._life == supervisor.life):
            return  # It is being restarted.
        self._asked, self._life = supervisor, supervisor.life
        above: ActorRef[Supervisor] = ActorRef(supervisor)
        ref = await above.ask(RestartChild(self._name), START_TIMEOUT)
        assert self._place is not None
        if ref is None:
            self._is_over = True
        else:
            self._place.cell = ref._cell

    def ready(self, system: ActorSystem) -> str:
        if why := super().ready(system):
            return why
        supervisor = self._supervisor(system)
        if supervisor is not self._asked or supervisor.life != self._life:
            return f"{supervisor.path} has been restarted"
        cell = (supervisor.children or {}).get(self._name)
        return (
            "" if self._is_over or (cell is not None and cell.host.is_up(cell)) else f"{self.target} is being started"
        )

    def commit(self, system: ActorSystem) -> None:
        self._put(system, starts=True)

    async def release(self, system: ActorSystem) -> None:
        supervisor = self._asked
        if supervisor is None or supervisor.is_dead or supervisor.life != self._life:
            return
        cell = (supervisor.children or {}).get(self._name)
        if cell is not None and not cell.host.is_up(cell):
            cell.kill()  # Its start would hold up its supervisor, and us, for as long as it likes.
        await self._stop(supervisor)
