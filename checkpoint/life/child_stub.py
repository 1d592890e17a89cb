"""A child of a supervisor in this process whose home is at the root: what its supervisor has of it here.

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
from ...actors.kernel.cell import DOWN, Cell, Host
from ...actors.kernel.envelope import Envelope, Item
from ...actors.kernel.mailbox import Bounded, Senders
from ...actors.kernel.message import message_name
from ..method import Method
from ..protocol import Begin, Closed, Over, Protected, Respec, Started, Wanted

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


class ChildStub(Host):
    """The host of such a child, as far as it is the same wherever its lives are lived."""

    takes_parcels = True

    def __init__(self, guest: Guest, method: Method, port_of: Callable[[str], Port]) -> None:
        self._guest, self._method, self._port_of = guest, method, port_of
        self._port: Port | None = None
        self.bound: Bounded | None = None
        self._homeward: Homeward | None = None
        self._number = 0  # of the life that is wanted
        self._up: asyncio.Future[None] | None = None
        self.life: Life | None = None  # that is lived here

    def join(self, cell: Cell) -> Port:
        """The way home, on which we hear of lives from now on."""
        self.cell = cell
        port = self._port = self._port_of(cell.path)
        port.stub = self
        return port

    def take_up(self, cell: Cell, number: int) -> None:
        """A life that was begun elsewhere goes on as that of the address, as if it had been wanted as `number`."""
        self._number = number
        self.join(cell)
        cell.host, cell.admit = self, self.way_home

    def begin_here(self, record: Begin) -> None:
        """Begin the life that is wanted, if it is to be lived here."""

    def started(self, record: Started) -> None:
        """The home tells how the start of a life went."""
        raise NotImplementedError

    def closed_here(self) -> None:
        """A life that was lived here is over, or its start has failed."""

    def told_by_group(self, record: Over | Respec) -> None:
        """Take what a group at the root says, if that lives it."""

    def ask_for_life(self, cell: Cell, method: Method, made: Protected | None = None) -> asyncio.Future[None]:
        """Ask the home for a life; the future ends when it is up. `made`: what a group at the root needs.

        Raises:
            StartFailed: it cannot be begun from here.
        """
        more, node = cell.extra(), cell.node
        start = more.start
        assert start is not None
        if method.hooks is not None:
            why = "recovery hooks run in the root process: give them to ActorSystem(recovery_hooks=...)"
            raise StartFailed(cell.path, why)
        self._guest.recovery.begins(cell.path)
        cell.table, cell.admit = start.kind._table, self.way_home
        if more.bound is not None:  # The home counts.
            self.bound, more.bound = Bounded(more.bound.capacity, more.bound.overflow), None
            if self.bound.overflow == "block":
                more.outlet = self._homeward = Homeward(node.loop, self.bound.capacity)
        self._number += 1
        self._up = node.loop.create_future()
        port = self.join(cell)
        kind, topics = message_name(start.kind), list(start.kind._topics)
        bindings = {name: target.path for name, target in more.bindings.items()}
        port.to_home(Wanted(self._number, kind, topics, method, self.bound, made, bindings))
        return self._up

    def is_starting(self, number: int) -> bool:
        """Whether this very life is waited for."""
        return number == self._number and self._up is not None and not self._up.done()

    def fail(self, error: StartFailed) -> None:
        """The life that is waited for does not come up."""
        if self._up is not None and not self._up.done():
            self._up.set_exception(error)
            self._up.exception()  # Nobody may be left to look.

    def say_closed(self, cell: Cell, reason: ExitReason) -> None:
        """Tell the home that the supervisor has seen the end of the life."""
        assert self._port is not None
        recovers = self.recovers(reason) and cell.spec is not None and cell.spec.restarts(reason)
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

    def retired(self, cell: Cell) -> None:
        """The address is gone for good."""
        if cell.queue:
            cell.queue.clear()  # Its home has these.
        self._guest.tell_gone(cell)
        self._guest.recovery.vacated(cell.path)

    def recovers(self, reason: ExitReason) -> bool:
        """Whether an end for this reason is followed by a recovery."""
        return not reason.is_clean

    def way_home(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: the home numbers and journals, and feeds whoever lives there."""
        if not isinstance(item, Item) and type(item) not in cell.table:
            cell.require(item)
        self._guest.send_item(cell, cell.path, item, 0)

    def offer(self, cell: Cell, item: Any) -> asyncio.Future[None]:
        """Admit a message for a sender that waits until its home has accepted it."""
        message, sender = (item.message, item.sender) if isinstance(item, Envelope) else (item, None)
        accepted = self._guest.offer(cell.path, message, sender)
        if self._homeward is not None:
            self._homeward.left(accepted)
        return accepted

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """A link or monitor was made or removed: links are kept at home; what watches it from here is told here."""
        if verb in ("link", "unlink"):
            self._guest.command(cell, verb, data)
