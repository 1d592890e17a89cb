"""Operations on whether a child runs: stop one whose spec stays, start it again."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import NoSuchActor
from ...actors.kernel.cell import Cell
from ...actors.kernel.ref import ActorRef
from ...supervision.admin import NotSupported, RestartChild, TerminateChild
from ...supervision.supervisor import Supervisor
from .draft import Draft, Place, Target, check_awake, is_elsewhere
from .operation import Operation, wrong
from .structure import START_TIMEOUT, text_of

if TYPE_CHECKING:
    from ..system import ActorSystem


class OnChild(Operation):
    """Base: a child of a supervisor of this process, by its name."""

    def __init__(self, target: str) -> None:
        super().__init__(target)
        self._above: Place | None = None
        self._name = ""
        self._done = False

    def _take(self, above: Place, name: str) -> None:
        self._above, self._name = above, name
        self.target, self.between_turns_of = f"{above.path}/{name}", (above,)
        if above.is_dynamic or above.is_partitioned:
            raise NotSupported("a child without a place of its own cannot be stopped for a while: remove it")
        if above.cell is None or is_elsewhere(above.cell):
            raise wrong(self.target, "its supervisor lives in another process")
        check_awake(above)

    def _supervisor(self, system: ActorSystem) -> Cell:
        assert self._above is not None
        return self._above.living(system.node)

    async def _start(self, system: ActorSystem) -> None:
        above: ActorRef[Supervisor] = ActorRef(self._supervisor(system))
        await above.ask(RestartChild(self._name), START_TIMEOUT)

    async def _stop(self, system: ActorSystem) -> None:
        above: ActorRef[Supervisor] = ActorRef(self._supervisor(system))
        await above.ask(TerminateChild(self._name), START_TIMEOUT)


class StopChild(OnChild):
    """Stop a child; its spec stays. Undone, it is started again: from what was recorded of it, or afresh."""

    verb: ClassVar[str] = "stop"

    def __init__(self, target: Target) -> None:
        super().__init__(text_of(target))
        self._at = target

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        place.check_lived_in(system.node)
        if place.parent is None or not place.parent.is_supervisor or place.spec is None:
            raise wrong(place.path, "no supervisor looks after it")
        if place.spec.restart == "temporary":
            raise wrong(place.path, "its spec is temporary, and would not stay: remove it")
        self._take(place.parent, place.name)
        stopped = set(place.walk())
        for owner in draft.staying():
            bound = next((to for to in owner.bindings.values() if to in stopped), None)
            if bound is not None and owner not in stopped:
                raise wrong(owner.path, f"a binding of it would point at {bound.path}, which is stopped")

    async def do(self, system: ActorSystem) -> None:
        self._done = True
        await self._stop(system)

    async def undo(self, system: ActorSystem) -> None:
        cell = (self._supervisor(system).children or {}).get(self._name)
        if self._done and (cell is None or not cell.host.is_up(cell)):
            await self._start(system)


class StartAgain(OnChild):
    """Start a child again that was stopped."""

    verb: ClassVar[str] = "start"

    def __init__(self, supervisor: Target, name: str) -> None:
        super().__init__(f"{text_of(supervisor)}/{name}")
        self._at, self._name = supervisor, name

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        above = await draft.supervisor(self._at)
        self._take(above, self._name)
        place = above.children.get(self._name)
        if place is None or place.spec is None:
            raise NoSuchActor(self.target)
        if place.cell is not None and not place.cell.is_dead:
            raise wrong(self.target, "it runs")

    async def do(self, system: ActorSystem) -> None:
        self._done = True
        await self._start(system)

    async def undo(self, system: ActorSystem) -> None:
        if self._done:
            await self._stop(system)
