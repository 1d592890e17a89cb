"""The node: an OS process that hosts actors. It owns the run loop, the tree of cells, and what they share."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import random
import string
import sys
import time
import weakref
from collections import Counter
from collections.abc import Awaitable, Callable
from time import monotonic
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar, runtime_checkable

from ..errors import (
    ActorStopped,
    HoldfastError,
    NameTaken,
    NoSuchActor,
    SpecError,
    StartFailed,
    UnknownMessage,
    WrongActor,
    can_be_written,
    shown,
    type_name,
)
from ..events import REFUSED, DeadLetter, Event, EventHub, SupervisorGaveUp
from ..exit_reasons import ExitReason
from ..persistence import Keeper, NothingKept
from ..values.path_parts import check_beside, check_path_part
from . import lifecycle
from .actor import Actor, Start
from .blocking_handlers import HandlerThreads
from .cell import DOWN, GONE, RUNNING, Cell, CellKinds, GivenName, Host, Scope
from .codec import Codec
from .deadlines import Deadlines
from .envelope import Item
from .lifecycle import LOCAL
from .links import MADE_UP_NAME
from .loop import RunLoop
from .mailbox import Bound, Bounded, admit_bounded, admit_gone
from .topics import Topics

if TYPE_CHECKING:
    from ..deadline_thread import Overdue
    from .address_host import AddressHost
    from .ref import ActorRef, Target

A = TypeVar("A", bound="Actor")
NoRoom = Literal["mailbox", "journal", "children"]
"""What is full that has no room for a message, or for a child."""

SAME_CLOCK = 60.0
"""Seconds by which a loop's clock may be behind the monotonic one that it reads; the clock of a test is elsewhere."""


class KeptByAddress(Protocol):
    """What belongs to an address, whoever lives there."""

    def given_up(self, error: ActorStopped) -> None:
        """The address is gone for good: whoever waits for something there hears of it."""
        ...


def begin_with(cell: Cell, start: Start[Any]) -> None:
    """The next lives at `cell` begin with `start`; what its supervisor knows of it is the composition root's."""
    cell.extra().start = start


async def in_no_process(function: Callable[..., object], *args: object) -> object:
    """Refuse to run a function in a process, where nobody has said how."""
    raise HoldfastError("this node has no processes for effects")


@dataclasses.dataclass(frozen=True, slots=True)
class Ports:
    """What a node asks of those around it; the composition root connects it once. By itself it answers like this."""

    here: AddressHost = LOCAL
    """How lives in this very process are lived."""
    host_for: Callable[[Any], AddressHost] = lambda spec: LOCAL
    """Chooses how a child's lives are lived."""
    complete: Callable[[Any, str], Any] = lambda spec, path: spec
    """Adds what else is known of a child spec."""
    respec: Callable[[Cell, Start[Any]], None] = begin_with
    """Has an actor's next lives begin with this."""
    outside: Callable[[str], Cell | None] = lambda path: None
    """Finds cells of other processes."""
    keeper: Keeper = dataclasses.field(default_factory=NothingKept)
    uplink: Any = None
    """In an actor process: the guest, through which the root is reached."""
    overdue: Overdue | None = None
    """In an actor process: who ends it when it is blocked."""
    run_in_process: Callable[..., Awaitable[object]] = in_no_process
    """Runs a function with its arguments in a process of its own."""


def check_sought(path: object, kind: object) -> None:
    """Whether this is an address, and the class of who is to live there. Raises SpecError."""
    is_address = isinstance(path, str) and can_be_written(path)
    if not is_address or not isinstance(kind, type) or not issubclass(kind, Actor):
        raise SpecError("find", f"takes an address and the class of an actor, not {shown(path)} and {shown(kind)}")


class Supervised:
    """What the supervisors of a node have said of themselves.

    Attributes:
        gave_up: the last one here that did.
        crashed: the last one here that did because of a crash: those above it give up because it has ended.
        waiting: those with children that have waited for somebody to whom they are bound; perhaps none waits any more.
    """

    __slots__ = ("crashed", "gave_up", "waiting")

    def __init__(self) -> None:
        self.gave_up: SupervisorGaveUp | None = None
        self.crashed: SupervisorGaveUp | None = None
        self.waiting = weakref.WeakSet[Cell]()


def _since_boot() -> float:
    """Seconds since the machine was started, also those in which it has slept, where the system counts them."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if sys.platform == "linux" else monotonic()


@runtime_checkable
class TellsUnixTime(Protocol):
    """An event loop with a clock of its own, from which all nodes on it have their Unix time."""

    def unix_time(self) -> float:
        """Seconds since 1970, which pass with the loop's."""
        ...


class Clock:
    """The times that a node goes by."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        begin, has_own = time.time() - loop.time(), isinstance(loop, TellsUnixTime)
        self.machine: Callable[[], float] = loop.time if has_own else monotonic
        """Seconds on the clock that all processes of the system read."""
        self.is_monotonic = not has_own and abs(monotonic() - loop.time()) < SAME_CLOCK  # the loop has the machine's
        self._is_machines = self.is_monotonic or has_own  # deadlines of the loop are on the clock that all read
        self.wall: Callable[[], float] = lambda: begin + loop.time()
        if isinstance(loop, TellsUnixTime):
            self.wall = loop.unix_time
        elif self.is_monotonic:
            self.wall = time.time
        self.passed: Callable[[], float] = _since_boot if self.is_monotonic else loop.time
        """Seconds that have passed since some moment: nobody sets this clock."""

    def is_past(self, deadline: float) -> bool:
        """Whether a deadline is over that was set in this process or another one of the system.

        A loop's own time may be some milliseconds late, so the root's may have told of the end already.
        """
        return deadline <= (monotonic() if self.is_monotonic else self._loop.time())

    def on_machine(self, deadline: float) -> float:
        """A deadline of the loop's, on the clock that all processes of the machine read."""
        return deadline if self._is_machines else monotonic() + deadline - self._loop.time()


TOKENS = 1 << 16
"""Fencing tokens that the actors of one process may use up; they keep the last one then."""

DIGITS = string.digits + string.ascii_lowercase


def written(number: int) -> str:
    """A number as few digits and letters; of equally many, the larger number sorts later.

    >>> written(35), written(36)
    ('z', '10')
    """
    head, last = divmod(number, len(DIGITS))
    return (written(head) if head else "") + DIGITS[last]


class Numbers:
    """What a node counts, and the numbers that it gives out."""

    def __init__(self, seed: int | None) -> None:
        self._seeds = random.Random(seed)
        self._names = itertools.count(1)
        self._turns = itertools.count(1)
        self._token, self._last_token = 0, sys.maxsize
        self._mark = ""
        self.dead_letters = 0
        self.late_replies = 0
        self.no_room: Counter[tuple[NoRoom, type[Actor] | None]] = Counter()

    def next_seed(self) -> int:
        """A seed for an actor's random generator."""
        return self._seeds.getrandbits(64)

    def next_name(self, beginning: str = MADE_UP_NAME) -> str:
        """A name for an actor that was given none; nobody has it again, in any process or later program."""
        return f"{beginning}{self._mark}-{next(self._names)}"

    def next_turn(self) -> int:
        """A number for a turn that asks."""
        return next(self._turns)

    def next_token(self) -> int:
        """A fencing token: larger than all that were given out before, unless a process has used up its own."""
        self._token = min(self._token + 1, self._last_token)
        return self._token

    def tokens_for_process(self) -> int:
        """Put fencing tokens aside for the actors of a process; returns the one before the first of them."""
        self._token += 2 * TOKENS  # Those that are left out keep its mark apart from that of its parent.
        return self._token - TOKENS

    def begin_tokens(self, before: int, last: int = sys.maxsize) -> None:
        """Give out the fencing tokens that follow this one, up to the last one; made-up names bear a mark of it."""
        self._token, self._last_token = before, last
        self._mark = written(before // TOKENS)


class Node(RunLoop):
    """One process's actors. All of a node runs on one event loop, in one thread."""

    def __init__(
        self,
        name: str,
        loop: asyncio.AbstractEventLoop,
        *,
        seed: int | None = None,
        topics: Topics | None = None,
    ) -> None:
        super().__init__(loop)
        check_path_part("ActorSystem", "the name", name)
        self.name = name
        self.cell_kinds = CellKinds()
        self.deadlines = Deadlines(loop)
        self.codec = Codec(self.cell_at)
        self.clock = Clock(loop)
        self.events = EventHub()
        self.numbers = Numbers(seed)
        self.ports = Ports()
        self.topics = topics or Topics()
        self.threads = HandlerThreads()
        self.names: dict[str, Cell] = {}
        self.kept: weakref.WeakKeyDictionary[Cell, KeptByAddress] = (
            weakref.WeakKeyDictionary()
        )  # outlives an actor's lives
        self.remains: dict[asyncio.Future[Any], str] = {}  # what killed lives have left and is still ending: address
        self.safe: dict[str, asyncio.TimerHandle] = {}  # who is in safe state here: when that should be over
        self.on_rebound = unnoticed  # where the binding of an actor led may be met again in a replay
        self.supervised = Supervised()
        self.root: Cell | None = None
        self.arbiter: Any = None  # who may act on which address, once somebody has asked for it
        self.awaited: dict[str, list[Callable[[], object]]] = {}  # what is done when somebody lives at a path again
        self.on_life: Callable[[Cell], None] | None = None  # told of each life that begins, before it has a message

    def connect(self, ports: Ports) -> None:
        """Give the node what it asks of those around it, before its first actor."""
        self.ports = ports

    def end_after(self, work: asyncio.Future[Any], address: str) -> None:
        """An address is given up, or its life is over, and this work for it is not: the system ends behind it."""
        self.remains[work] = address
        work.add_done_callback(lambda done: self.remains.pop(done, None))

    def begin_limit(self, what: str, seconds: float) -> Callable[[], None]:
        """Somebody keeps a time limit by a timer here; what is returned is called when it is void.

        In an actor process that has a thread of its own blocked beyond it ends; see `deadline_thread.py`.
        """
        overdue = self.ports.overdue
        return overdue.begin(what, seconds) if overdue is not None else _void

    async def close(self) -> None:
        """End every runner, and what still waits for its time."""
        for timer in self.safe.values():
            timer.cancel()
        self.safe.clear()
        self.threads.close()
        await super().close()

    # -- events -----------------------------------------------------------------------------------------------------

    def emit(self, event: Event) -> None:
        """Put an event on the stream."""
        self.events.emit(event)

    def dead_letter(self, cell: Cell, message: object, why: str, sender: Cell | None = None) -> None:
        """A message that nobody handles: counted, and told to who looks, opened if it came packed."""
        self.numbers.dead_letters += 1
        if self.events.hears_letters:
            known = "" if sender is None else sender.path
            self.events.emit(DeadLetter(cell.path, self.codec.opened(cell, message), why, known))

    def not_taken(self, cell: Cell, message: object, error: HoldfastError, sender: Cell | None = None) -> None:
        """A subscriber could not take what was published, by `sender` if that was an actor.

        One that has ended meanwhile is no subscriber any more, and one that has no handler for it wants other messages.
        """
        if not isinstance(error, (ActorStopped, UnknownMessage)):
            self.dead_letter(cell, message, str(error), sender)

    def refused(self, cell: Cell, item: Any, no: HoldfastError) -> None:
        """A tell was answered with a Refusal, or was no valid order: there is nobody to hand that to."""
        if self.events.hears_letters:
            known = item.sender.path if isinstance(item, Item) and item.sender is not None else ""
            self.events.emit(DeadLetter(cell.path, item, f"{REFUSED}{no}", known))

    def count_no_room(self, path: str, where: NoRoom = "mailbox") -> None:
        """Count a message that an actor had no room for, and that is refused or lost."""
        cell = self.find(path)
        self.numbers.no_room[where, None if cell is None else cell_kind(cell)] += 1

    # -- the tree ---------------------------------------------------------------------------------------------------

    def cell_below(self, parent: Cell | None, name: str | None, host: Host | None = None) -> Cell:
        """A new cell in the tree.

        Raises:
            NameTaken: there is one of that name.
        """
        if name is None:
            name = self.numbers.next_name()
        elif parent is not None:
            check_path_part(parent.path, "the name of an actor below it", name)
        cell = Cell(self, parent, name, self.ports.here if host is None else host)
        if parent is not None:
            if parent.children is None:
                parent.children = {}
            elif name in parent.children:
                raise NameTaken(f"{parent.path}/{name}")
            parent.children[name] = cell
        if self.awaited:
            for come in self.awaited.pop(cell.path, ()):
                come()
        return cell

    def spawn(
        self, start: Start[Any], name: str | None = None, *, parent: Cell | None = None, mailbox: Bounded | None = None
    ) -> Cell:
        """Start an actor in this process that nobody restarts. It is up when this returns, but for its `on_start`."""
        if not isinstance(start, Start):
            raise SpecError("spawn", f"takes start(Class, ...), not {shown(start)}")
        cell = self.cell_below(parent if parent is not None else self.root, name)
        if mailbox is not None:
            self.bound(cell, mailbox)
        try:
            lifecycle.begin(cell, start)
        except BaseException:
            lifecycle.retire(cell, "it could not be started")
            raise
        return cell

    def bound(self, cell: Cell, choice: Bounded) -> None:
        """Give a cell without messages a bounded mailbox."""
        cell.extra().bound = Bound(choice.capacity, choice.overflow)
        cell.admit = admit_bounded

    async def stop_child(self, cell: Cell) -> ExitReason:
        """Stop a child in good order, as its parent ends: by its spec, if it has one."""
        if cell.state is DOWN or cell.state is GONE:
            lifecycle.retire_with_parent(cell)
            return cell.extra().reason
        parent = cell.parent
        reason: ExitReason = await (lifecycle.stop_in_time(cell) if cell.spec is None else cell.spec.stop(cell))
        if cell.parent is parent:  # Else it has another one now, and lives on.
            lifecycle.retire_with_parent(cell)
        return reason

    def find(self, path: str) -> Cell | None:
        """The cell at an address, here or (through `outside`) in another process."""
        root = self.root
        if root is not None and (path == root.path or path.startswith(root.path + "/")):
            cell: Cell | None = root
            for name in path[len(root.path) :].split("/")[1:]:
                cell = cell.children.get(name) if cell is not None and cell.children else None
                if cell is None:
                    break
            if cell is not None:
                return cell
        return self.ports.outside(path)

    def cell_at(self, path: str) -> Cell:
        """The cell at an address; if there is none, a stand-in whose messages are dead letters."""
        return self.find(path) or self.nowhere(path)

    def ref_at(self, path: str) -> ActorRef[Any]:
        """A ref to an address, whoever lives there, now or later."""
        return self.cell_at(path).ref

    def nowhere(self, path: str) -> Cell:
        """A stand-in for an address where nobody lives; somebody may come to live there."""
        cell = Cell(self, None, path, LOCAL)
        cell.state, cell.admit = GONE, admit_gone
        return cell

    def successor(self, cell: Cell) -> Cell | None:
        """The living cell at the address of a dead one."""
        found = self.find(cell.path)
        return None if found is None or found.state is GONE else found

    def find_ref(self, path: str, kind: type[A]) -> ActorRef[A]:
        """A ref to the actor at `path`.

        Raises:
            NoSuchActor: nobody lives there. WrongActor: another class does.
        """
        from .ref import ActorRef

        check_sought(path, kind)
        cell = self.find(path)
        if cell is None or cell.is_dead:
            raise NoSuchActor(path)
        found = cell_kind(cell)
        if found is not None and not issubclass(found, kind):
            raise WrongActor(path, type_name(kind), type_name(found))
        return ActorRef(cell)

    def meant(self, target: Target) -> Cell:
        """The cell that a ref or an address leads to. Raises NoSuchActor: nobody lives at the address."""
        from .ref import ActorRef

        if isinstance(target, ActorRef):
            return target._cell.living
        if not isinstance(target, str):
            raise SpecError(shown(target), "is neither a ref nor an address")
        cell = self.find(target)
        if cell is None or cell.is_dead:
            raise NoSuchActor(target)
        return cell

    def register(self, name: str, cell: Cell, *, is_starting: bool = False, scope: Scope | None = None) -> None:
        """Give an actor a name beside its path; it is free again before anybody hears of the actor's end.

        Args:
            name: the name.
            cell: the actor.
            is_starting: a life of it is about to begin, and has the name from its very start.
            scope: who finds it by the name; left out, who finds it so far, and for a new name this system.

        Raises:
            NameTaken: another living actor has it. SpecError: it is empty, or has control characters.
        """
        check_beside(cell.path, name)
        holder = self.names.get(name)
        if holder is cell:
            if scope is not None:
                cell.extra().belongings.names[name] = scope
            return
        if holder is not None:
            raise NameTaken(name)
        if cell.state is not RUNNING and not is_starting:
            raise ActorStopped(cell.path)
        self.names[name] = cell
        cell.extra().belongings.names[name] = scope or "system"

    def name_life(self, cell: Cell, name: GivenName) -> None:
        """Give a life that is about to begin the name that its spec says.

        Raises:
            StartFailed: another living actor has it. SpecError: it is empty, or has control characters.
        """
        try:
            self.register(name.text, cell, is_starting=True, scope=name.scope)
        except NameTaken as taken:
            holder = self.names[name.text].path
            why = f"{holder} is registered as {name.text!r} already; free the name, or say another one"
            raise StartFailed(cell.path, why) from taken

    def unregister(self, name: str) -> None:
        """Free a name; unknown ones are fine."""
        cell = self.names.pop(name, None)
        if cell is not None:
            cell.extra().belongings.names.pop(name, None)

    def shown(self, name: str) -> Cell:
        """The actor that other systems find by a name.

        Raises:
            NoSuchActor: nobody has it, or it is for this system alone.
        """
        cell = self.names.get(name)
        if cell is None or cell.extra().belongings.names.get(name) != "fleet":
            raise NoSuchActor(name)
        return cell

    def bind(self, cell: Cell, port: str, target: Cell, *, is_claimed: bool = False) -> None:
        """Point a binding elsewhere; the owner sees it from its next turn on.

        Args:
            cell: the owner.
            port: the name of the binding.
            target: where it leads from then on.
            is_claimed: it is only the word of the owner's process that it leads there, and grants nothing.

        Raises:
            SpecError: the class has no such binding.
        """
        kind = cell_kind(cell)
        if not isinstance(port, str) or (kind is not None and port not in kind._bindings):
            kind = Actor if kind is None else kind
            known = ", ".join(sorted(kind._bindings)) or "none"
            raise SpecError(cell.path, f"{type_name(kind)} has no binding {shown(port)} (it has: {known})")
        more = cell.extra()
        more.claimed = more.claimed | {port} if is_claimed else more.claimed - {port}
        if more.turn is None:
            more.bindings[port] = target
        else:  # One turn sees one target, also if it waits meanwhile.
            more.turn.rebinds = {**(more.turn.rebinds or {}), port: target}
        self.on_rebound(cell, port, target.path)
        cell.host.told(cell, "bind", {"port": port, "target": target.path, "is_claimed": is_claimed})

    def tell_binding(self, cell: Cell, port: str) -> None:
        """Tell whoever lives the life at a cell that the target of a binding has another address."""
        more = cell.extra()
        target = more.bindings[port]
        self.on_rebound(cell, port, target.path)
        cell.host.told(cell, "bind", {"port": port, "target": target.path, "is_claimed": port in more.claimed})


def unnoticed(cell: Cell, port: str, target: str) -> None:
    """Nobody keeps where bindings lead."""


def _void() -> None:
    """Do nothing: this process keeps no time limits by a thread."""


def cell_kind(cell: Cell) -> type[Actor] | None:
    """The actor class that lives at a cell, as far as it is known here."""
    if cell.actor is not None:
        return type(cell.actor)
    start = cell.more.start if cell.more is not None else None
    return None if start is None else start.kind
