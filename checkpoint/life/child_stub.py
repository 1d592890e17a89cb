"""The local stub of a child whose supervisor lives in this process and whose home is at the root.

The supervisor starts and stops it as any other, and decides what follows from its end; what is sent to it goes to its
home, in order with all else that leaves the process. Its lives are lived here, or by a group at the root.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ...actors import exit_reasons
from ...actors.errors import StartFailed
from ...actors.exit_reasons import ExitReason, pack_exit
from ...actors.kernel import links
from ...actors.kernel.address_host import AddressHost, Home, Place
from ...actors.kernel.cell import DOWN, RUNNING, Cell, GivenName
from ...actors.kernel.envelope import Item
from ...actors.kernel.lifecycle import MAILBOX, NEAR
from ...actors.kernel.mailbox import Bounded, Senders
from ...actors.kernel.message import message_name
from ...actors.process.wire.peer import send_signal
from ..method import Method
from ..protocol import AtRoot, Begin, Closed, Over, Respec, Started, Wanted

if TYPE_CHECKING:
    from ...actors.process.worker_node import Guest
    from .recorded_life import Life
    from .worker_lives import Port


class Homeward:
    """The room at an actor whose home is at the root: as many messages may be on the way as its mailbox holds."""

    def __init__(self, loop: asyncio.AbstractEventLoop, capacity: int) -> None:
        self._loop, self._capacity = loop, capacity
        self._on_way = 0
        self._senders = Senders()

    def left(self, accepted: asyncio.Future[None]) -> None:
        """A message has left, whose sender waits until it is accepted."""
        self._on_way += 1
        accepted.add_done_callback(self._arrived)

    def _arrived(self, accepted: asyncio.Future[None]) -> None:
        self._on_way -= 1
        self._senders.wake(lambda: self.has_room)

    @property
    def has_room(self) -> bool:
        """Whether one more may leave."""
        return self._on_way < self._capacity

    def room(self) -> asyncio.Future[None] | None:
        """None if so; else a future that ends when it is worth trying again."""
        return None if self.has_room else self._senders.wait(self._loop)


class RootHome(Home):
    """The home of a child of a supervisor in this process, as it is here: it is at the root, and feeds a life here."""

    takes_parcels = True

    def __init__(self, guest: Guest, *, keeps_turns: bool) -> None:
        self.guest, self._keeps_turns = guest, keeps_turns
        self.bound: Bounded | None = None
        self.life: Life | None = None  # that is lived here
        self.ends: ExitReason | None = None  # why that is to end, as the home says
        self._homeward: Homeward | None = None

    @property
    def keeps_turns(self) -> bool:
        return self._keeps_turns

    def enter(self, cell: Cell) -> None:
        """From here on what is sent goes to the root, which counts it."""
        more, start = cell.extra(), cell.extra().start
        assert start is not None
        cell.table, cell.admit = start.kind._table, self.way_home
        if more.bound is not None:
            self.bound, more.bound = Bounded(more.bound.capacity, more.bound.overflow), None
            if self.bound.overflow == "block":
                more.outlet = self._homeward = Homeward(cell.node.loop, self.bound.capacity)

    def way_home(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: the home numbers and journals, and feeds whoever lives there."""
        if not isinstance(item, Item) and type(item) not in cell.table:
            cell.require(item)
        self.guest.send_item(cell, cell.path, item, 0)

    def push(self, cell: Cell, item: Item) -> None:
        if isinstance(item, (links.Exit, links.Down)):
            send_signal(self.guest, cell.path, item)
        else:
            MAILBOX.push(cell, item)

    def offer(self, cell: Cell, item: Any) -> asyncio.Future[None]:
        accepted = self.guest.offer(cell.path, item)
        if self._homeward is not None:
            self._homeward.left(accepted)
        return accepted

    def backlog(self, cell: Cell, running: int) -> int:
        return MAILBOX.backlog(cell, running)  # What is fed and not begun; the rest is at the root.

    def load(self, cell: Cell) -> int:
        return MAILBOX.load(cell)

    def progress(self, cell: Cell) -> object:
        life = self.life
        if life is None or (life.feed is None and not cell.queue):
            return object()  # It waits for the root.
        return life.turn

    def cause(self, reason: ExitReason) -> ExitReason:
        return reason if self.ends is None else self.ends

    def recovers(self, reason: ExitReason) -> bool:
        return not reason.is_clean

    def hangs(self, cell: Cell) -> None:
        if cell.state is RUNNING:
            self.guest.command(cell, "hangs", {})

    def faulted(self, cell: Cell, by: str) -> None:
        if cell.state is RUNNING:
            self.guest.command(cell, "faulted", {"by": by})

    def retired(self, cell: Cell) -> None:
        if cell.queue:
            cell.queue.clear()  # The root has these.
        self.guest.tell_gone(cell)
        self.guest.recovery.vacated(cell.path)


class ChildPlace(Place):
    """Where such a child is lived, as far as it is the same here and at the root: its supervisor asks for each life."""

    def __init__(self, home: RootHome, method: Method, port_of: Callable[[str], Port]) -> None:
        self.home, self._method, self._port_of = home, method, port_of
        self._port: Port | None = None
        self._number = 0  # of the life that is wanted
        self._up: asyncio.Future[None] | None = None

    def join(self, cell: Cell) -> Port:
        """The way home, on which we hear of lives from now on."""
        self.cell = cell
        port = self._port = self._port_of(cell.path)
        port.place = self
        return port

    def take_up(self, cell: Cell, number: int) -> None:
        """A life that was begun elsewhere goes on as that of the address, as if it had been wanted as `number`."""
        self._number = number
        self.join(cell)
        cell.host, cell.admit = AddressHost(self.home, self, NEAR), self.home.way_home

    def name(self, cell: Cell, name: GivenName) -> None:
        """The root gives the name when it is asked for the life, for it has the address."""

    def begin_here(self, record: Begin) -> None:
        """Begin the life that is wanted, if it is to be lived here."""

    def started(self, record: Started) -> None:
        """The root tells how the start of a life went."""
        raise NotImplementedError

    def closed_here(self) -> None:
        """A life that was lived here is over, or its start has failed."""

    def told_by_root(self, record: Over | Respec) -> None:
        """Take what the root says of a life that is lived there."""

    def ask_for_life(self, cell: Cell, method: Method, made: AtRoot | None = None) -> asyncio.Future[None]:
        """Ask the home for a life; the future ends when it is up. `made`: what a life at the root needs.

        Raises:
            StartFailed: it cannot be begun from here.
        """
        start = cell.extra().start
        assert start is not None
        if method.meanwhile.hooks is not None:
            why = "recovery hooks run in the root process: give them to ActorSystem(recovery_hooks=...)"
            raise StartFailed(cell.path, why)
        self.home.guest.recovery.begins(cell.path)
        self.home.enter(cell)
        self._number += 1
        self._up = cell.node.loop.create_future()
        port = self.join(cell)
        kind, topics = message_name(start.kind), list(start.kind._topics)
        bindings = {name: target.path for name, target in cell.extra().bindings.items()}
        spec, bound, back = cell.spec, self.home.bound, cell.spec.comes_back
        register, made_up = spec.register, spec.made_up
        port.to_home(
            Wanted(self._number, kind, topics, method, bound, made, bindings, register, made_up, comes_back=back)
        )
        return self._up

    def is_starting(self, number: int) -> bool:
        """Whether this very life is waited for."""
        return number == self._number and self._up is not None and not self._up.done()

    def came_up(self) -> None:
        """The life that is waited for is up."""
        if self._up is not None and not self._up.done():
            self._up.set_result(None)

    def fail(self, error: StartFailed) -> None:
        """The life that is waited for does not come up."""
        if self._up is not None and not self._up.done():
            self._up.set_exception(error)
            self._up.exception()  # Nobody may be left to look.

    def disowned(self, cell: Cell) -> None:
        self._number += 1
        self.fail(StartFailed(cell.path, "another supervisor has it now"))
        self.home.guest.recovery.vacated(cell.path)

    def say_closed(self, cell: Cell, reason: ExitReason) -> None:
        """Tell the home that the supervisor has seen the end of the life."""
        assert self._port is not None
        recovers = self.home.recovers(reason) and cell.spec is not None and cell.spec.restarts(reason)
        self._port.to_home(Closed(self._number, pack_exit(reason), recovers))

    def gave_up_start(self, cell: Cell) -> bool:
        """Whether a start was under way, which is given up by this."""
        if cell.state is not DOWN or self._up is None or self._up.done():
            return False
        cell.extra().reason = exit_reasons.KILLED
        self.say_closed(cell, exit_reasons.KILLED)
        self._number += 1
        self.fail(StartFailed(cell.path, "it was stopped while it started"))
        return True

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """A link or monitor was made or removed: links are kept at home; what watches it from here is told here."""
        if verb in ("link", "unlink"):
            self.home.guest.command(cell, verb, data)
