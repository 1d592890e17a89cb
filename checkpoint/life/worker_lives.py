"""Recorded lives in an actor process: the process's own actor, or any below its supervisor."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import msgspec

from ...actors import exit_reasons
from ...actors.errors import ControlFailed, StartFailed, StartIgnored
from ...actors.exit_reasons import ExitReason, pack_exit
from ...actors.kernel import lifecycle, links
from ...actors.kernel.cell import DOWN, RUNNING, Cell, Host
from ...actors.kernel.envelope import Envelope, Item
from ...actors.kernel.mailbox import Bounded, Senders
from ...actors.kernel.message import message_name
from ...actors.persistence import child_key
from ...actors.process.wire import frames
from ...actors.process.wire.peer import send_signal
from ..method import Method
from ..protocol import (
    Begin,
    Closed,
    Over,
    Respec,
    Restore,
    Started,
    ToHome,
    ToLife,
    Wanted,
)
from .recorded_inbox import StopRecorded
from .recorded_life import Life

if TYPE_CHECKING:
    from ...actors.process.worker_node import Guest

FROM_HOME: msgspec.msgpack.Decoder[ToLife] = msgspec.msgpack.Decoder(ToLife)


class RecordedGuest:
    """All recorded addresses of this process."""

    def __init__(self, guest: Guest) -> None:
        self._guest = guest
        self._ports: dict[str, Port] = {}
        guest.record_taker = self._taker

    def _taker(self, path: str) -> frames.TakeRecord:
        return lambda frame: self.port_of(path).take(frame)

    def port_of(self, path: str) -> Port:
        """The way home from an address."""
        port = self._ports.get(path)
        if port is None:
            port = self._ports[path] = Port(self._guest, path)
        return port

    def vacated(self, path: str) -> None:
        """Nobody lives at an address any more: whoever does so again is given a new way."""
        self._ports.pop(path, None)

    def start(self, cell: Cell, options: dict[str, Any]) -> None:
        """Begin the life that a launch asks for, of the process's own actor.

        Raises:
            StartFailed: `__init__` or the restoring raised.
        """
        port = self.port_of(cell.path)
        life = Life(cell, port, Method.of(options["method"]), self._guest.page, may_fork=True)
        cell.host = OwnHost(self._guest, life)
        if options.get("trap_exits"):  # It was moved here.
            cell.extra().trap_exits = True
        life.begins_suspended = bool(options.get("suspended"))
        port.begin(life, int(options["turn"]), list(options["stash"]))

    def host_for(self, spec: Any) -> Host:
        """Where a child below this process's supervisor is lived: here; if it is recorded, its home is at the root."""
        if spec.recovery is not None and spec.recovery.records:
            return InnerLifeHost(self._guest, spec.recovery, self.port_of)
        return self._guest.node.here


class GuestKeeper:
    """The root's keeper, as the supervisors of this process speak to it: in order with everything else they say."""

    def __init__(self, guest: Guest, notes: dict[str, bytes], known: list[str]) -> None:
        self._guest, self._notes, self._known = guest, dict(notes), set(known)

    def _say(self, what: str, path: str, **data: Any) -> None:
        root = self._guest.node.root
        assert root is not None
        self._guest.command(root, "keep", {"what": what, "path": path, **data})

    def knows(self, path: str) -> bool:
        """Whether anything was ever recorded at this address, and not erased since."""
        return path in self._known

    def begins(self, path: str) -> None:
        """Something is recorded there from now on."""
        self._known.add(path)

    def erase(self, path: str, *, below: bool) -> None:
        """Have the root forget what was recorded there."""
        self._known.discard(path)
        if below:
            prefix = f"{path}/"
            self._known = {one for one in self._known if not one.startswith(prefix)}
            for key in self.notes(child_key(path, "")):
                del self._notes[key]
        self._say("erase", path, below=below)

    def roll_back(self, path: str, why: str) -> None:
        """Have the root let its next life begin with an older snapshot; if there is none, the root tells that."""
        if not self.knows(path):
            raise ControlFailed(path, "roll_back", "nothing was recorded of it in this run")
        self._say("roll_back", path, why=why)

    def blame(self, path: str) -> None:
        """The supervisor above this address ends because of the actor there."""
        self._say("blame", path)

    def returned(self, path: str, period: float) -> None:
        """A supervisor in this process is started again."""
        self._say("returned", path, period=period)

    def note(self, key: str, value: bytes | None) -> None:
        """Keep the fact that a supervisor has a child; None forgets it."""
        self._notes.pop(key, None)
        if value is not None:
            self._notes[key] = value
        self._say("note", key.removeprefix("child "), value=value)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """The facts whose keys begin so, oldest first."""
        return {key: value for key, value in self._notes.items() if key.startswith(prefix)}


class Port:
    """The way home of the lives at one address, and what comes from there."""

    def __init__(self, guest: Guest, path: str) -> None:
        self._guest, self._path = guest, path
        self.life: Life | None = None
        self._state: list[Restore] = []
        self.on_begin: Callable[[Begin], None] | None = None
        self.on_started: Callable[[Started], None] | None = None
        self.on_closed: Callable[[], None] | None = None
        self.on_group: Callable[[Over | Respec], None] | None = None  # of lives that are lived at the root

    def take(self, frame: frames.Record) -> None:
        """A record from home."""
        record = FROM_HOME.decode(frame.body)
        match record:
            case Restore():
                self._state.append(record)
            case Begin():
                if self.on_begin is not None:  # Else its address has gone meanwhile.
                    self.on_begin(record)
                self._state.clear()
            case Started():
                if self.on_started is not None:
                    self.on_started(record)
            case Over() | Respec():
                if self.on_group is not None:
                    self.on_group(record)
            case _:
                if self.life is not None:
                    self.life.from_home(record)

    def begin(self, life: Life, turn: int, stash: list[int]) -> None:
        """Begin a life with the state that has come.

        Raises:
            StartFailed: `__init__` or the restoring raised.
        """
        start = life.cell.extra().start
        assert start is not None
        state, self._state = self._state, []
        for record in state:
            life.from_home(record)
        self.life = life
        life.begin(start, turn, stash)

    def to_home(self, record: ToHome) -> None:
        connection = self._guest.connection
        connection.send(frames.Record(connection.name_out(self._path), cast("Any", record)), self._path)

    def when_told(self, then: Callable[[], None]) -> None:
        self._guest.node.loop.call_soon(then)  # Behind the flush, which was called for before.

    def closed(self) -> None:
        self.life = None
        if self.on_closed is not None:
            self.on_closed()


class LifeHost(lifecycle.LocalHost):
    """The host of a recorded life in this process."""

    _life: Life | None

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if cell.state is RUNNING and self._life is not None:
            cell.urge(StopRecorded(self._life, reason))

    def recovers(self, reason: ExitReason) -> bool:
        return not reason.is_clean


class OwnHost(LifeHost):
    """The host of the process's own actor."""

    def __init__(self, guest: Guest, life: Life) -> None:
        self._guest, self._life = guest, life

    def retired(self, cell: Cell) -> None:
        if cell.queue:
            cell.queue.clear()
        self._guest.report_end(cell, cell.extra().reason)


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


class InnerLifeHost(LifeHost):
    """The host of a recorded child of a supervisor in this process: everything sent to it goes home first."""

    takes_parcels = True

    def __init__(self, guest: Guest, method: Method, port_of: Callable[[str], Port]) -> None:
        self._guest, self._method, self._port_of = guest, method, port_of
        self._life = None
        self._port: Port | None = None
        self._bound: Bounded | None = None
        self._homeward: Homeward | None = None
        self._number = 0
        self._up: asyncio.Future[None] | None = None

    def start(self, cell: Cell) -> asyncio.Future[None]:
        """Ask the home to bring the actor back."""
        more = cell.extra()
        start = more.start
        assert start is not None
        if self._method.hooks is not None:
            why = "recovery hooks run in the root process: give them to ActorSystem(recovery_hooks=...)"
            raise StartFailed(cell.path, why)
        if isinstance(cell.node.keeper, GuestKeeper):
            cell.node.keeper.begins(cell.path)
        cell.table = start.kind._table
        cell.admit = self._admit
        if more.bound is not None:  # The home counts.
            self._bound, more.bound = Bounded(more.bound.capacity, more.bound.overflow), None
            if self._bound.overflow == "block":
                more.outlet = self._homeward = Homeward(cell.node.loop, self._bound.capacity)
        self._number += 1
        self._up = cell.node.loop.create_future()
        port = self._port = self._joined(cell)
        kind = message_name(start.kind)
        port.to_home(Wanted(self._number, kind, list(start.kind._topics), self._with_ports(cell), self._bound))
        return self._up

    def _joined(self, cell: Cell) -> Port:
        """The way home, on which we hear of lives here from now on."""
        port = self._port_of(cell.path)
        port.on_begin = lambda record: self._begin(cell, record)
        port.on_started = lambda record: self._started(cell, record)
        port.on_closed = lambda: self._closed(cell)
        return port

    def progress(self, cell: Cell) -> object:
        life = self._life
        if life is None or (life.feed is None and not cell.queue):
            return object()  # It waits for its home.
        return life.turn

    def take_up(self, cell: Cell, life: Life, number: int) -> None:
        """A life that has come back here is that of the address, as if it had been wanted as `number`."""
        self._life, self._number, self._port = life, number, self._joined(cell)
        cell.host, cell.admit = self, self._admit

    def let_go(self) -> Life:
        """The life that is lived here, which is at rest, is not the address's any more; its home hears no more."""
        life, self._life = self._life, None
        assert life is not None
        assert self._port is not None
        self._port.life = self._port.on_closed = None
        return life

    def _with_ports(self, cell: Cell) -> Method:
        """The method; where this actor's bindings lead is known here only."""
        state = self._method.safe_state
        if state is None:
            return self._method
        ports = tuple((port, target.path) for port, target in cell.extra().bindings.items() if port in state.to)
        return dataclasses.replace(self._method, safe_state=dataclasses.replace(state, ports=ports))

    def _begin(self, cell: Cell, record: Begin) -> None:
        port, up = self._port, self._up
        if record.number != self._number or up is None or up.done() or cell.state is not DOWN:
            return
        assert port is not None
        cell.life = record.life - 1
        page = self._guest.page[record.slot : record.slot + 1]
        self._life = life = Life(cell, port, self._method, page, may_fork=True)
        port.on_closed = None  # A start that fails is told of here, with its reason.
        try:
            port.begin(life, record.turn, record.stash)
            port.on_closed = lambda: self._closed(cell)
        except StartFailed as error:
            port.life = self._life = None
            self._fail(cell, error)
            self._say_closed(cell)

    def _started(self, cell: Cell, record: Started) -> None:
        if record.number != self._number or self._up is None or self._up.done():
            return
        if not record.problem:
            self._up.set_result(None)
        elif cell.state is DOWN:
            self._fail(cell, StartFailed(cell.path, record.problem))
        else:  # Its replay diverged: the next life begins when this one is over.
            cell.ended().add_done_callback(lambda _: self._fail(cell, StartFailed(cell.path, record.problem)))
            cell.kill()

    def _fail(self, cell: Cell, error: StartFailed) -> None:
        if self._up is not None and not self._up.done():
            self._up.set_exception(error)
            self._up.exception()  # Nobody may be left to look.

    def _closed(self, cell: Cell) -> None:
        life, self._life = self._life, None
        self._say_closed(cell)
        if life is not None and life.ignored_why is not None:
            self._fail(cell, StartIgnored(cell.path, life.ignored_why))
        elif life is not None and life.is_live and self._up is not None and not self._up.done():
            self._up.set_result(None)  # It was up, and has ended in a turn before its home could say so.
        else:
            self._fail(cell, StartFailed(cell.path, str(cell.extra().reason)))

    def _say_closed(self, cell: Cell) -> None:
        assert self._port is not None
        reason = cell.extra().reason
        recovers = self.recovers(reason) and cell.spec is not None and cell.spec.restarts(reason)
        self._port.to_home(Closed(self._number, pack_exit(reason), recovers))

    def kill(self, cell: Cell) -> None:
        if cell.state is DOWN and self._up is not None and not self._up.done():
            cell.extra().reason = exit_reasons.KILLED
            self._say_closed(cell)
            self._number += 1
            self._fail(cell, StartFailed(cell.path, "it was stopped while it started"))
        else:
            super().kill(cell)

    def retired(self, cell: Cell) -> None:
        if cell.queue:
            cell.queue.clear()  # Its home has these.
        self._guest.tell_gone(cell)
        self._guest.recovery.vacated(cell.path)

    def _admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`: the home numbers and journals, and feeds it back."""
        if not isinstance(item, Item) and type(item) not in cell.table:
            cell.require(item)
        self._guest.send_item(cell, cell.path, item, 0)

    def offer(self, cell: Cell, item: Any) -> asyncio.Future[None]:
        message, sender = (item.message, item.sender) if isinstance(item, Envelope) else (item, None)
        accepted = self._guest.offer(cell.path, message, sender)
        if self._homeward is not None:
            self._homeward.left(accepted)
        return accepted

    def push(self, cell: Cell, item: Item) -> None:
        if isinstance(item, (links.Exit, links.Down)):
            send_signal(self._guest, cell.path, item)
        else:
            super().push(cell, item)

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        if verb in ("link", "unlink"):  # Its links are kept at home; what watches it from here is told here.
            self._guest.command(cell, verb, data)
