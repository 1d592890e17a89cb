"""The gate: checks what an actor process says to the root before any handler sees it.

An actor process is trusted with its own actors and with nothing else: those at the address it was given, and below it.
It may send to any address, but only as one of its own; what it claims (lives, state, names, children, links, events) it
may claim of its own; orders it may give to what it has started, and to what it was granted: the addresses that bindings
made or named at the root lead to, and those below them. The bindings that it claims grant nothing. A breach ends that
process and nothing else.

`RULES` has a row for each kind of frame, `COMMANDS` one for each verb.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, Final, get_args

from ...errors import NotGranted
from ...events import DeadLetter
from ...exit_reasons import unpack_exit
from ...kernel.bindings import unclaimed
from ...kernel.cell import GONE, Cell, Scope
from ...kernel.message import RuntimeOrder
from ...kernel.node import cell_kind
from . import frames
from .frames import BadFrame
from .name_table import MOST_NAMES
from .start_codec import loaded

if TYPE_CHECKING:
    from ..worker_pool import Worker

MOST_NAMES_IN: Final = 16 * MOST_NAMES
"""Names that a process may have given without forgetting any: it forgets long before, unless it lies."""
MOST_NAME_CHARS: Final = 16 * 1024 * 1024
"""The characters of all of them."""
MOST_BINDINGS: Final = 256
"""Ports of one actor that a process may say something of."""
MOST_NAME: Final = 1024
"""The characters of a name beside an address."""
MOST_LIVES: Final = 2**53
"""No address has had so many lives."""


class WorkerGate:
    """The gate of one actor process."""

    def __init__(self, worker: Worker) -> None:
        self._worker = worker
        self._node = worker.node
        self._own: set[int] = set()  # numbers of names that are its own addresses
        self._orders: set[int] = set()  # numbers of names of messages that are orders
        self._cleared: set[tuple[str, str]] = set()  # what a recorded life has sent before: address, message
        self._targets: dict[int, Cell] = {}
        self._chars = 0
        self._left: deque[tuple[str, str]] = deque()  # addresses it had, and has not heard yet that it has others

    def readdressed(self, was: str, now: str) -> None:
        """An address has become another, with all below it: what it says until it knows that is meant so.

        If that is an actor of its own, and not below its own any more, all is void that it says of it then.
        """
        self._left.append((was, now))
        self._own.clear()
        self._worker.connection.names.rename_got(self._now)

    def _now(self, path: str) -> str:
        for old, new in self._left:
            if is_at_or_below(path, old):
                path = new + path[len(old) :]
        return path

    def heard(self) -> None:
        """It knows the oldest of these.

        Raises:
            BadFrame: there is none that it could have heard of.
        """
        if not self._left:
            raise BadFrame("it has heard of an address that nobody has told it")
        self._left.popleft()

    def forget(self) -> None:
        """The process gives all its names anew."""
        self._own.clear()
        self._orders.clear()
        self._targets.clear()
        self._cleared.clear()
        self._chars = 0

    def admits(self, frame: frames.AnyFrame) -> bool:
        """See whether the process may say this. False: it is void, for it has not heard yet whom it speaks of.

        Raises:
            BadFrame: it may not.
        """
        try:
            self._check(frame)
        except BadFrame:
            if not self._is_of_lost(frame):
                raise
            self._refuse(frame)
            return False
        return True

    def _is_of_lost(self, frame: frames.AnyFrame) -> bool:
        """Whether it names an actor that has left, and the process has not heard so."""
        named: list[object] = []
        if isinstance(frame, (frames.Command, frames.Note)):
            named += frame.data.values()
        if isinstance(frame, (frames.Command, frames.Tell, frames.Offer, frames.Ask, frames.Record, frames.Migrate)):
            known = type(frame.to) is int
            named += [self._worker.connection.names.from_wire(frame.to)] if known else []
        lost = [now for _, now in self._left if not (self.owns(now) or is_at_or_below(self.home, now))]
        return any(isinstance(one, str) and any(is_at_or_below(one, new) for new in lost) for one in named)

    def _refuse(self, frame: frames.AnyFrame) -> None:
        """Whoever waits for an answer gets one."""
        answer: object = None
        if isinstance(frame, (frames.Ask, frames.Offer)):
            answer = frame.id
        elif isinstance(frame, frames.Command):
            answer = frame.data.get("answer")
        if type(answer) is int:
            self._worker.accepted(answer, NotGranted(self._left[0][0], "an order", self.home))

    def _check(self, frame: frames.AnyFrame) -> None:
        rule = RULES.get(type(frame))
        if rule is None:
            raise BadFrame(f"an actor process cannot send a {type(frame).__name__}")
        if self._left and isinstance(frame, (frames.Command, frames.Note)):
            frame.data = {
                key: self._now(value) if isinstance(value, str) else value for key, value in frame.data.items()
            }
        rule(self, frame)

    # -- whose it is ------------------------------------------------------------------------------------------------

    @property
    def home(self) -> str:
        """The address that the process was given."""
        if self._worker.cell is None:
            raise BadFrame("a process without an actor says something")
        return self._worker.home

    def owns(self, path: str) -> bool:
        """Whether an address is its own."""
        return is_at_or_below(path, self.home)

    def require_own(self, path: object, what: str) -> str:
        """An address that must be its own."""
        if not isinstance(path, str):
            raise BadFrame(f"{what} has {path!r} for an address")
        if not self.owns(path):
            raise BadFrame(f"{what} of {path}, and the process is that of {self.home}")
        return path

    def require_name(self, name: str, scope: str) -> None:
        """A name that one of its actors is to have; whether nobody has it is seen later.

        Only supervisors have children with names by their specs.
        """
        kind = None if self._worker.cell is None else cell_kind(self._worker.cell)
        if kind is None or not kind._supervises:
            raise BadFrame(f"a name for a child of {self.home}, which is no supervisor")
        if name.startswith("/") or len(name) > MOST_NAME or scope not in get_args(Scope):
            raise BadFrame(f"a name {name[:MOST_NAME]!r}, to be found by {scope!r}")

    def require_voice(self, path: str, what: str) -> None:
        """An address in whose name it acts: its own, or the one whose replica it is."""
        if path not in self._voices():
            self.require_own(path, what)

    def speaks_for(self, path: str) -> bool:
        """Whether an address is the one whose replica it is, whatever its name was: a turn may end its own actor."""
        return self._node.cell_at(path).living.path in self._voices()

    def require_granted(self, path: str, what: str) -> None:
        """An address to which it may give orders."""
        cell = self._worker.cell
        if not self.owns(path) and (cell is None or not is_granted(path, cell, self._bound(cell))):
            raise BadFrame(f"{what} to {path}, which {self.home} has neither started nor is bound to")

    def order(self, path: str, order: str) -> None:
        """An order to whoever lives at an address, which must be one that anybody may give there."""
        self.require_granted(path, repr(order))
        try:
            self._node.cell_at(path).require_order("stop" if order == "stop" else "kill")
        except NotGranted as error:
            raise BadFrame(str(error)) from error

    def _bound(self, own: Cell) -> Iterator[Cell]:
        """Whose bindings grant it something: its actors, and the one that it speaks for, whose replica it is."""
        yield own
        yield from self._worker.inner.cells()
        yield from map(self._node.cell_at, self._voices())

    def claims(self, told: object) -> None:
        """It says where bindings of an actor of its own lead."""
        if not isinstance(told, dict) or len(told) > MOST_BINDINGS:
            raise BadFrame(f"an actor without bindings, or with more than {MOST_BINDINGS}")
        for port, path in told.items():
            if not isinstance(port, str) or not isinstance(path, str) or not path.startswith("/"):
                raise BadFrame(f"a binding {port!r} to {path!r}, which is no address")

    def _introduce(self, text: str) -> int:
        """A name that the process gives for the first time: its number."""
        connection = self._worker.connection
        if self._left:
            text = self._now(text)
        connection.names.from_wire(text)
        number = connection.names.number_of(text)
        self._chars += len(text)
        if number >= MOST_NAMES_IN or self._chars > MOST_NAME_CHARS:
            raise BadFrame("it gives names without end")
        return number

    def _address(self, frame: Any) -> str:
        """The address that a frame is of; known by its number from now on."""
        if type(frame.to) is str:
            frame.to = self._introduce(frame.to)
        return self._worker.connection.names.from_wire(frame.to)

    def _message(self, frame: Any) -> None:
        """What the names of a message say."""
        if type(frame.name) is str:
            number = self._introduce(frame.name)
            if is_order(frame.name):
                self._orders.add(number)
            frame.name = number
        sender = frame.sender
        if sender is not None and sender not in self._own:
            if type(sender) is str:
                sender = frame.sender = self._introduce(sender)
            path = self._worker.connection.names.from_wire(sender)
            self.require_voice(path, "a message")
            if self.owns(path):
                self._own.add(sender)

    def target(self, to: frames.Name) -> Cell:
        """The cell that a message is for.

        Raises:
            BadFrame: it is a part of the runtime, and the process has nothing to do with it.
        """
        cell = self._targets.get(to)  # type: ignore[arg-type]  # a number: the rules have seen to that
        if cell is not None and cell.state is not GONE:
            return cell
        connection = self._worker.connection
        path = connection.names.from_wire(to)
        cell = self._node.cell_at(path)
        self._check_part(cell)
        self._targets[connection.names.number_of(to)] = cell
        return cell

    def _check_part(self, cell: Cell) -> None:
        kind = cell_kind(cell)
        if kind is not None and kind._is_part:
            self.require_granted(cell.path, "a message")

    # -- the rules --------------------------------------------------------------------------------------------------

    def send(self, frame: frames.Tell | frames.Offer | frames.Ask) -> None:
        """It sends as itself; orders only to whom it may."""
        if type(frame.to) is str:
            frame.to = self._introduce(frame.to)
        sender = frame.sender
        if type(frame.name) is str or (sender is not None and sender not in self._own):
            self._message(frame)
        if frame.name in self._orders:
            connection = self._worker.connection
            self.require_granted(connection.names.from_wire(frame.to), connection.names.from_wire(frame.name))

    def ask(self, frame: frames.Ask) -> None:
        """As for a message; its deadline is a time."""
        self.send(frame)
        if not math.isfinite(frame.until):
            raise BadFrame(f"an ask with a deadline that is no time ({frame.until})")

    def publish(self, frame: frames.Publish) -> None:
        """It publishes as itself, and no orders."""
        self._message(frame)
        if frame.name in self._orders:
            raise BadFrame(f"an order is published: {self._worker.connection.names.from_wire(frame.name)}")

    def outcome(self, frame: Any) -> None:
        """It answers what was asked of it: a number that waits for nobody there is late, or nothing."""

    def ended(self, frame: frames.Ended) -> None:
        """It tells the end of its own actor."""
        path = self._address(frame)
        if path != self.home:
            raise BadFrame(f"the end of {path}, and the process is that of {self.home}")
        unpack_exit(frame.reason)

    def note(self, frame: frames.Note) -> None:
        """Its events are of its own actors; a dead letter says who tells it if it was for another."""
        address = frame.data.get("address")
        if isinstance(address, str) and (self.owns(address) or address in self._voices()):
            return
        if frame.kind != DeadLetter.__name__ or not isinstance(address, str):
            self.require_own(address, f"an event ({frame.kind})")
        frame.data["why"] = f"{frame.data.get('why')} (told by {self.home})"

    def _voices(self) -> tuple[str, ...]:
        cell = self._worker.cell
        start = None if cell is None or cell.more is None else cell.more.start
        return () if cell is None or start is None else start.kind._speaks_for(cell.path)

    def of_own(self, frame: frames.Record | frames.Migrate) -> None:
        """It is of one of its actors."""
        to = frame.to
        if to in self._own:
            return
        self.require_own(self._address(frame), f"a {type(frame).__name__}")
        self._own.add(frame.to)  # type: ignore[arg-type]  # a number now

    def command(self, frame: frames.Command) -> None:
        """As the verb's row says."""
        rule = COMMANDS.get(frame.verb)
        if rule is None:
            raise BadFrame(f"unknown command {frame.verb!r}")
        rule(self, self._address(frame), frame)

    # -- what a recorded life lets out ------------------------------------------------------------------------------

    def output(self, path: str, name: str) -> None:
        """A recorded life of this process sends a message.

        Raises:
            BadFrame: it is an order, or for a part of the runtime, and not for it to send.
        """
        if (path, name) in self._cleared:
            return
        if is_order(name):
            self.require_granted(path, name)
        if path.startswith("/"):
            self._check_part(self._node.cell_at(path))
        if is_order(name):
            return  # Looked at each time: what grants it may be bound elsewhere.
        if len(self._cleared) >= MOST_NAMES:
            self._cleared.clear()
        self._cleared.add((path, name))


def is_at_or_below(path: str, above: str) -> bool:
    """Whether an address is another one, or below it."""
    return path == above or path.startswith(f"{above}/")


def is_granted(path: str, own: Cell, cells: Iterable[Cell]) -> bool:
    """Whether a process may give orders to an address: what the root has bound or named leads there, or above it.

    Args:
        path: the address.
        own: the process's own actor, with the recipe that the root has given it.
        cells: whose bindings count, as far as the root has made them.
    """
    start = None if own.more is None else own.more.start
    named = () if start is None else start.kind._may_order(start, own.path)
    bound = (target.path for cell in cells for target in unclaimed(cell).values())
    return any(is_at_or_below(path, one) for one in (*named, *bound))


def is_order(name: str) -> bool:
    """Whether a message type, by its name on the wire, is an order."""
    return loaded(name, RuntimeOrder) is not None


def text(frame: frames.Command, key: str) -> str:
    """A text that a command gives."""
    value = frame.data.get(key)
    if not isinstance(value, str):
        raise BadFrame(f"command {frame.verb!r} has {key} {value!r}")
    return value


def _home(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    """It speaks of its own actor."""
    if to != gate.home:
        raise BadFrame(f"{frame.verb!r} of {to}, and the process is that of {gate.home}")


def _knows(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    """It has heard of its actor's new address."""
    _home(gate, to, frame)
    gate.heard()


def _own(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    """It speaks of one of its actors."""
    gate.require_own(to, repr(frame.verb))


def _topic(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    _own(gate, to, frame)
    text(frame, "topic")


def _below(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    """It speaks of an address below its own."""
    _home(gate, to, frame)
    path = gate.require_own(frame.data.get("path"), repr(frame.verb))
    if not all(path[len(to) + 1 :].split("/")):
        raise BadFrame(f"{frame.verb!r} of {path!r}, which is no address below {to}")


def _born(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    _below(gate, to, frame)
    text(frame, "kind")
    gate.claims(frame.data.get("bindings", {}))
    if "last" in frame.data:
        unpack_exit(frame.data["last"])
    life = frame.data.get("life")
    if type(life) is not int or not 0 <= life < MOST_LIVES:
        raise BadFrame(f"a life with the number {life!r}")


def _gone(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    _below(gate, to, frame)
    unpack_exit(frame.data.get("reason"))


def _named(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    """A supervisor there wants a name for a child that it starts: no other actor has children with names by specs."""
    _below(gate, to, frame)
    text(frame, "kind")
    gate.require_name(text(frame, "name"), text(frame, "scope"))
    if type(frame.data.get("answer")) is not int:
        raise BadFrame(f"an answer under {frame.data.get('answer')!r}")


def _keep(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    _home(gate, to, frame)
    gate.require_own(frame.data.get("path"), "what is kept")
    text(frame, "what")
    if type(frame.data.get("answer", 0)) is not int:
        raise BadFrame(f"an answer under {frame.data['answer']!r}")


def _order(gate: WorkerGate, to: str, frame: frames.Command) -> None:
    """An order to a life."""
    gate.order(to, frame.verb)
    if frame.verb == "stop":
        unpack_exit(frame.data.get("reason"))
    if frame.verb == "faulted" and (by := text(frame, "by")):
        gate.require_voice(by, "a kill in the name")


def _tie(key: str, *, both: bool) -> Callable[[WorkerGate, str, frames.Command], None]:
    """One end of a link or watch is its own; `both`: whichever."""

    def rule(gate: WorkerGate, to: str, frame: frames.Command) -> None:
        other = text(frame, key)
        if not (both and gate.owns(to)):
            gate.require_own(other, repr(frame.verb))
        if "reason" in frame.data:
            unpack_exit(frame.data["reason"])

    return rule


Rule = Callable[[WorkerGate, Any], None]

RULES: Final[dict[type[frames.Frame], Rule]] = {
    frames.Tell: WorkerGate.send,
    frames.Offer: WorkerGate.send,
    frames.Ask: WorkerGate.ask,
    frames.Publish: WorkerGate.publish,
    frames.Reply: WorkerGate.outcome,
    frames.Failure: WorkerGate.outcome,
    frames.Launched: WorkerGate.outcome,
    frames.Beat: WorkerGate.outcome,
    frames.PageChanged: WorkerGate.outcome,
    frames.Ended: WorkerGate.ended,
    frames.Note: WorkerGate.note,
    frames.Record: WorkerGate.of_own,
    frames.Migrate: WorkerGate.of_own,
    frames.Command: WorkerGate.command,
}
"""What has no row (`Launch`, `TellRun`) only the root sends. `Forget` is the connection's own."""

COMMANDS: Final[dict[str, Callable[[WorkerGate, str, frames.Command], None]]] = {
    "readdressed": _knows,
    "subscribe": _topic,
    "unsubscribe": _topic,
    "born": _born,
    "gone": _gone,
    "undone": _below,
    "waits": _own,
    "name": _named,
    "keep": _keep,
    "stop": _order,
    "kill": _order,
    "faulted": _order,
    "hangs": _order,
    "exit": _tie("source", both=True),
    "down": _tie("source", both=True),
    "monitor": _tie("watcher", both=False),
    "demonitor": _tie("watcher", both=False),
    "link": _tie("peer", both=True),
    "unlink": _tie("peer", both=True),
}
