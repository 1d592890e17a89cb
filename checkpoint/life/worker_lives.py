"""Recorded lives in an actor process: the process's own actor, or any below its supervisor."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any, cast

import msgspec

from ...actors.errors import ControlFailed, StartFailed, StartIgnored
from ...actors.exit_reasons import ExitReason, unpack_exit
from ...actors.kernel.address_host import AddressHost
from ...actors.kernel.cell import DOWN, RUNNING, Cell
from ...actors.kernel.lifecycle import HERE, NEAR
from ...actors.persistence import CHILDREN
from ...actors.process.wire import frames
from ..addresses import AddressTree
from ..method import Method
from ..protocol import (
    Begin,
    Ignored,
    Over,
    Respec,
    Restore,
    Started,
    ToHome,
    ToLife,
)
from .child_stub import ChildPlace, RootHome
from .recorded_life import FED, Life, LifePlace

if TYPE_CHECKING:
    from ...actors.control.orders_lane import QueuedOrder
    from ...actors.process.worker_node import Guest

FROM_HOME: msgspec.msgpack.Decoder[ToLife] = msgspec.msgpack.Decoder(ToLife)


class RecordedGuest:
    """All recorded addresses of this process."""

    def __init__(self, guest: Guest) -> None:
        self._guest = guest
        self._ports: dict[str, Port] = {}
        self.keeper = GuestKeeper(guest)
        guest.record_taker = self._taker

    def _taker(self, path: str) -> frames.TakeRecord:
        return lambda frame: self.port_of(path).take(frame)

    def port_of(self, path: str) -> Port:
        """The way home from an address."""
        port = self._ports.get(path)
        if port is None:
            port = self._ports[path] = Port(self._guest, path)
        return port

    def begins(self, path: str) -> None:
        """A life is about to begin at an address."""
        self.keeper.begins(path)

    def vacated(self, path: str) -> None:
        """Nobody lives at an address any more: whoever does so again is given a new way."""
        self._ports.pop(path, None)

    def readdressed(self, old: str, new: str) -> None:
        """The process's own actor has another address."""
        port = self._ports.pop(old, None)
        if port is not None:
            self._ports[new] = port
            port.path = new

    def start(self, cell: Cell, options: dict[str, Any]) -> None:
        """Begin the life that a launch asks for, of the process's own actor.

        Raises:
            StartFailed: `__init__` or the restoring raised.
        """
        port = self.port_of(cell.path)
        life = Life(cell, port, Method.of(options["method"]), self._guest.page, may_fork=True)
        cell.host = AddressHost(FED, LifePlace(life), self._guest.parent)
        if options.get("trap_exits"):  # It was moved here.
            cell.extra().trap_exits = True
        life.stage.begins_suspended = bool(options.get("suspended"))
        life.stage.was_left = bool(options.get("was_left"))
        port.begin(life, int(options["turn"]), list(options["stash"]))

    def host_for(self, spec: Any) -> AddressHost:
        """Where a child below this process's supervisor is lived: here; if it is recorded, its home is at the root."""
        if spec.recovery is not None and spec.recovery.records:
            place = child_here(self._guest, spec.recovery)
            return AddressHost(place.home, place, NEAR)
        here: AddressHost = self._guest.node.ports.here
        return here


class GuestKeeper:
    """The root's keeper, as the supervisors of this process speak to it: in order with everything else they say."""

    def __init__(self, guest: Guest) -> None:
        self._guest = guest
        self._notes: dict[str, bytes] = {}
        self._known, self._noted = AddressTree(), AddressTree()

    def learn(self, notes: dict[str, bytes], known: list[str]) -> None:
        """Take in what the root has kept of the addresses of this process so far."""
        self._notes.update(notes)
        for path in known:
            self._known.add(path)
        for key in notes:
            self._noted.add(key.removeprefix(CHILDREN))

    def _say(self, what: str, path: str, **data: Any) -> None:
        root = self._guest.node.root
        assert root is not None
        self._guest.command(root, "keep", {"what": what, "path": path, **data})

    def knows(self, path: str) -> bool:
        """Whether anything was ever recorded at this address, and not erased since."""
        return path in self._known

    def has_recorded(self, path: str) -> bool:
        """Whether anything is recorded at this address or below it, or noted of a child of a supervisor there."""
        return self._known.has(path) or any(True for _ in self._noted.below(path))

    def erasing(self, path: str) -> None:
        """Return None: the root has a life there wait, or refuses it."""

    def begins(self, path: str) -> None:
        """Something is recorded there from now on."""
        self._known.add(path)

    def erase(self, path: str, *, below: bool) -> asyncio.Future[None]:
        """Have the root forget what was recorded there."""
        known = [path] if path in self._known else []
        notes: dict[str, bytes] = {}
        if below:
            known += self._known.below(path)
            notes = {key: self._notes[key] for one in self._noted.below(path) if (key := f"{CHILDREN}{one}")}
        for one in known:
            self._known.discard(one)
        for key in notes:
            self._forget_note(key)
        answer, done = self._guest.acceptance()
        done.add_done_callback(lambda done: self._erased(done, known, notes))
        self._say("erase", path, below=below, answer=answer)
        return done

    def _forget_note(self, key: str) -> None:
        self._notes.pop(key, None)
        self._noted.discard(key.removeprefix(CHILDREN))

    def _erased(self, done: asyncio.Future[None], known: list[str], notes: dict[str, bytes]) -> None:
        """The root has answered; what its store has refused to forget is known as before."""
        if not done.cancelled() and done.exception() is not None:
            later, self._notes = self._notes, {}
            self.learn(notes | later, known)

    def roll_back(self, path: str, why: str) -> asyncio.Future[None]:
        """Have the root let its next life begin with an older snapshot."""
        if not self.knows(path):
            raise ControlFailed(path, "roll_back", "nothing was recorded of it in this run")
        key, done = self._guest.acceptance()
        self._say("roll_back", path, why=why, answer=key)
        return done

    def blame(self, path: str) -> None:
        """The supervisor above this address ends because of the actor there."""
        self._say("blame", path)

    def returned(self, path: str) -> None:
        """A supervisor in this process is started again."""
        self._say("returned", path)

    def dismissed(self, path: str, *, below: bool, for_good: bool) -> None:
        """A supervisor in this process has given up an address."""
        self._say("dismissed", path, below=below, for_good=for_good)

    def began(self, path: str, listed: Collection[str]) -> None:
        """A supervisor in this process begins with these children."""
        self._say("began", path, listed=list(listed))

    def note(self, key: str, value: bytes | None) -> None:
        """Keep the fact that a supervisor has a child; None forgets it. Other facts are kept until the process ends."""
        if not key.startswith(CHILDREN):
            self._notes.pop(key, None)
            if value is not None:
                self._notes[key] = value
            return
        self._forget_note(key)
        if value is not None:
            self.learn({key: value}, [])
        self._say("note", key.removeprefix(CHILDREN), value=value)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """The facts whose keys begin so, oldest first."""
        return {key: value for key, value in self._notes.items() if key.startswith(prefix)}

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or None."""
        return self._notes.get(key)


class Port:
    """The way home of the lives at one address, and what comes from there."""

    def __init__(self, guest: Guest, path: str) -> None:
        self._guest, self.path = guest, path
        self.life: Life | None = None
        self._state: list[Restore] = []
        self.place: ChildPlace | None = None  # of a child: it hears of its lives

    def take(self, frame: frames.Record) -> None:
        """Take a record from the home of a life in this process."""
        record = FROM_HOME.decode(frame.body)
        match record:
            case Restore():
                self._state.append(record)
            case Begin():
                if self.place is not None:  # Else its address has gone meanwhile.
                    self.place.begin_here(record)
                self._state.clear()
            case Started():
                if self.place is not None:
                    self.place.started(record)
            case Over() | Respec():
                if self.place is not None:
                    self.place.told_by_root(record)
            case _:
                if self.life is not None:
                    self.life.to_life(record)

    def begin(self, life: Life, turn: int, stash: list[int]) -> None:
        """Begin a life with the state that has come.

        Raises:
            StartFailed: `__init__` or the restoring raised.
        """
        start = life.cell.extra().start
        assert start is not None
        state, self._state = self._state, []
        for record in state:
            life.to_life(record)
        self.life = life
        life.begin(start, turn, stash)

    def to_home(self, record: ToHome) -> None:
        connection = self._guest.connection
        connection.send(frames.Record(connection.names.to_wire(self.path), cast("Any", record)), self.path)

    def when_told(self, then: Callable[[], None]) -> None:
        self._guest.node.loop.call_soon(then)  # Behind the flush, which was called for before.

    def closed(self) -> None:
        self.life = None
        if self.place is not None:
            self.place.closed_here()


class ChildHere(ChildPlace):
    """The event loop of the supervisor's process."""

    is_here = True
    _problem = ""  # why the home does not take the life that lives

    def start(self, cell: Cell) -> asyncio.Future[None]:
        """Ask the home to bring the actor back."""
        return self.ask_for_life(cell, self._with_ports(cell))

    def let_go(self) -> Life:
        """The life that is lived here, which is at rest, is not the address's any more; its home hears no more."""
        life, self.home.life = self.home.life, None
        assert life is not None
        assert self._port is not None
        self._port.life = None
        return life

    def _with_ports(self, cell: Cell) -> Method:
        """The method; where this actor's bindings lead is known here only."""
        meanwhile = self._method.meanwhile
        state = meanwhile.safe_state
        if state is None:
            return self._method
        ports = tuple((port, target.path) for port, target in cell.extra().bindings.items() if port in state.to)
        told = dataclasses.replace(meanwhile, safe_state=dataclasses.replace(state, ports=ports))
        return dataclasses.replace(self._method, meanwhile=told)

    def begin_here(self, record: Begin) -> None:
        port, cell = self._port, self.cell
        if not self.is_starting(record.number) or cell.state is not DOWN:
            return
        assert port is not None
        self.home.ends = None
        cell.life = record.life - 1
        page = self.home.guest.page[record.slot : record.slot + 1]
        life = Life(cell, port, self._method, page, may_fork=True)
        try:
            port.begin(life, record.turn, record.stash)
        except StartFailed as error:  # Told of here, with its reason.
            port.life = None
            if isinstance(error, StartIgnored):
                port.to_home(Ignored(error.reason))
            self.fail(error)
            self.say_closed(cell, cell.extra().reason)
        else:
            self.home.life = life

    def started(self, record: Started) -> None:
        cell = self.cell
        if not self.is_starting(record.number):
            return
        if not record.problem:
            self.came_up()
        elif cell.state is DOWN:
            self.fail(StartFailed(cell.path, record.problem))
        else:  # Its replay diverged: the next life begins when this one is over.
            self._problem = record.problem
            cell.kill()

    def told_by_root(self, record: Over | Respec) -> None:
        if isinstance(record, Over) and record.number == self._number and self.cell.state is RUNNING:
            self.home.ends = unpack_exit(record.reason)
            self.cell.kill()

    def closed_here(self) -> None:
        life, cell, self.home.life = self.home.life, self.cell, None
        if life is None:
            return  # It has not begun yet, or is not the address's any more.
        problem, self._problem = self._problem, ""
        self.say_closed(cell, cell.extra().reason)
        if life.stage.ignored_why is not None:
            self.fail(StartIgnored(cell.path, life.stage.ignored_why))
        elif problem:
            self.fail(StartFailed(cell.path, problem))
        elif life.is_live:
            self.came_up()  # It was up, and has ended in a turn before its home could say so.
        else:
            self.fail(StartFailed(cell.path, str(cell.extra().reason)))

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if self.home.life is not None:
            self.home.life.stop(reason)

    def kill(self, cell: Cell) -> None:
        if not self.gave_up_start(cell):
            HERE.kill(cell)

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        HERE.control(cell, call)

    def is_up(self, cell: Cell) -> bool:
        return HERE.is_up(cell)


def child_here(guest: Guest, method: Method) -> ChildHere:
    """The place of a recorded child of a supervisor in this process, whose lives are lived here."""
    return ChildHere(RootHome(guest, keeps_turns=method.replays), method, guest.recovery.port_of)
