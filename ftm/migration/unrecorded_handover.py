"""Attach and detach below a supervisor that has a process of its own, of actors without recovery: they have no home.

A home is made when a group is to live the life, and forgotten when the life is lived in the process again. What is in
the mailbox there goes along as the last that leaves, so nobody's messages overtake each other. If the process dies
meanwhile, the child begins afresh with the subtree.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any, cast

from ...actors.errors import CannotMove, HoldfastError, StartFailed, error_text
from ...actors.exit_reasons import ExitReason, unpack_exit
from ...actors.kernel.cell import GONE, RUNNING, Cell, Host
from ...actors.kernel.envelope import Item
from ...actors.kernel.mailbox import Bound, Bounded
from ...actors.kernel.message import message_name
from ...actors.migration.quiesce import now
from ...actors.overflow import Overflow
from ...actors.process.wire import frames
from ...actors.process.wire.peer import OutsideHost
from ...actors.process.wire.start_codec import pack_recipe
from ...actors.process.worker_pool import Worker
from ...checkpoint.home.capacity import HomeBound
from ...checkpoint.home.held_messages import inlet
from ...checkpoint.home.recorded_hosts import RemoteLife
from ...checkpoint.home.subtree_homes import SubtreeHome, SubtreeHost
from ...checkpoint.home.switch import Switch
from ...checkpoint.protocol import DOWN, EXIT, Closed, Live, Protected, ToHome, Wanted
from ...supervision.respec import recipe_spec
from ..group.transient_homes import UNKEPT
from ..model.mechanism import compose
from .attach import ToGroup
from .detach import ToPlainTask
from .recorded_handover import settle_in, worker_of
from .subtree_groups import SubtreeGroup
from .unrecorded_luggage import pack_ask, refuse, unpack

if TYPE_CHECKING:
    from ...actors.kernel.cell import Admit


NUMBER = 0
"""Under which the supervisor there wants a life that it has not asked for: it counts its own from 1."""


def place_of(cell: Cell, host: OutsideHost) -> SubtreeHome:
    """Where the supervisor of such a child is heard.

    Raises:
        CannotMove: it is no child of one that has a process of its own.
    """
    worker = host.peer
    top = worker.cell if isinstance(worker, Worker) else None
    if not isinstance(worker, Worker) or top is None or not isinstance(top.host, SubtreeHost):
        raise CannotMove(cell.path, "only a child of a supervisor can be given a mechanism")
    worker.record_taker(cell.path)  # From now on it is heard.
    return top.host.at(cell.path)


class OutOfProcess(ToGroup):
    """From the process of its supervisor to a group at the root."""

    def __init__(self, cell: Cell, old: OutsideHost, mechanism: Any, timeout: float) -> None:
        spec = recipe_spec(cell)
        if spec is None:
            raise CannotMove(cell.path, "no recipe at the root has its spec")
        place = place_of(cell, old)
        host = SubtreeGroup(place, UNKEPT, compose(mechanism))
        host.prepare(pack_recipe(spec.start, cell.path), list(spec.start.kind._topics))
        super().__init__(cell, host, timeout)
        self._new_host, self._place, self._spec, self._worker = host, place, spec, worker_of(place, cell)
        self._port = RemoteLife(cell.path, self._worker)
        self._admit: Admit = cell.admit
        self._held: list[Any] = []  # what has been sent to it here meanwhile
        self._taken: asyncio.Future[None] = self.node.loop.create_future()
        self._left: asyncio.Future[None] = self.node.loop.create_future()
        self._is_leaving = False  # there is no way back
        self._state: Live | None = None

    async def prepare(self) -> None:
        self.cell.table = self._spec.start.kind._table
        for port, path in self._spec.bindings.items():
            self.cell.extra().bindings.setdefault(port, self.node.cell_at(path))
        await super().prepare()

    async def take(self) -> None:
        self._place.arriving, self._place.on_lost = lambda record: None, self._lost
        self.hear(self._worker)
        self._say("take")
        await self.within(
            self._taken, self.timeout, lambda: "it did not come to rest: a turn or background work goes on"
        )

    def _say(self, step: str, **told: Any) -> None:
        self.say(self._worker, step, **told)
        self._worker.connection.flush()

    def heard(self, step: str, told: dict[str, Any]) -> None:
        match step:
            case "refused":
                self.give_up(str(told["why"]))
            case "taken" if not self.given_up.done():
                try:
                    self._has_come_to_rest(told)
                except Exception as error:  # What a message of its own raises when it is read.
                    self.give_up(error_text(error))
            case "left" if self._is_leaving and not self._left.done():
                self._move_over(told)
            case _:
                pass

    def _has_come_to_rest(self, told: dict[str, Any]) -> None:
        cell, switch = self.cell, self._switch
        assert switch is not None
        self.rest_at, self._rest = float(told["at"]), told["rest"]
        more = cell.extra()
        more.trap_exits = bool(self._rest["trap_exits"])  # The replicas will know.
        more.stash = deque(unpack(self._worker, cell, told["stash"]))
        self._plant(switch, told["state"])
        more.stash = None
        cell.admit = self._hold
        self.at_rest()
        self._taken.set_result(None)

    def _hold(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: what waits in the process is ahead of it."""
        if not isinstance(item, Item) and type(item) not in cell.table:
            cell.require(item)
        self._held.append(item)

    async def carry(self) -> None:
        await super().carry()
        await asyncio.shield(self._left)

    def _switch_over(self, live: Live) -> None:
        """The group is ready: have the life leave."""
        if self.cell.state is not RUNNING:
            self.is_late = True
            raise CannotMove(self.cell.path, "its life has ended")
        self._state, self._is_leaving = live, True
        self._say("leave", number=NUMBER, layers=self._new_host.described())

    def _move_over(self, told: dict[str, Any]) -> None:
        """From here on the group is the one."""
        cell, host, group, switch, more = self.cell, self._new_host, self._group, self._switch, self.cell.extra()
        assert self.transit is not None
        assert group is not None
        assert switch is not None
        assert self._state is not None
        self.is_done = True
        self._quit()
        if told["bound"] is not None:
            capacity, overflow = told["bound"]
            more.bound = Bound(capacity, cast("Overflow", overflow))
        chosen = None if more.bound is None else Bounded(more.bound.capacity, more.bound.overflow)
        self._move_in(switch, unpack(self._worker, cell, told["queue"]), list(more.topics), None)
        self._let_go(self._held)
        kind = self._spec.start.kind
        protected = Protected(b"", [], {})  # What it is made of is known.
        host.found(Wanted(NUMBER, message_name(kind), list(kind._topics), UNKEPT, chosen, protected), self._port)
        self._place.found(cell, host)
        host.take_over(cell, group)
        more.trap_exits = False
        self.transit.over(cell, host)
        more.start = self._spec.start
        group.is_suspended = more.suspended = bool(self._rest["suspended"])
        host.attached(cell, group)
        switch.from_life(self._state)  # What waits is fed.
        group.go_on()
        self.gone_on_at = now()
        self.moved()
        self._left.set_result(None)
        if group.is_over:  # No replica is left meanwhile.
            group.on_over(group.why)

    def _let_go(self, held: list[Any]) -> None:
        """What has waited here goes where the actor lives."""
        cell = self.cell
        self._held = []
        for item in held:
            try:
                cell.admit(cell, item)
            except HoldfastError as error:
                refuse(cell, item, error)

    def _quit(self) -> None:
        self._place.arriving = self._place.on_lost = None

    def _lost(self, reason: ExitReason) -> None:
        """The process has died: so has the child."""
        cell, transit, held = self.cell, self.transit, self._held
        self._quit()
        if transit is not None:
            transit.over(cell, self._worker.inner.lived_there(cell))
        self._worker.inner.gone(cell.path, reason)
        self.is_late = True
        self.give_up(f"its process has died ({reason})")
        if not self._left.done():
            self._left.set_exception(CannotMove(cell.path, f"its process has died ({reason})"))
            self._left.exception()
        self._let_go(held)

    def undo(self) -> None:
        cell, transit = self.cell, self.transit
        cell.extra().trap_exits = False
        if cell.state is GONE or self._is_leaving:
            self._quit()
            self.ending = asyncio.ensure_future(self.host.dismantle(cell))
            return
        self._quit()
        if transit is not None:
            cell.admit = self._admit
            self._let_go(self._held)
        self._say("back")
        super().undo()
        cell.scheduled = True  # Nothing of it runs here.


class IntoProcess(ToPlainTask):
    """From a group to the process of its supervisor."""

    host: Any  # The place where that one is heard

    def __init__(self, cell: Cell, timeout: float) -> None:
        old = cell.host
        assert isinstance(old, SubtreeGroup)
        super().__init__(cell, old.place, timeout)
        self._group_host, self._place, self._worker = old, old.place, worker_of(old.place, cell)
        self._up: asyncio.Future[None] = self.node.loop.create_future()

    def _say(self, step: str, **told: Any) -> None:
        self.say(self._worker, step, **told)
        self._worker.connection.flush()

    async def carry(self) -> None:
        self._place.arriving = self._said
        self.hear(self._worker)
        self._say("come", state=self._data, traps=self._traps)
        await self.within(self._up, self.timeout, lambda: "its new life was not up")

    def _said(self, record: ToHome) -> None:
        if isinstance(record, Closed):
            self._fail(str(unpack_exit(record.reason)))

    def heard(self, step: str, told: dict[str, Any]) -> None:
        if self._up.done() or self.given_up.done():
            return
        if step == "failed":
            self._fail(str(told["why"]))
        elif step == "up":
            self._return()

    def _fail(self, why: str) -> None:
        if not self._up.done():
            self._up.set_exception(StartFailed(self.cell.path, why))
            self._up.exception()

    def _return(self) -> None:
        """From here on the life in the process is the one."""
        cell, more, switch, place, worker = self.cell, self.cell.extra(), self._switch, self._place, self._worker
        assert self.transit is not None
        self.is_done = True
        place.arriving = None
        topics = dict.fromkeys([*self._group_host.topics(cell), *switch.topics])
        for topic in topics:
            self.node.topics.unsubscribe(topic, inlet(switch, topic))
            self.node.topics.subscribe(topic, cell)
        stash, queue = self._packed(switch)
        told = {
            "stash": stash,
            "queue": queue,
            "timers": [list(timer) for timer in switch.timers.saved().values()],
            "is_suspended": self._group.is_suspended,
            "links": [peer.path for peer in more.links],
            "monitors": [[watch.watcher.path, watch.for_good] for watch in more.monitors],
            "watches": [[watch.target.path, watch.for_good] for watch in more.watching],
            "topics": list(topics),
        }
        for watch in list(more.watching):
            watch.cancel()  # It begins to watch again, there.
        self._say("settle", **told)
        homed, switch.bound = switch.bound, None
        switch.open.clear()
        switch.timers.replace({})
        self._group_host.homes.released(cell.path)
        self._group_host.hand_over()
        place.forget()
        more.outlet, more.suspended = None, False
        host: Host = worker.inner.lived_there(cell)
        self.transit.over(cell, host)
        for port, target in more.bindings.items():
            data = {"port": port, "target": target.path}
            worker.connection.send(frames.Command(worker.connection.name_out(cell.path), "bind", data))
        if isinstance(homed, HomeBound):
            homed.senders.release()
        self.dismantled()
        self.gone_on_at = now()
        self.moved()
        cell.spec = None  # Its supervisor is not here.
        self._up.set_result(None)

    def _packed(self, switch: Switch) -> tuple[list[Any], list[Any]]:
        """What waits at the home: what the actor has put aside, and the rest, in order."""
        stash: list[Any] = []
        queue: list[Any] = []
        for source in switch.open.values():
            if source.kind in (EXIT, DOWN):
                data = self.node.codec.decode(dict[str, Any], source.body)
                more = [] if source.kind == EXIT else [bool(data["recovering"]), data["verb"] == "watch"]
                queue.append([source.kind, data["source"], data["reason"], *more])
                continue
            if source.ask is not None:
                one = pack_ask(self._worker, source.ask, source.name, source.body)
            else:
                one = ["message", source.name, source.body, source.sender]
            (stash if source.id in self._stash else queue).append(one)
        for ask, name, body, _ in getattr(switch.bound, "waiting", ()):
            queue.append(pack_ask(self._worker, ask, name, body))
        return stash, queue

    def undo(self) -> None:
        self._place.arriving = None
        self._say("stay")
        if self.is_late:
            settle_in(self.cell, self.transit)
            return
        super().undo()
