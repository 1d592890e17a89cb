"""Operations on a child by its spec: stop it and keep that, start it again, restart and stop it by other options."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import ActorStopped, NoSuchActor
from ...actors.kernel.cell import Cell
from ...actors.kernel.ref import ActorRef, Target
from ...supervision.admin import ChildBusy, NoSuchChild, NotSupported, RestartChild, TerminateChild
from ...supervision.respec import replace_options
from ...supervision.spec import check_spec
from ...supervision.supervisor import Supervisor
from ..history.recorder import expect_end
from .arrangement import child_of
from .draft import START_TIMEOUT, Draft, DraftPlace, check_awake, is_elsewhere
from .operation import Operation, wrong

if TYPE_CHECKING:
    from ..system import ActorSystem

OPTIONS = ("restart", "shutdown", "backoff", "significant", "start_timeout", "rules", "register")
"""What a supervisor looks up at each restart or stop, so that it can be another at any time."""


class OnChild(Operation):
    """Base: a child of a supervisor of this process, by its name."""

    _name = ""

    def _take(self, draft: Draft, place: DraftPlace, *, starts: bool) -> None:
        above = place.parent
        assert above is not None
        self._found, self._name = place, place.name
        self.target, self.between_turns_of = place.path, (above,)
        if above.is_dynamic or above.is_partitioned:
            raise NotSupported("a child without a place of its own cannot be stopped for a while: remove it")
        if above.cell is None or is_elsewhere(above.cell):
            raise wrong(self.target, "its supervisor lives in another process")
        check_awake(above)
        assert place.spec is not None
        place.spec = dataclasses.replace(place.spec, autostart=starts)
        place.is_stopped, place.is_switched = not starts, True
        draft.arrangement.touch(above, self)


class StopChild(OnChild):
    """Stop a child; its spec stays, and says that it is not started until it is started by order."""

    verb: ClassVar[str] = "stop"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = draft.find(self._at)
        place.check_lived_in(system._node)
        if place.parent is None or not place.parent.is_supervisor or place.spec is None:
            raise wrong(place.path, "no supervisor looks after it")
        if place.is_planned:
            raise wrong(place.path, "it is added by this very transaction")
        if place.spec.restart == "temporary":
            raise wrong(place.path, "its spec is temporary, and would not stay: remove it")
        self._take(draft, place, starts=False)
        stopped = set(place.walk())
        for one in stopped:
            one.names.clear()  # They end with its life.
        for owner in draft.staying():
            bound = next((to for to in owner.bindings.values() if to in stopped), None)
            if bound is not None and owner not in stopped:
                raise wrong(owner.path, f"a binding of it would point at {bound.path}, which is stopped")

    def ready(self, system: ActorSystem) -> str:
        place = self._place
        assert place.was.below is not None
        if child_of(place.was.below.living(system._node), self._name) is None:
            raise NoSuchActor(self.target)
        return ""

    async def finish(self, system: ActorSystem) -> None:
        place = self._place
        assert place.parent is not None
        expect_end(system._history, self.target, "it was stopped")
        await stop_child(place.parent.living(system._node), self._name)


async def stop_child(supervisor: Cell, name: str) -> None:
    """Stop a child whose spec stays."""
    ref: ActorRef[Supervisor] = ActorRef(supervisor)
    await ref.ask(TerminateChild(name), START_TIMEOUT)


class StartAgain(OnChild):
    """Start a child again that was stopped."""

    verb: ClassVar[str] = "start"

    def __init__(self, supervisor: Target, name: str) -> None:
        super().__init__(supervisor, name)
        self._name = name
        self._asked: Cell | None = None  # the supervisor that was asked
        self._is_asked = False
        self._life = 0
        self._is_over = False  # it did not want to be started
        self._is_automatic = False  # it would be started with the others

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        above = await draft.supervisor(self._at)
        place = above.children.get(self._name)
        if place is None or place.spec is None:
            raise NoSuchActor(self.target)
        if not place.is_stopped:
            raise wrong(self.target, "it runs")
        if place.is_switched or (place.cell is not None and not place.cell.is_dead):
            raise wrong(self.target, "it is stopped by this very transaction")
        self._is_automatic = place.spec.autostart
        self._take(draft, place, starts=True)

    def _supervisor(self, system: ActorSystem) -> Cell:
        """Who has it until the transaction is in force: there it is started, and goes from there if it is moved."""
        assert self._place.was.below is not None
        return self._place.was.below.living(system._node)

    async def prepare(self, system: ActorSystem) -> None:
        supervisor = self._supervisor(system)
        if self._is_over or (self._asked is supervisor and self._life == supervisor.coming_life):
            return  # It is being restarted.
        self._asked, self._life = supervisor, supervisor.coming_life
        above: ActorRef[Supervisor] = ActorRef(supervisor)
        is_asked_again, self._is_asked = self._is_asked, True
        try:
            ref = await above.ask(RestartChild(self._name), START_TIMEOUT)
        except ChildBusy:
            if not is_asked_again:
                raise
            return  # A life of its supervisor has ended before it answered; the next one has heard it too.
        if ref is None:
            self._is_over = True
        else:
            self._place.cell = ref._cell

    def ready(self, system: ActorSystem) -> str:
        supervisor = self._supervisor(system)
        if supervisor is not self._asked or supervisor.coming_life != self._life:
            return f"{supervisor.path} has been restarted"
        if child_of(supervisor, self._name) is None:
            raise NoSuchActor(self.target)
        cell = (supervisor.children or {}).get(self._name)
        is_up = self._is_over or (cell is not None and cell.host.is_up(cell))
        return "" if is_up else f"{self.target} is being started"

    async def release(self, system: ActorSystem) -> None:
        supervisor = self._asked
        if supervisor is None or supervisor.is_dead:
            return
        if supervisor.coming_life != self._life and self._is_automatic:
            return  # It was stopped by a message alone: it has come back with its supervisor.
        cell = (supervisor.children or {}).get(self._name)
        if cell is not None and not cell.host.is_up(cell):
            cell.kill()  # Its start would hold up its supervisor, and us, for as long as it likes.
        try:
            await stop_child(supervisor, self._name)
        except (ActorStopped, NoSuchChild):
            pass  # Its supervisor has ended, or somebody has removed it meanwhile.


class Respecify(Operation):
    """Have a supervisor restart and stop one of its children by other options, from now on."""

    verb: ClassVar[str] = "respecify"

    def __init__(self, target: Target, options: dict[str, Any]) -> None:
        super().__init__(target)
        self._options = options

    @property
    def text(self) -> str:
        return f"set {', '.join(f'{name}={value!r}' for name, value in self._options.items())} of {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._found = draft.find(self._at)
        self.target = place.path
        above = place.parent
        unknown = next((name for name in self._options if name not in OPTIONS), None)
        if unknown is not None:
            raise wrong(place.path, f"{unknown} of a child that runs cannot be another: {', '.join(OPTIONS)} can")
        if above is None or place.spec is None:
            raise wrong(place.path, "no supervisor of this process looks after it")
        if place.is_planned or above.cell is None or is_elsewhere(above.cell):
            raise wrong(place.path, "its supervisor lives in another process, or is added by this very transaction")
        place.spec = dataclasses.replace(place.spec, **self._options)
        check_spec(above.path, place.spec, above.flags.auto_shutdown if above.flags is not None else None)

    def ready(self, system: ActorSystem) -> str:
        if self._place.cell is None:
            raise NoSuchActor(self.target)
        return ""

    def commit(self, system: ActorSystem) -> None:
        cell = self._place.now(system._node) or self._place.cell
        assert cell is not None
        replace_options(cell, self._options)
