"""The cell: one address's place in this process. Its mailbox outlives every life at the address."""

from __future__ import annotations

import asyncio
import contextvars
import dataclasses
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias, cast, get_args

from ..errors import ActorStopped, UnknownMessage, type_name
from ..exit_reasons import KILLED, SHUTDOWN, ExitReason
from ..ordered import Ordered
from . import mailbox
from .envelope import AnyTable, Ask, Item, Table
from .links import Ties
from .message import Message, RuntimeOrder, require_message
from .ref import ActorRef

if TYPE_CHECKING:
    from ..control.tracing import TurnTap
    from ..effects import FailedAttempt
    from ..errors import StartFailed
    from .actor import Actor, Start
    from .address_host import Capacity, Home, Parent, Place, QueuedOrder, Work
    from .context import ActorContext
    from .loop import Suspended
    from .mailbox import Bound
    from .node import Node

Admit = Callable[["Cell", Any], None]

# What a cell may be in. Only a running cell is ever on the run queue for user messages.
DOWN = "down"  # between two lives, or before the first: the queue is kept
RUNNING = "running"
ENDING = "ending"  # hooks and children are being wound down
GONE = "gone"  # for good: the address is free

ANY = AnyTable()


class Host(Protocol):
    """Where and how the lives at an address are lived, as the address asks for it (`address_host.py`)."""

    @property
    def home(self) -> Home:
        """What is accepted at the address."""
        ...

    @property
    def place(self) -> Place:
        """The place where the turns of the actor run."""
        ...

    @property
    def parent(self) -> Parent:
        """The cell of the actor's supervisor."""
        ...

    @property
    def takes_parcels(self) -> bool:
        """Whether messages that came encoded are passed on as they are."""
        ...

    def start(self, cell: Cell) -> asyncio.Future[None] | None:
        """Begin a life. None: it is up already. Raises, or fails the future, with StartFailed."""
        ...

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        """Ask the life to end in good order."""
        ...

    def kill(self, cell: Cell) -> None:
        """End the life at once."""
        ...

    def handed_to(self, parent: Parent) -> None:
        """Have another supervisor decide what follows from the ends of lives."""
        ...

    def retired(self, cell: Cell) -> None:
        """The address is gone for good; called before its queue is drained."""
        ...

    def push(self, cell: Cell, item: Item) -> None:
        """Put an item of the runtime's own in its place behind the messages."""
        ...

    def progress(self, cell: Cell) -> object:
        """How far the start that is under way has come: it is another value when it has come further, and while it
        waits for somebody else. None: it has no steps."""
        ...

    def recovers(self, reason: ExitReason) -> bool:
        """Whether a life that ended for this reason is brought back with its state."""
        ...

    def offer(self, cell: Cell, item: Any) -> Awaitable[None] | None:
        """Admit a message for a sender that waits until it is accepted. None: it is."""
        ...

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        """Have an order carried out between two turns of the actor, ahead of all messages."""
        ...

    def is_up(self, cell: Cell) -> bool:
        """Whether a life takes messages now: it has started, and is not being recovered."""
        ...

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        """Whether the turn of an ask may have begun whose deadline is over, and which was handed on with a number."""
        ...

    def withdraw(self, cell: Cell, ask: Ask, then: Callable[[bool], None]) -> None:
        """See to it that such an ask, which has not begun, never does; `then` hears, soon, whether that is sure."""
        ...

    def holds_back(self, cell: Cell) -> str:
        """Why replies of turns that have ended do not leave now; "" if nothing keeps them."""
        ...

    def backlog(self, cell: Cell) -> int:
        """Messages that wait, as far as is known in this process."""
        ...

    def load(self, cell: Cell) -> int:
        """Messages that wait and those in hand, as far as is known in this process; cheap, for it may be a guess."""
        ...

    def work(self, cell: Cell) -> Work:
        """What the actor is at, as far as is known in this process."""
        ...

    def rests(self, cell: Cell) -> list[TurnRest]:
        """What the turn in hand waits for that is no other actor's work, as far as is known in this process."""
        ...

    def awaits(self, cell: Cell) -> str:
        """The address of the actor for whose reply alone the turn in hand waits; "" if there is none that is known."""
        ...

    def ask_turns(self, cell: Cell) -> None:
        """Have its process tell of its turns, for the next `work`, `rests` and `awaits`; nothing where all is known."""
        ...

    def mailbox(self, cell: Cell) -> Capacity | None:
        """How full the mailbox is; None if it takes any number of messages."""
        ...

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """A link or monitor at this cell was made or removed: its actor's own process has to know."""
        ...


Order: TypeAlias = Literal["stop", "kill"]
"""What an actor can do to the life of another one, by way of a ref."""
ORDERS = frozenset(get_args(Order))

Scope: TypeAlias = Literal["system", "fleet"]
"""Who finds an actor by a name: the system that it is of, or other systems and clients that are connected, too."""


@dataclasses.dataclass(frozen=True, slots=True)
class GivenName:
    """The name that the spec of a child gives to each of its lives, beside the address, and who finds it by that."""

    text: str
    scope: Scope = "system"


class TurnRest(NamedTuple):
    """What a turn waits for that is no other actor's work: a moment, an effect that is out, or a message.

    Attributes:
        kind: "sleep", "effect" or "wait", as the methods of `ctx` are called.
        name: of an effect its key, of a wait the classes of messages; "" for a sleep.
        since: when it began, in Unix time.
        until: when it ends at the latest, in Unix time; None: that is not known.
        failed: of an effect, how many attempts have failed.
        attempts: how many there may be.
        error: what the last one has raised, in a line.
        again: when the next one begins, or has begun, in Unix time.
        is_again: of an effect, that it was out in an earlier program, too; `since` is when this one has begun it.
    """

    kind: Literal["sleep", "effect", "wait"]
    name: str
    since: float
    until: float | None = None
    failed: int = 0
    attempts: int = 0
    error: str = ""
    again: float = 0.0
    is_again: bool = False

    def after(self, failed: FailedAttempt, now: float) -> TurnRest:
        """The same, when an attempt of the effect has failed at this moment, in Unix time."""
        return self._replace(failed=failed.number, attempts=failed.most, error=failed.error, again=now + failed.seconds)

    def said(self, now: float) -> str:
        """It in words, behind whoever waits; `now` is Unix time.

        >>> TurnRest("effect", "charge", 10.0).said(12.0), TurnRest("wait", "shop:Call", 10.0).said(12.0)
        ('waits for the effect charge, which has been out for 2.0 s', 'has waited for 2.0 s for shop:Call')
        """
        seconds = now - self.since
        if self.kind == "effect":
            out = "was out before, and has been out again" if self.is_again else "has been out"
            return f"waits for the effect {self.name}, which {out} for {seconds:.1f} s{self._tried(now)}"
        if self.kind == "wait":
            said = f"has waited for {seconds:.1f} s for {self.name}"
            return said if self.until is None else f"{said}, until {_moment(self.until, now)} at the latest"
        said = f"has slept for {seconds:.1f} s"
        return said if self.until is None else f"{said}, and sleeps until {_moment(self.until, now)}"

    def _tried(self, now: float) -> str:
        """What is known of its attempts, in brackets; "" if none has failed.

        >>> rest = TurnRest("effect", "pay", 10.0, None, 6, 100, "OSError: no network", 15.0)
        >>> rest._tried(11.8)
        ' (attempt 6 of 100: OSError: no network; the next in 3.2 s)'
        >>> rest._tried(15.5)
        ' (attempt 7 of 100; the last: OSError: no network)'
        """
        if not self.failed:
            return ""
        if now < self.again:
            return f" (attempt {self.failed} of {self.attempts}: {self.error}; the next in {self.again - now:.1f} s)"
        return f" (attempt {self.failed + 1} of {self.attempts}; the last: {self.error})"


def _moment(at: float, now: float) -> str:
    """A moment as people say it: with the day, if that is not within the next hours."""
    form = "%H:%M:%S" if abs(at - now) < 12 * 3600.0 else "%Y-%m-%d %H:%M:%S"
    return f"{time.strftime(form, time.localtime(at))} ({max(0.0, at - now):.1f} s from now)"


class Looks:
    """What those who look from another process have seen of an actor's turns: what it had in hand at the last look."""

    __slots__ = ("count", "item")

    def __init__(self) -> None:
        self.count, self.item = 0, None

    def take(self, item: Any) -> int:
        """Note what is in hand now, or was last; returns at how many looks that was something new."""
        if item is not self.item:
            self.item, self.count = item, self.count + 1
        return self.count


class Belongings:
    """What a life has taken, and gives back at its end: background tasks, timers, subscriptions, names."""

    __slots__ = ("looks", "names", "rests", "tasks", "timers", "topics")

    def __init__(self) -> None:
        self.looks: Looks | None = None  # of those who look from another process, if anybody does
        self.names: dict[str, Scope] = {}
        self.tasks = Ordered[asyncio.Task[Any]]()
        self.rests: dict[asyncio.Task[Any], tuple[Any, TurnRest]] | None = None  # with the item in hand when it began
        self.timers = Ordered[Any]()
        self.topics = Ordered[str]()

    def take_look(self, item: Any) -> int:
        """Note what is in hand now, or was last, for who looks from another process; at how many looks it was new."""
        looks = self.looks = self.looks or Looks()
        return looks.take(item)


class More:
    """What only some cells have; made when first needed, so that an idle actor stays small.

    So is what is in `_MADE_LATER`: most supervised actors never have any of it.
    """

    __slots__ = (
        "belongings",
        "bindings",
        "bound",
        "calls",
        "claimed",
        "enders",
        "has_more",
        "last",
        "outlet",
        "reason",
        "start",
        "start_error",
        "starting",
        "stash",
        "suspended",
        "tap",
        "ties",
        "trap_exits",
        "turn",
        "urgent",
    )

    belongings: Belongings
    bindings: dict[str, Cell]
    calls: list[QueuedOrder]  # control that waits for the actor's process to be up
    ties: Ties

    def __init__(self) -> None:
        self.bound: Bound | None = None
        self.claimed: frozenset[str] = frozenset()  # ports of which only another process says where they lead
        self.enders: list[asyncio.Future[ExitReason]] | None = None
        self.has_more = False  # whether anything was made later
        self.last: Actor | None = None  # the actor of the ended life, if it wants what stays undelivered
        self.outlet: Any = None  # what messages go through: the way into another process, or the actor's home
        self.reason: ExitReason = SHUTDOWN
        self.start: Start[Any] | None = None
        self.start_error: StartFailed | None = None  # why `on_start` of this life failed; told when it has ended
        self.starting: asyncio.Future[None] | None = None  # whoever waits for `on_start` of this life waits for it
        self.stash: deque[Any] | None = None
        self.suspended = 0  # by whom, see `control/orders.py`
        self.tap: TurnTap | None = None  # whoever counts or follows what the actor does
        self.trap_exits = False
        self.turn: Suspended | None = None
        self.urgent: deque[Item] | None = None

    def __getattr__(self, name: str) -> Any:
        """Something is asked for the first time. (Python calls this for an empty slot only.)"""
        make = _MADE_LATER.get(name)
        if make is None:
            raise AttributeError(name)
        made = make()
        self.has_more = True
        setattr(self, name, made)
        return made


_MADE_LATER: dict[str, Callable[[], Any]] = {
    "belongings": Belongings,
    "bindings": dict,
    "calls": list,
    "ties": Ties,
}


class _Hot:
    """What every message touches: the slots of one class lie side by side, and memory is read in lines."""

    __slots__ = ("actor", "admit", "context", "item", "node", "queue", "scheduled", "table")

    actor: Actor | None
    admit: Admit
    context: contextvars.Context | None
    item: Any
    node: Node
    queue: deque[Any] | None
    scheduled: bool
    table: Table


class Cell(_Hot):
    """One address: its queue, the life that is lived there now, and its place in the tree."""

    __slots__ = ("__weakref__", "children", "ctx", "host", "life", "more", "name", "parent", "spec", "state")

    take_in: Admit
    """What senders call: the function in `admit`, by another name, before which a node may put one of its own."""

    def __init__(self, node: Node, parent: Cell | None, name: str, host: Host) -> None:
        cast("Any", self).__class__ = node.cell_kinds[type(self)]
        self.node = node
        self.parent = parent
        self.name = name
        self.host = host
        self.admit = mailbox.admit_first
        self.table = ANY
        self.queue = None
        self.item = None  # what is being handled, or was last
        self.scheduled = True  # Nothing runs before the first life begins: messages wait in the queue.
        self.state = DOWN
        self.life = 0
        self.actor = None
        self.ctx: ActorContext | None = None
        self.context = None
        self.children: dict[str, Cell] | None = None
        self.more: More | None = None
        self.spec: Any = None  # the supervisor's child spec; None: nobody restarts this actor

    @property
    def path(self) -> str:
        """The address in full, from the root down; without a name of its own it is that of the cell above it."""
        parent = self.parent
        if parent is None:
            return self.name
        return f"{parent.path}/{self.name}" if self.name else parent.path

    @property
    def ref(self) -> ActorRef[Any]:
        """A handle on this address."""
        return ActorRef(self)

    @property
    def is_dead(self) -> bool:
        """Nobody lives here and nobody will be restarted here."""
        return self.state is GONE or (self.state is DOWN and self.spec is None)

    def goes_on(self, reason: ExitReason) -> bool:
        """Whether the life that ends here for this reason is followed by one that goes on where it was, by a recovery.

        Who is linked with the one is linked with the other then, and hears of no end.
        """
        return self.spec is not None and self.host.recovers(reason) and self.spec.restarts(reason)

    @property
    def has_nobody(self) -> bool:
        """Nobody lives here now, and whoever will is not the one who did: there is nobody to be linked with.

        Before the first life begins there is somebody: the one who is being started.
        """
        if self.state is not DOWN or self.actor is not None:  # With an actor: its `__init__` runs.
            return self.is_dead
        return self.spec is None or (self.life > 0 and not self.goes_on(self._last_reason))

    @property
    def awaits_first_life(self) -> bool:
        """Nobody has ever lived here; one who is read back from a store has lived before."""
        return self.state is DOWN and self.life == 0 and self.actor is None and not self.host.recovers(KILLED)

    @property
    def _last_reason(self) -> ExitReason:
        return self.more.reason if self.more is not None else SHUTDOWN

    @property
    def coming_life(self) -> int:
        """The number of the life that is lived here, or between two lives that of the next one."""
        return self.life + (self.state is DOWN)

    @property
    def living(self) -> Cell:
        """Who lives at this address: this one, or who has followed it there when it had ended; itself if nobody has."""
        return self if self.state is not GONE else self.node.successor(self) or self

    def extra(self) -> More:
        """The rarely needed part, made now if it was not."""
        if self.more is None:
            self.more = More()
        return self.more

    # -- sending to this address ------------------------------------------------------------------------------------

    def require(self, message: Message[Any]) -> None:
        """Refuse what no handler is there for.

        Raises:
            UnknownMessage: the class is known and handles nothing of this type. BadMessage: this is no message.
            NotGranted: it is an order, and this process may give none there.
        """
        if isinstance(message, RuntimeOrder) and (uplink := self.node.ports.uplink) is not None:
            uplink.require_granted(self.path, type_name(type(message)))
        if not self.table.knows(type(message)):
            require_message(self.path, message)
            name = type_name(type(message))
            raise UnknownMessage(self.path, name, any(type_name(known) == name for known in self.table))

    def outgoing(self, item: Any) -> Any:
        """What is sent to this address in place of a message or an envelope: that itself, unless the node is traced."""
        return item

    def offer(self, item: Any) -> Awaitable[None] | None:
        """Admit a message for a sender that waits until it is accepted. None: it is."""
        return self.host.offer(self, self.outgoing(item))

    def push(self, item: Item) -> None:
        """Put an item of the runtime's own at the end of the queue: no bound, no type check."""
        if self.state is GONE:
            item.undelivered(self, "stopped")
        else:
            self.host.push(self, item)

    def urge(self, item: Item) -> None:
        """Put a command ahead of all messages; commands keep their order among themselves.

        Between two turns only: what is left to do after a turn that was killed or raised comes first.
        """
        if self.state is GONE:
            item.undelivered(self, "stopped")
            return
        more = self.extra()
        if more.urgent is None:
            more.urgent = deque()
        more.urgent.append(item)
        queue = mailbox.queue_of(self)
        front = queue[0] if queue else None
        if isinstance(front, Item) and front.ends_turn:
            queue[0] = NEXT_URGENT
            queue.appendleft(front)
        else:
            queue.appendleft(NEXT_URGENT)
        self.schedule()

    def schedule(self) -> None:
        """See to it that the run loop looks at the queue."""
        if not self.scheduled:
            self.scheduled = True
            self.node.make_ready(self)

    @property
    def has_room(self) -> bool:
        """Whether a message would be taken now, wherever and however the actor lives; nobody begins to wait.

        Only a mailbox whose policy is to wait, a journal at its limit and a process that does not keep up say no.
        """
        more = self.more
        if more is None:
            return True
        if more.outlet is not None and not more.outlet.has_room:
            return False
        return more.bound is None or more.bound.has_room(self)

    def room(self) -> asyncio.Future[None] | None:
        """None when a message would be taken now; else a future that ends when it is worth trying again.

        Raises:
            ActorStopped: the address has ended for good.
        """
        if self.state is GONE:
            successor = self.node.successor(self)
            if successor is None:
                raise ActorStopped(self.path)
            return successor.room()
        more = self.more
        if more is None:
            return None
        if self.admit is mailbox.admit_closing and not mailbox.is_of_its_own(self):
            raise ActorStopped(self.path, "it is stopping")
        if more.outlet is not None and (wait := more.outlet.room()) is not None:
            return wait  # type: ignore[no-any-return]
        return more.bound.room(self) if more.bound is not None else None

    # -- life cycle, asked for from outside -------------------------------------------------------------------------

    def request_stop(self, reason: ExitReason = SHUTDOWN) -> None:
        """Ask for an end in good order; on a cell that is down or ending it changes nothing."""
        self.host.stop(self, reason)

    def kill(self, *, by: str | None = None) -> None:
        """End the life at once, without hooks. `by`: no supervisor has ordered that, but this actor ("": nobody's)."""
        if by is not None:
            self.host.home.faulted(self, by)
        self.host.kill(self)

    def obey(self, order: Order, by: str) -> None:
        """Stop or kill whoever lives at the address now. `by`: the actor that has ordered it; "" if that was none."""
        if order == "stop":
            self.living.request_stop()
        else:
            self.living.kill(by=by)

    def require_order(self, order: Order) -> None:
        """Raises NotGranted: from this process nobody may give such an order to whoever lives here."""
        self.host.place.require_order(self, order)

    def ended(self) -> asyncio.Future[ExitReason]:
        """A future of the reason with which the present life ends; done already when there is none."""
        future: asyncio.Future[ExitReason] = self.node.loop.create_future()
        if self.state in (DOWN, GONE):
            future.set_result(self._last_reason)
        else:
            more = self.extra()
            if more.enders is None:
                more.enders = []
            more.enders.append(future)
        return future

    # -- the fate of what is left -----------------------------------------------------------------------------------

    def stopped_error(self, reason: str) -> ActorStopped:
        """What an asker gets whose message was never run."""
        return ActorStopped(self.path, reason)

    def undelivered(self, message: Message[Any], reason: str, sender: Cell | None = None) -> None:
        """A message that will not be handled: offered to `on_undelivered`, else a dead letter."""
        last = self.more.last if self.more is not None else None
        if last is None:
            self.node.dead_letter(self, message, reason, sender)
            return
        try:
            last.on_undelivered(message)
        except BaseException as error:
            why = f"{reason}; on_undelivered raised {type_name(type(error))}: {error}"
            self.node.dead_letter(self, message, why, sender)

    def __repr__(self) -> str:
        return f"<Cell {self.path} {self.state} life {self.life}>"


Cell.take_in = vars(_Hot)["admit"]  # The same slot, so that it is read as fast.


class CellKinds(dict[type[Cell], type[Cell]]):
    """The classes of the cells of one node, each derived from the one that it stands for.

    What is put into them is passed by all that is sent from this node, and from no other one of the process. They have
    nothing of their own while nobody looks, so that nothing is tested for then.

    Attributes:
        watcher: who has put something in; None if nobody has.
    """

    def __init__(self) -> None:
        super().__init__()
        self.watcher: Any = None
        self._methods: dict[str, Callable[..., Any]] = {}

    def __missing__(self, kind: type[Cell]) -> type[Cell]:
        made = type(kind.__name__, (kind,), {"__slots__": (), "__module__": kind.__module__, **self._methods})
        self[kind] = made
        return made

    def put_in(self, watcher: Any, methods: dict[str, Callable[..., Any]]) -> None:
        """Put methods before those of the cells, in the place of what was put in before."""
        self.take_out()
        self.watcher, self._methods = watcher, methods
        for kind in self.values():
            for name, method in methods.items():
                setattr(kind, name, method)

    def take_out(self) -> None:
        """Take out what was put in: it costs nothing from then on."""
        for kind in self.values():
            for name in self._methods:
                delattr(kind, name)
        self.watcher, self._methods = None, {}


class _NextUrgent(Item):
    """Stands at the front of a queue for the next command in `more.urgent`."""

    __slots__ = ()
    is_command = True

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        more: More | None = actor.ctx._cell.more
        if more is None or not more.urgent:
            return None
        command = more.urgent.popleft()
        return command.run(actor, command)


NEXT_URGENT = _NextUrgent()
