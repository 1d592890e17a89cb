"""The side of a migration that is the process of the actor's supervisor, as the root sees it.

The supervisor there has the child running all the while. The home of a recorded child is here already. One without
recovery has a home only while a group lives it: what is in the mailbox there goes along as the last that leaves, so
nobody's messages overtake each other. If the process dies meanwhile, the child begins afresh with the subtree.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any, cast

from ...actors.control.orders_lane import take_orders
from ...actors.errors import CannotMove, HoldfastError, StartFailed, error_text
from ...actors.exit_reasons import ExitReason, pack_exit, unpack_exit
from ...actors.kernel import links
from ...actors.kernel.bindings import settle_claims, unclaimed
from ...actors.kernel.cell import GONE, Cell
from ...actors.kernel.envelope import Item
from ...actors.kernel.mailbox import Bound, Bounded
from ...actors.kernel.message import message_name
from ...actors.migration.luggage import let_come
from ...actors.migration.move import Entering, Leaving, Move
from ...actors.migration.quiesce import now
from ...actors.migration.words import moment
from ...actors.migration.worker import BUSY, ToWorker
from ...actors.overflow import Overflow
from ...actors.process.resource_limits import limits_data
from ...actors.process.wire import frames
from ...actors.process.wire.peer import OutsideHost
from ...actors.process.wire.start_codec import pack_recipe
from ...actors.process.worker_pool import Worker
from ...checkpoint.home.held_messages import inlet
from ...checkpoint.home.journal_home import JournalHome
from ...checkpoint.home.life_ports import RemoteLife
from ...checkpoint.method import Method
from ...checkpoint.places.far_parent import FarParent
from ...checkpoint.places.recorded_moves import Beginning, Detached, ToRecordedWorker, leaving, refuse_unsaved
from ...checkpoint.places.subtree_place import SubtreePlace
from ...checkpoint.protocol import AtRoot, Closed, ToHome, Wanted
from ...supervision.respec import recipe_spec
from ..group.group_place import GroupPlace, protected_host
from ..group.transient_homes import UNKEPT
from .group_moves import settle_in
from .subtree_groups import process_below
from .unrecorded_luggage import pack, pack_owed, unpack, unpack_owed

if TYPE_CHECKING:
    from ...actors.kernel.address_host import AddressHost
    from ...actors.kernel.cell import Admit
    from ...checkpoint.home.switch import Switch
    from ...supervision.spec import ChildSpec

NUMBER = 0
"""Under which the supervisor there wants a life that it has not asked for: it counts its own from 1."""


def spec_of(cell: Cell) -> ChildSpec:
    """What the root knows of how the child begins. Raises CannotMove: nothing."""
    spec = recipe_spec(cell)
    if spec is None:
        raise CannotMove(cell.path, "no recipe at the root has its spec")
    settle_claims(cell, spec.bindings)
    return spec


def worker_of(parent: FarParent, cell: Cell) -> Worker:
    """The process of the supervisor. Raises CannotMove: it has just died."""
    if parent.worker is None:
        raise CannotMove(cell.path, "the process of its supervisor has ended; try again")
    return parent.worker


def parent_of(cell: Cell, host: OutsideHost) -> FarParent:
    """Where the supervisor of such a child is heard.

    Raises:
        CannotMove: it is no child of one that has a process of its own.
    """
    worker = host.peer
    top = worker.cell if isinstance(worker, Worker) else None
    if not isinstance(worker, Worker) or top is None or not isinstance(top.host.place, SubtreePlace):
        raise CannotMove(cell.path, "only a child of a supervisor can be given a mechanism")
    worker.record_taker(cell.path)  # From now on it is heard.
    return top.host.place.at(cell.path)


def group_for(parent: FarParent, spec: ChildSpec, method: Method, mechanism: Any) -> AddressHost:
    """The host of a life that is to be lived by a group."""
    host = protected_host(parent.homes, method, mechanism, parent)
    topics = list(spec.start.kind._topics)
    parent.prepare(AtRoot(pack_recipe(spec.start, parent.path), layers_of(host)), topics)
    return host


def layers_of(host: AddressHost) -> list[Any]:
    """The mechanisms that a life at the root has, as data."""
    return host.place.described() if isinstance(host.place, GroupPlace) else []


def spec_data(host: AddressHost, spec: ChildSpec) -> dict[str, Any]:
    """What the supervisor has to know of a child that is lived elsewhere from now on, as data."""
    return {"layers": layers_of(host), "isolation": spec.isolation, "limits": limits_data(spec.limits)}


def move_below(cell: Cell, spec: ChildSpec, timeout: float) -> Move:
    """The move of a child between the process of its supervisor and one of its own, to where its spec says.

    Raises:
        CannotMove: it cannot.
    """
    old, home, parent = cell.host, cell.host.home, cell.host.parent
    if isinstance(old, OutsideHost):
        parent = parent_of(cell, old)
        settle_claims(cell, spec.bindings)
        host = to_process_below(parent, spec, UNKEPT)
        return Move(cell, FromSubtree(cell, parent, spec, host), ToWorker(host, spec.limits), timeout)
    assert isinstance(parent, FarParent)
    is_recorded = isinstance(home, JournalHome)
    if spec.isolation == "task":
        to_subtree = ToRecordedSubtree if is_recorded else ToSubtree
        return Move(cell, leaving(cell), to_subtree(cell, parent), timeout)
    assert isinstance(home, JournalHome)
    host = to_process_below(parent, spec, home.method)
    return Move(cell, FromRecordedSubtree(cell, parent, spec, host), ToRecordedWorker(host, spec.limits), timeout)


def to_process_below(parent: FarParent, spec: ChildSpec, method: Method) -> AddressHost:
    """The host of such a child whose life is to enter a process of its own."""
    made = AtRoot(pack_recipe(spec.start, parent.path), [], limits_data(spec.limits))
    topics = list(spec.start.kind._topics)
    parent.prepare(made, topics)
    kind, back = message_name(spec.start.kind), spec.comes_back
    wanted = Wanted(parent.number, kind, topics, method, None, made, comes_back=back)
    return process_below(parent, wanted, None)


class FromRecordedSubtree(Leaving):
    """A recorded life leaves the process of its supervisor, for one of its own or a group."""

    def __init__(self, cell: Cell, parent: FarParent, spec: ChildSpec, host: AddressHost) -> None:
        self._parent, self._spec, self._host = parent, spec, host
        self._worker = worker_of(parent, cell)
        self._home: Detached | None = None

    async def quiesce(self) -> None:
        move = self.move
        self._taken: asyncio.Future[None] = move.node.loop.create_future()
        move.hear(self._worker, self._heard)
        move.say_now(self._worker, "take")
        await move.within(self._taken, move.timeout, lambda: BUSY)
        refuse_unsaved(self.cell, self._parent.home.switch)

    def _heard(self, step: str, told: dict[str, Any]) -> None:
        move = self.move
        if step == "refused":
            move.give_up(str(told["why"]))
        elif step == "taken" and not move.given_up.done():
            assert self._parent.home.switch is not None
            move.rest_at = moment(told)
            move.luggage.suspended, move.luggage.traps = bool(told["suspended"]), bool(told["trap_exits"])
            self._home = Detached(self._parent.home.switch)
            move.at_rest()
            self._taken.set_result(None)

    def part(self) -> list[Item]:
        cell, parent = self.cell, self._parent
        assert parent.wanted is not None
        parent.comes_to_root(cell, parent.wanted)
        spec, reason = spec_data(self._host, self._spec), pack_exit(self.move.reason())
        self.move.say_now(self._worker, "leave", number=parent.number, spec=spec, reason=reason)
        cell.extra().start = self._spec.start
        return [*take_orders(self._worker, cell)]

    def resume(self) -> None:
        cell, move = self.cell, self.move
        if move.is_late:
            settle_in(self)
            return
        move.say_now(self._worker, "back")
        if move.transit is not None:
            assert self._home is not None
            self._home.attach_again(move.transit)
            move.transit.over(cell, move.transit.old)
        cell.scheduled = True  # Nothing of it runs here.


class FromSubtree(Leaving):
    """A life without recovery leaves the process of its supervisor, for one of its own or a group."""

    def __init__(self, cell: Cell, parent: FarParent, spec: ChildSpec, host: AddressHost) -> None:
        self._parent, self._spec, self._host = parent, spec, host
        self._is_for_home = isinstance(host.home, JournalHome)  # as long as a group lives it
        self._worker = worker_of(parent, cell)
        self._admit: Admit = cell.admit
        self._held: list[Any] = []  # what has been sent to it here meanwhile
        self._bound: Bounded | None = None
        self._told: dict[str, Any] = {}
        cell.table = spec.start.kind._table

    async def quiesce(self) -> None:
        move, parent = self.move, self._parent
        self._taken: asyncio.Future[None] = move.node.loop.create_future()
        self._left: asyncio.Future[None] = move.node.loop.create_future()
        parent.arriving, parent.on_lost = lambda record: None, self._lost
        move.hear(self._worker, self._heard)
        move.say_now(self._worker, "take", for_home=self._is_for_home)
        await move.within(self._taken, move.timeout, lambda: BUSY)

    def _heard(self, step: str, told: dict[str, Any]) -> None:
        move = self.move
        match step:
            case "refused":
                move.is_late = bool(told.get("has_ended"))
                move.give_up(str(told["why"]))
            case "taken" if not move.given_up.done():
                try:
                    self._has_come_to_rest(told)
                except Exception as error:  # What a message of its own raises when it is read.
                    move.give_up(error_text(error))
            case "left" if move.is_bound and not self._left.done():
                self._told = told
                try:
                    move.commit()
                except HoldfastError as error:
                    self._left.set_exception(error)
                else:
                    self._left.set_result(None)
            case _:
                pass

    def _has_come_to_rest(self, told: dict[str, Any]) -> None:
        cell, move, luggage = self.cell, self.move, self.move.luggage
        move.rest_at, luggage.rest, luggage.data = moment(told), told["rest"], told["state"]
        luggage.state = luggage.data
        luggage.suspended, luggage.traps = bool(luggage.rest["suspended"]), bool(luggage.rest["trap_exits"])
        luggage.stash = unpack(self._worker, cell, told["stash"])
        luggage.owed = unpack_owed(self._worker, cell, told["owed"])
        if told["bound"] is not None:
            capacity, overflow = told["bound"]
            self._bound = Bounded(capacity, cast("Overflow", overflow))
        if not self._is_for_home and self._bound is not None:
            luggage.bound = Bound(self._bound.capacity, self._bound.overflow)
        cell.admit = self._hold
        move.at_rest()
        self._taken.set_result(None)

    def _hold(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: what waits in the process is ahead of it."""
        if not isinstance(item, Item) and type(item) not in cell.table:
            cell.require(item)
        self._held.append(item)

    async def let_go(self) -> None:
        self.move.is_bound = True
        spec, reason = spec_data(self._host, self._spec), pack_exit(self.move.reason())
        self.move.say_now(self._worker, "leave", number=NUMBER, spec=spec, reason=reason)
        await asyncio.shield(self._left)

    def part(self) -> list[Item]:
        cell, luggage, more, told = self.cell, self.move.luggage, self.cell.extra(), self._told
        self._quit()
        chosen = self._bound
        if chosen is not None:
            more.bound = Bound(chosen.capacity, chosen.overflow)
        luggage.queue = unpack(self._worker, cell, told["queue"])
        luggage.owed.update(unpack_owed(self._worker, cell, told["owed"]))
        luggage.waiting, self._held = [*unpack(self._worker, cell, told["waiting"]), *self._held], []
        self._keep_watches([(str(path), bool(for_good)) for path, for_good in told["watches"]])
        kind = self._spec.start.kind
        topics, back = list(kind._topics), self._spec.comes_back
        wanted = Wanted(NUMBER, message_name(kind), topics, UNKEPT, chosen, comes_back=back)
        self._parent.comes_to_root(cell, wanted)
        more.start = self._spec.start
        return [*take_orders(self._worker, cell)]

    def _keep_watches(self, told: list[tuple[str, bool]]) -> None:
        """What it watches in the process that it leaves is known here from now on; all else that it watches is."""
        cell, top = self.cell, self._worker.cell
        assert top is not None
        for watch in [one for one in cell.extra().ties.watching if one.target.path.startswith(f"{top.path}/")]:
            if (watch.target.path, watch.for_good) in told:
                told.remove((watch.target.path, watch.for_good))
            else:
                links.drop_watch(watch)  # It was kept when it came to that process.
        for path, for_good in told:
            links.note_watch(links.LifeMonitor(cell, cell.node.cell_at(path), for_good))

    def _let_go(self, held: list[Any]) -> None:
        """What has waited here goes where the actor lives."""
        self._held = []
        let_come(self.cell, held)

    def _quit(self) -> None:
        self._parent.arriving = self._parent.on_lost = None

    def _lost(self, reason: ExitReason) -> None:
        """The process has died: so has the child."""
        cell, move, held = self.cell, self.move, self._held
        self._quit()
        if move.transit is not None:
            move.transit.over(cell, self._worker.inner.lived_there(cell))
        self._worker.inner.gone(cell.path, reason)
        move.is_late = True
        why = f"its process has died ({reason})"
        move.give_up(why)
        if not self._left.done():
            self._left.set_exception(CannotMove(cell.path, why))
            self._left.exception()
        self._let_go(held)

    def resume(self) -> None:
        cell, move = self.cell, self.move
        self._quit()
        if cell.state is GONE or move.is_bound:
            return
        if move.transit is not None:
            cell.admit = self._admit
            self._let_go(self._held)
        move.say_now(self._worker, "back")
        if move.transit is not None:
            move.transit.over(cell, move.transit.old)
        cell.scheduled = True  # Nothing of it runs here.


class IntoSubtree(Entering):
    """A life enters the process of its supervisor: what both kinds have in common."""

    to = "to the process of its supervisor"

    def __init__(self, cell: Cell, parent: FarParent) -> None:
        self.parent, self._from = parent, cell.host.home
        self.worker = worker_of(parent, cell)

    async def prepare(self) -> None:
        """Wait until the supervisor knows of the life that is to come: it would not heed what is said of it."""
        starting = self.parent.starting
        if starting is not None:
            await self.move.within(asyncio.wait((starting,)), self.move.timeout, lambda: "its start was not over")

    def discard(self) -> None:
        self.parent.arriving = None
        if self.move.transit is not None:
            self.move.say_now(self.worker, "stay")


class ToRecordedSubtree(IntoSubtree):
    """A recorded life enters it."""

    def __init__(self, cell: Cell, parent: FarParent) -> None:
        super().__init__(cell, parent)
        self.host = parent.below
        if not parent.slot:
            raise CannotMove(cell.path, "its process holds as many recorded actors as it can")

    async def begin(self) -> None:
        cell, move, parent = self.cell, self.move, self.parent
        assert isinstance(self._from, JournalHome)
        parent.home.method = self._from.method
        switch, live, _ = parent.home.open(cell)
        beginning = self._beginning = Beginning(move, switch)
        parent.arriving = self._said
        port = RemoteLife(cell.path, self.worker)
        for record in switch.restore_records():
            port.to_life(record)
        told = {
            "number": parent.number,
            "turn": switch.ledger.state_turn,
            "stash": switch.ledger.stash,
            "slot": parent.slot,
        }
        move.say_now(self.worker, "come", is_suspended=move.luggage.suspended, **told)
        switch.attach(port)
        beginning.follow(live)
        await beginning.is_live()

    def _said(self, record: ToHome) -> None:
        """From the life that begins in the process."""
        if isinstance(record, Closed):
            self._beginning.fail(StartFailed(self.cell.path, str(unpack_exit(record.reason))))
        else:
            self._beginning.from_life(record)

    def take_over(self) -> list[Item]:
        self.parent.arriving = None
        self.move.say_now(self.worker, "settle")
        return []

    def go_on(self) -> None:
        for port, target in unclaimed(self.cell).items():
            self.host.told(self.cell, "bind", {"port": port, "target": target.path})
        self._beginning.go_on()

    def settled(self) -> None:
        self.parent.goes_back(self.cell)


class ToSubtree(IntoSubtree):
    """A life without recovery enters it: from a group, and so from a home, or from a process."""

    @property
    def _switch(self) -> Switch | None:
        return self._from.switch if isinstance(self._from, JournalHome) else None

    async def begin(self) -> None:
        move, luggage = self.move, self.move.luggage
        self._up: asyncio.Future[None] = move.node.loop.create_future()
        self.parent.arriving = self._said
        move.hear(self.worker, self._heard)
        if self._switch is None:
            packed: dict[str, Any] = {"state": luggage.state, "rest": luggage.rest, "owed": list(luggage.owed)}
        else:
            owed = [number for number, ask in self._switch.calls.later.items() if not ask.is_done]
            packed = {"state": luggage.data, "rest": None, "owed": owed}
        move.say_now(self.worker, "come", traps=luggage.traps, **packed)
        await move.within(self._up, move.timeout, lambda: "its new life was not up")

    def _said(self, record: ToHome) -> None:
        if isinstance(record, Closed):
            self._fail(StartFailed(self.cell.path, str(unpack_exit(record.reason))))

    def _heard(self, step: str, told: dict[str, Any]) -> None:
        if self._up.done() or self.move.given_up.done():
            return
        if step == "failed":
            self._fail(StartFailed(self.cell.path, str(told["why"])))
        elif step == "up":
            self._up.set_result(None)

    def _fail(self, error: HoldfastError) -> None:
        if self._up.done():
            self.move.give_up(str(error))
        else:
            self._up.set_exception(error)
            self._up.exception()

    def take_over(self) -> list[Item]:
        """What waits at the home goes there, with all that ties the actor to others."""
        cell, move, luggage, more, worker = self.cell, self.move, self.move.luggage, self.cell.extra(), self.worker
        switch, node, bound = self._switch, cell.node, luggage.bound if self._switch is None else None
        self.parent.arriving = None
        if switch is not None:
            for topic in dict.fromkeys([*switch.intake.class_topics, *switch.topics]):
                node.topics.unsubscribe(topic, inlet(switch, topic))
                node.topics.subscribe(topic, cell)
        if bound is not None:
            luggage.waiting += bound.waiting
            bound.waiting = deque()
        told = {
            "stash": pack(worker, cell, luggage.stash),
            "queue": pack(worker, cell, luggage.queue),
            "waiting": pack(worker, cell, luggage.waiting),
            "owed": pack_owed(worker, luggage.owed),
            "timers": luggage.timers,
            "is_suspended": luggage.suspended,
            "links": list(more.ties.links.values()),
            "monitors": [[watch.watcher.path, watch.for_good] for watch in more.ties.monitors],
            "watches": [[watch.name, watch.for_good] for watch in more.ties.watching],
            "topics": list(more.belongings.topics),
        }
        move.say_now(worker, "settle", **told)
        self.parent.goes_for_good()
        more.outlet, more.bound, more.suspended = None, None, 0
        self.host = worker.inner.lived_there(cell)
        if bound is not None:
            bound.release()
        return []

    def go_on(self) -> None:
        cell, worker = self.cell, self.worker
        for port, target in unclaimed(cell).items():
            data = {"port": port, "target": target.path}
            worker.connection.send(frames.Command(worker.connection.names.to_wire(cell.path), "bind", data))
        self.move.gone_on_at = now()

    def settled(self) -> None:
        self.cell.spec = None  # Its supervisor is not here.
