"""Attach and detach below a supervisor that has a process of its own, of recorded actors: their homes are here already.

A life in that process comes to rest with a last snapshot, and a group takes it up; or a group comes to rest, and a life
begins in the process again. The supervisor there has the child running all the while. If the new life does not come so
far, the old one goes on; if the process dies meanwhile, the next life begins as the specs say then.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import CannotMove, StartFailed
from ...actors.exit_reasons import unpack_exit
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.migration.quiesce import Transit, now
from ...actors.process.wire.start_codec import pack_recipe
from ...checkpoint.home.recorded_hosts import RemoteLife
from ...checkpoint.home.recorded_moves import Detached, refuse_unsaved
from ...checkpoint.protocol import Closed, Live, Protected, ToHome
from ...supervision.respec import recipe_spec
from ..model.mechanism import compose
from .attach import ToGroup
from .detach import ToRecordedTask
from .subtree_groups import SubtreeGroup

if TYPE_CHECKING:
    from ...actors.process.worker_pool import Worker
    from ...checkpoint.home.subtree_homes import SubtreeHome


def worker_of(place: SubtreeHome, cell: Cell) -> Worker:
    """The process of the supervisor. Raises CannotMove: it has just died."""
    if place.worker is None:
        raise CannotMove(cell.path, "the process of its supervisor has ended; try again")
    return place.worker


class OutOfSubtree(ToGroup):
    """A recorded life goes from the process of its supervisor to a group at the root."""

    def __init__(self, cell: Cell, place: SubtreeHome, mechanism: Any, timeout: float) -> None:
        spec = recipe_spec(cell)
        if spec is None:
            raise CannotMove(cell.path, "no recipe at the root has its spec")
        host = SubtreeGroup(place, place.method, compose(mechanism))
        host.prepare(pack_recipe(spec.start, cell.path), list(spec.start.kind._topics))
        super().__init__(cell, host, timeout)
        self._new_host = host
        self._place, self._spec, self._worker = place, spec, worker_of(place, cell)
        self._switch = place.switch
        self._taken: asyncio.Future[None] = self.node.loop.create_future()

    @property
    def is_recorded(self) -> bool:
        return True

    async def prepare(self) -> None:
        for port, path in self._spec.bindings.items():
            self.cell.extra().bindings.setdefault(port, self.node.cell_at(path))
        await super().prepare()

    async def take(self) -> None:
        self.hear(self._worker)
        self._say("take")
        await self.within(
            self._taken, self.timeout, lambda: "it did not come to rest: a turn or background work goes on"
        )

    def _say(self, step: str, **told: Any) -> None:
        self.say(self._worker, step, **told)
        self._worker.connection.flush()

    def heard(self, step: str, told: dict[str, Any]) -> None:
        if step == "refused":
            self.give_up(str(told["why"]))
        elif step == "taken" and not self.given_up.done():
            assert self._switch is not None
            more = self.cell.extra()
            self.rest_at = float(told["at"])
            more.trap_exits, more.suspended = bool(told["trap_exits"]), bool(told["suspended"])
            self._home = Detached(self._switch)
            self.at_rest()
            self._taken.set_result(None)

    def _switch_over(self, live: Live) -> None:
        """From here on the group is the one."""
        cell, host, group, switch, more = self.cell, self._new_host, self._group, self._switch, self.cell.extra()
        assert self.transit is not None
        assert group is not None
        assert switch is not None
        if cell.state is not RUNNING:
            self.is_late = True
            raise CannotMove(cell.path, "its life has ended")
        self.is_done = True
        wanted = self._place.hand_over(host)
        protected = Protected(b"", [], {})  # What it is made of is known.
        host.found(msgspec.structs.replace(wanted, protected=protected), RemoteLife(cell.path, self._worker))
        self._say("leave", number=wanted.number, layers=host.described())
        host.take_over(cell, group)
        more.trap_exits = False  # Its replicas know.
        self.transit.over(cell, host)
        cell.extra().start = self._spec.start
        group.is_suspended = more.suspended
        host.attached(cell, group)
        switch.from_life(live)  # What waits is fed.
        group.go_on()
        self.gone_on_at = now()
        self.moved()

    def undo(self) -> None:
        cell = self.cell
        cell.extra().trap_exits = False
        if self.is_late:
            self.ending = asyncio.ensure_future(self.host.dismantle(cell))
            settle_in(cell, self.transit)
            return
        self._say("back")
        super().undo()
        cell.scheduled = True  # Nothing of it runs here.


class IntoSubtree(ToRecordedTask):
    """A recorded life goes from a group to the process of its supervisor."""

    host: Any  # The place where that one is heard

    def __init__(self, cell: Cell, timeout: float) -> None:
        old = cell.host
        assert isinstance(old, SubtreeGroup)
        super().__init__(cell, old.place, timeout)
        self._group_host, self._place, self._worker = old, old.place, worker_of(old.place, cell)
        if not self._place.slot:
            raise CannotMove(cell.path, "its process holds as many recorded actors as it can")
        self._port = RemoteLife(cell.path, self._worker)
        self._up: asyncio.Future[None] = self.node.loop.create_future()

    def _say(self, step: str, **told: Any) -> None:
        self.say(self._worker, step, **told)
        self._worker.connection.flush()

    async def carry(self) -> None:
        cell, place = self.cell, self._place
        refuse_unsaved(cell, self._switch)
        place.method = self._group_host.method
        switch, live, _ = place.open(cell)
        place.arriving = self._said
        for record in switch.restore_records():
            self._port.to_life(record)
        number, suspended = self._group_host.number, self._group.is_suspended
        told = {"number": number, "turn": switch.state_turn, "stash": switch.stash, "slot": place.slot}
        self._say("come", is_suspended=suspended, **told)
        switch.attach(self._port)
        live.add_done_callback(lambda done: None if done.cancelled() else self._fail(done.exception()))
        await self.within(self._up, self.timeout, lambda: "its new life was not up")

    def _fail(self, error: BaseException | None) -> None:
        if error is not None and not self._up.done():
            self._up.set_exception(StartFailed(self.cell.path, str(error)))
            self._up.exception()

    def _said(self, record: ToHome) -> None:
        """From the life that begins in the process."""
        if isinstance(record, Closed):
            self._fail(StartFailed(self.cell.path, str(unpack_exit(record.reason))))
        elif not isinstance(record, Live):
            self._switch.from_life(record)
        elif not self.given_up.done() and not self._up.done():
            self._return(record)

    def _return(self, live: Live) -> None:
        """From here on the life in the process is the one."""
        cell, place = self.cell, self._place
        assert self.transit is not None
        self.is_done = True
        place.arriving = None
        wanted = msgspec.structs.replace(self._group_host.hand_over(), protected=None)
        self._say("settle")
        self.transit.over(cell, place)
        for port, target in cell.extra().bindings.items():
            place.told(cell, "bind", {"port": port, "target": target.path})
        self.dismantled()
        self._switch.from_life(live)  # What waits is fed.
        self.gone_on_at = now()
        self.moved()
        place.take_back(cell, wanted)
        self._up.set_result(None)

    def undo(self) -> None:
        self._place.arriving = None
        if self.is_late:
            settle_in(self.cell, self.transit)
            return
        if self.transit is not None:
            self._say("stay")
        super().undo()


def settle_in(cell: Cell, transit: Transit | None) -> None:
    """The life that was on its way has ended: the next one, if it has begun already, has its own place."""
    if transit is not None:
        transit.over(cell, transit.old if cell.host is transit else cell.host)
