"""A protected child as the process of its supervisor has it; its replicas belong to the root.

The cell here stands for the lives that a group at the root lives. Its supervisor starts and stops it as any other, and
decides what follows from its end; what is sent to it goes to its home, in order with all else that leaves the process.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from ...actors.control.orders_lane import QueuedOrder
from ...actors.errors import ControlFailed, StartFailed, StartIgnored
from ...actors.exit_reasons import ExitReason, pack_exit, unpack_exit
from ...actors.kernel import lifecycle, mailbox
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.migration.here import dispose
from ...actors.migration.quiesce import Settle, farewell, obey_commands, part, settle_with_queue, sorted_out, twin
from ...actors.migration.worker_moves import GuestMove
from ...actors.process.resource_limits import Limits, limits_data
from ...actors.process.wire.frames import BadFrame
from ...actors.process.wire.start_codec import pack_recipe, unpack_recipe
from ...checkpoint.life.child_stub import ChildPlace, RootHome
from ...checkpoint.life.recorded_inbox import StopRecorded
from ...checkpoint.life.recorded_life import HomePort, Life
from ...checkpoint.life.worker_lives import ChildHere, child_here
from ...checkpoint.protocol import (
    AtRoot,
    Closed,
    Live,
    Over,
    Respec,
    Started,
    ToHome,
)
from ...supervision.respec import replace_mechanism
from ...supervision.respec import respec as replace_start
from ..group.transient_homes import UNKEPT
from ..model.mechanism import Description, compose, revive
from ..replica.replica_life import NOWHERE

if TYPE_CHECKING:
    from ...actors.process.worker_node import Guest
    from ...supervision.spec import ChildSpec


class ChildAtRoot(ChildPlace):
    """The root: its lives are lived there, whoever restarts it is here."""

    is_here = False
    kind = "replicas"

    def start(self, cell: Cell) -> asyncio.Future[None]:
        """Ask the root for replicas, or for a process."""
        start, spec = cell.extra().start, cell.spec
        assert start is not None
        layers = () if spec.mechanism is None else compose(spec.mechanism)
        described = [msgspec.to_builtins(layer.describe()) for layer in layers]
        made = AtRoot(pack_recipe(start, cell.path), described, limits_data(spec.limits))
        return self.ask_for_life(cell, self._method, made)

    def started(self, record: Started) -> None:
        cell = self.cell
        if not self.is_starting(record.number):
            return
        if record.problem or record.is_ignored:
            kind = StartIgnored if record.is_ignored else StartFailed
            self.fail(kind(cell.path, record.problem))
            return
        cell.life += 1
        cell.state = RUNNING
        self.came_up()

    def told_by_root(self, record: Over | Respec) -> None:
        cell = self.cell
        if isinstance(record, Respec):
            respec(cell, record)
        elif record.number == self._number and cell.state is RUNNING:
            reason = unpack_exit(record.reason)
            self.say_closed(cell, reason)
            lifecycle.ended(cell, reason)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if cell.state is RUNNING:
            self.home.guest.command(cell, "stop", {"reason": pack_exit(reason)})

    def kill(self, cell: Cell) -> None:
        if cell.state is RUNNING:
            self.home.guest.command(cell, "kill", {})
        else:
            self.gave_up_start(cell)

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        why = "it lives in another process: order it from the root"  # Which has taken back what it had ordered here.
        call.ask.fail(ControlFailed(cell.path, call.order.verb, why))

    def is_up(self, cell: Cell) -> bool:
        return cell.state is RUNNING


def child_at_root(guest: Guest, spec: ChildSpec) -> ChildAtRoot:
    """The place of a child of a supervisor in this process that is lived elsewhere."""
    recovery = spec.recovery
    method = recovery if recovery is not None and recovery.records else UNKEPT
    return ChildAtRoot(RootHome(guest, keeps_turns=method.replays), method, guest.recovery.port_of)


def respec(cell: Cell, said: Respec) -> None:
    """The next lives of a child have these mechanisms, or live there without one; they may begin otherwise, too."""
    layers = tuple(map(revive, msgspec.convert(said.layers, list[Description])))
    mechanism = None if not layers else layers[0] if len(layers) == 1 else layers
    limits = Limits(**said.limits) if said.limits else None
    spec = dataclasses.replace(cell.spec, mechanism=mechanism, isolation=said.isolation, limits=limits)
    # What lasts stands in a recipe at the root; a supervisor that notes its children has none of them in one.
    replace_mechanism(cell, spec, is_lent=True)
    if said.start:
        replace_start(cell, unpack_recipe(said.start))


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
        place = cell.host.place
        assert isinstance(place, ChildHere)
        life = place.let_go()
        life.port = NOWHERE
        old = part(cell)
        _, commands = sorted_out(cell)  # What it was fed is at its home.
        life.cell = old
        respec(cell, Respec(**told["spec"]))
        child_at_root(self._guest, cell.spec).take_up(cell, told["number"])
        obey_commands(cell, commands)
        farewell(old, StopRecorded(life, unpack_exit(told["reason"])))

    def _come(self, cell: Cell, told: dict[str, Any]) -> None:
        """Begin the life that comes back; it handles nothing yet."""
        guest, number, slot = self._guest, told["number"], told["slot"]
        port = guest.recovery.port_of(self._path)
        start, recovery = cell.extra().start, cell.spec.recovery
        assert start is not None
        other = twin(cell)
        other.life -= 1  # Counted up by the life that begins; it is no other one.
        other.extra().start, other.extra().bindings = start, cell.extra().bindings
        life = Life(other, HeldWhenLive(port, other), recovery, guest.page[slot : slot + 1], may_fork=True)
        life.stage.begins_suspended = told["is_suspended"]
        self._arriving = Arriving(child_here(guest, recovery), other, life, port, number)

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
        arriving.life.cell, arriving.life.port = cell, arriving.port
        arriving.place.home.life = arriving.life
        arriving.place.take_up(cell, arriving.number)
        respec(cell, Respec([]))
        lifecycle.up(cell)


class Arriving(NamedTuple):
    """A life that was begun beside its address, and is not the one yet."""

    place: ChildHere
    other: Cell
    life: Life
    port: HomePort
    number: int


class HeldWhenLive:
    """The way home of a life that arrives: when it is live it handles nothing, for it is not the one yet.

    What its replay has put back stands in its queue already; a turn in hand would be left behind when it settles.
    """

    def __init__(self, port: HomePort, other: Cell) -> None:
        self._port, self._other = port, other

    def to_home(self, record: ToHome) -> None:
        if isinstance(record, Live):
            mailbox.queue_of(self._other).appendleft(Settle(self._other.node.loop.create_future()))
        self._port.to_home(record)

    def when_told(self, then: Callable[[], None]) -> None:
        self._port.when_told(then)

    def closed(self) -> None:
        self._port.closed()
