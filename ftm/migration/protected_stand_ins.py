"""A protected child of a supervisor in another process, as that process has it: its replicas are the root's.

The cell here stands for the lives that a group at the root lives. Its supervisor starts and stops it as any other, and
decides what follows from its end; what is sent to it goes to its home, in order with all else that leaves the process.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from ...actors import exit_reasons
from ...actors.control.orders_lane import Call
from ...actors.errors import ControlFailed, StartFailed, StartIgnored
from ...actors.exit_reasons import ExitReason, pack_exit, unpack_exit
from ...actors.kernel import lifecycle
from ...actors.kernel.cell import DOWN, RUNNING, Cell
from ...actors.kernel.envelope import Ask, Envelope, Item
from ...actors.kernel.mailbox import Bounded
from ...actors.kernel.message import message_name
from ...actors.migration.here import dispose
from ...actors.migration.quiesce import farewell, obey_commands, part, settle_with_queue, sorted_out, twin
from ...actors.migration.worker_moves import GuestMove
from ...actors.process.wire.connection import BadFrame
from ...actors.process.wire.peer import send_signal
from ...actors.process.wire.start_codec import pack_recipe
from ...checkpoint.life.recorded_inbox import StopRecorded
from ...checkpoint.life.recorded_life import Life
from ...checkpoint.life.worker_lives import GuestKeeper, InnerLifeHost, Port
from ...checkpoint.method import Method
from ...checkpoint.protocol import (
    Closed,
    Over,
    Protected,
    Respec,
    Started,
    Wanted,
)
from ...supervision.respec import replace_mechanism
from ..group.transient_homes import UNKEPT
from ..mechanisms.mechanism import Description, compose, revive
from ..replica.replica_life import NOWHERE

if TYPE_CHECKING:
    from ...actors.process.worker_node import Guest
    from ...supervision.spec import ChildSpec


class InnerGroupHost:
    """The host of such a child's stand-in."""

    takes_parcels = True

    def __init__(self, guest: Guest, spec: ChildSpec, port_of: Callable[[str], Port]) -> None:
        self._guest, self._port_of = guest, port_of
        recovery = spec.recovery
        self._method: Method = recovery if recovery is not None and recovery.records else UNKEPT
        self._port: Port | None = None
        self.bound: Bounded | None = None
        self._number = 0
        self._up: asyncio.Future[None] | None = None

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        return True

    def start(self, cell: Cell) -> asyncio.Future[None]:
        """Ask the root for replicas."""
        more = cell.extra()
        start, node = more.start, cell.node
        assert start is not None
        if self._method.hooks is not None:
            why = "recovery hooks run in the root process: give them to ActorSystem(recovery_hooks=...)"
            raise StartFailed(cell.path, why)
        if isinstance(node.keeper, GuestKeeper):
            node.keeper.begins(cell.path)
        cell.table, cell.admit = start.kind._table, self.way_home
        if more.bound is not None:  # The home counts.
            self.bound, more.bound = Bounded(more.bound.capacity, more.bound.overflow), None
        self._number += 1
        self._up = node.loop.create_future()
        port = self._port = self._joined(cell)
        layers = [msgspec.to_builtins(layer.describe()) for layer in compose(cell.spec.mechanism)]
        bindings = {name: target.path for name, target in more.bindings.items()}
        made = Protected(pack_recipe(start, cell.path), layers, bindings)
        kind, topics = message_name(start.kind), list(start.kind._topics)
        port.to_home(Wanted(self._number, kind, topics, self._method, self.bound, made))
        return self._up

    def _joined(self, cell: Cell) -> Port:
        """The way home, on which we hear of lives at the root from now on."""
        port = self._port_of(cell.path)
        port.on_started = lambda record: self._started(cell, record)
        port.on_group = lambda record: self._told_by_group(cell, record)
        return port

    def take_up(self, cell: Cell, number: int) -> None:
        """A life that was lived here goes on at the root, as that which was wanted as `number`."""
        self._number, self._port = number, self._joined(cell)
        cell.host, cell.admit = self, self.way_home

    def _started(self, cell: Cell, record: Started) -> None:
        if record.number != self._number or self._up is None or self._up.done():
            return
        if record.problem or record.is_ignored:
            kind = StartIgnored if record.is_ignored else StartFailed
            self._fail(kind(cell.path, record.problem))
            return
        cell.life += 1
        cell.state = RUNNING
        self._up.set_result(None)

    def _fail(self, error: StartFailed) -> None:
        if self._up is not None and not self._up.done():
            self._up.set_exception(error)
            self._up.exception()  # Nobody may be left to look.

    def _told_by_group(self, cell: Cell, record: Over | Respec) -> None:
        if isinstance(record, Respec):
            respec(cell, record.layers)
        elif record.number == self._number and cell.state is RUNNING:
            reason = unpack_exit(record.reason)
            self._say_closed(cell, reason)
            lifecycle.ended(cell, reason)

    def _say_closed(self, cell: Cell, reason: ExitReason) -> None:
        assert self._port is not None
        recovers = self.recovers(reason) and cell.spec is not None and cell.spec.restarts(reason)
        self._port.to_home(Closed(self._number, pack_exit(reason), recovers))

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if cell.state is RUNNING:
            self._guest.command(cell, "stop", {"reason": pack_exit(reason)})

    def kill(self, cell: Cell) -> None:
        if cell.state is RUNNING:
            self._guest.command(cell, "kill", {})
        elif cell.state is DOWN and self._up is not None and not self._up.done():
            cell.extra().reason = exit_reasons.KILLED
            self._say_closed(cell, exit_reasons.KILLED)
            self._number += 1
            self._fail(StartFailed(cell.path, "it was stopped while it started"))

    def retired(self, cell: Cell) -> None:
        if cell.queue:
            cell.queue.clear()  # Its home has these.
        self._guest.tell_gone(cell)
        self._guest.recovery.vacated(cell.path)

    def progress(self, cell: Cell) -> object:
        return object()  # It waits for the root.

    def recovers(self, reason: ExitReason) -> bool:
        """Whether an end for this reason is followed by a recovery."""
        return not reason.is_clean

    def way_home(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: the home numbers, and feeds the replicas."""
        if not isinstance(item, Item) and type(item) not in cell.table:
            cell.require(item)
        self._guest.send_item(cell, cell.path, item, 0)

    def offer(self, cell: Cell, item: Any) -> asyncio.Future[None]:
        message, sender = (item.message, item.sender) if isinstance(item, Envelope) else (item, None)
        return self._guest.offer(cell.path, message, sender)

    def push(self, cell: Cell, item: Item) -> None:
        send_signal(self._guest, cell.path, item)

    def control(self, cell: Cell, call: Call) -> None:
        why = "it is protected, and lives at the root: order it from there"
        call.ask.fail(ControlFailed(cell.path, call.order.verb, why))

    def is_up(self, cell: Cell) -> bool:
        return cell.state is RUNNING

    def backlog(self, cell: Cell) -> int:
        return 0  # The home has it.

    def load(self, cell: Cell) -> int:
        return 0

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        if verb in ("link", "unlink"):  # Its links are kept at home; what watches it from here is told here.
            self._guest.command(cell, verb, data)


def respec(cell: Cell, described: list[Any]) -> None:
    """The next lives of a child have these mechanisms."""
    layers = tuple(map(revive, msgspec.convert(described, list[Description])))
    mechanism = None if not layers else layers[0] if len(layers) == 1 else layers
    replace_mechanism(cell, dataclasses.replace(cell.spec, mechanism=mechanism))


# -- lives that are handed over while they are lived -----------------------------------------------------------------


class RecordedChild:
    """One attempt to hand the life of a recorded child over to a group at the root, or to take it back."""

    def __init__(self, guest: Guest, path: str, attempt: int) -> None:
        self._guest, self._path = guest, path
        self._life_here = GuestMove(guest, path, attempt)  # comes to rest as that of any recorded actor
        self._arriving: Arriving | None = None

    def obey(self, step: str, told: dict[str, Any]) -> None:
        cell = self._guest.node.find(self._path)
        if cell is None or cell.state is not RUNNING:
            return  # It has ended meanwhile: the root has heard so, or will.
        match step:
            case "take" | "back":
                self._life_here.obey(step, told)
            case "leave":
                self._leave(cell, told)
            case "come":
                self._come(cell, told)
            case "settle" | "stay":
                arriving, self._arriving = self._arriving, None
                if arriving is not None:
                    self._settle(cell, arriving) if step == "settle" else self._stay(arriving)
            case _:
                raise BadFrame(f"the handing over of a child has no step {step!r}")

    def _leave(self, cell: Cell, told: dict[str, Any]) -> None:
        """The life that is at rest here is over; nobody hears of that but the actor itself."""
        old_host = cell.host
        assert isinstance(old_host, InnerLifeHost)
        life = old_host.let_go()
        life.port = NOWHERE
        old = part(cell)
        _, commands = sorted_out(cell)  # What it was fed is at its home.
        life.cell = old
        respec(cell, told["layers"])
        InnerGroupHost(self._guest, cell.spec, self._guest.recovery.port_of).take_up(cell, told["number"])
        obey_commands(cell, commands)
        farewell(old, StopRecorded(life, exit_reasons.Shutdown("moved into a group of replicas")))

    def _come(self, cell: Cell, told: dict[str, Any]) -> None:
        """Begin the life that comes back; it handles nothing yet."""
        guest, number, slot = self._guest, told["number"], told["slot"]
        port = guest.recovery.port_of(self._path)
        start, recovery = cell.extra().start, cell.spec.recovery
        assert start is not None
        other = twin(cell)
        other.life -= 1  # Counted up by the life that begins; it is no other one.
        other.extra().start, other.extra().bindings = start, cell.extra().bindings
        life = Life(other, port, recovery, guest.page[slot : slot + 1], may_fork=True)
        life.begins_suspended = told["is_suspended"]
        self._arriving = Arriving(InnerLifeHost(guest, recovery, guest.recovery.port_of), other, life, number)

        def ended_early(done: asyncio.Future[ExitReason]) -> None:
            if self._arriving is not None and self._arriving.other is other:
                port.to_home(Closed(number, pack_exit(done.result())))

        try:
            port.begin(life, told["turn"], told["stash"])
        except StartFailed:
            port.life = None
            port.to_home(Closed(number, pack_exit(other.extra().reason)))
        else:
            other.ended().add_done_callback(ended_early)

    def _stay(self, arriving: Arriving) -> None:
        """The new life is not to be."""
        self._guest.recovery.port_of(self._path).life, arriving.life.port = None, NOWHERE
        dispose(arriving.other)

    @staticmethod
    def _settle(cell: Cell, arriving: Arriving) -> None:
        """From here on the new life is the one."""
        settle_with_queue(arriving.other, cell)
        arriving.life.cell = cell
        arriving.host.take_up(cell, arriving.life, arriving.number)
        respec(cell, [])
        lifecycle.up(cell)


class Arriving(NamedTuple):
    """A life that was begun beside its address, and is not the one yet."""

    host: InnerLifeHost
    other: Cell
    life: Life
    number: int
