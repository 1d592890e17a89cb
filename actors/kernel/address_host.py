"""The host of an address: its home (what it has accepted), its place (where turns run), and its parent.

A home outlives every life at its address, and a place can be exchanged for another while the actor works. Any home
that hands its messages over goes with any place that takes them, so a new home is one class, and so is a new place.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from ..errors import StartFailed
from ..events import ActorKilled
from .cell import GONE, RUNNING, TurnRest
from .envelope import Ask, Item

if TYPE_CHECKING:
    from ..control.orders_lane import QueuedOrder as QueuedOrder
    from ..exit_reasons import ExitReason
    from ..overflow import Overflow
    from .actor import Actor, Start
    from .cell import Cell, GivenName, Order


class Work(NamedTuple):
    """What an actor is at, as far as its home knows: read by those who observe it, and never in its turns.

    Attributes:
        mark: what it has in hand, or had last; another object there means that it has got on.
        is_in_turn: it has something in hand.
        since: when it began to wait in that turn, on the loop clock; None if that is not known.
        has_answered: what it has in hand, or had last, is an ask, and whoever made that has an answer.
        own_turns: times its process was seen to have got on, by turns that the home knows nothing of, too (of timers,
            say); it is as new as the last answer to `Home.ask_turns`.
        newest: the ask that `has_answered` is about, if that is known as such.
        begun: by when that turn had begun, in Unix time and in whichever life; None if nothing says so.
    """

    mark: object = None
    is_in_turn: bool = False
    since: float | None = None
    has_answered: bool = False
    own_turns: int = 0
    newest: object = None
    begun: float | None = None


class Capacity(Protocol):
    """A mailbox that takes so many messages, wherever it is kept."""

    overflow: Overflow
    capacity: int

    @property
    def count(self) -> int:
        """Messages that wait for their turn."""
        ...


class Home:
    """What is accepted at an address, and in which order."""

    takes_parcels: bool
    """Whether messages that came encoded are passed on as they are."""

    @property
    def keeps_turns(self) -> bool:
        """Whether the next life knows all that the last one has handled, and goes on with the turn in hand."""
        return False

    def goes_on_with(self, key: int) -> bool:
        """Whether the next life goes on with the turn of this recorded input, which the last one had in hand."""
        return self.keeps_turns

    def push(self, cell: Cell, item: Item) -> None:
        """Put an item of the runtime's own in its place behind the messages."""
        raise NotImplementedError

    def start_failed(self, error: StartFailed) -> None:
        """Hear why no life has begun."""

    def offer(self, cell: Cell, item: Any) -> Awaitable[None] | None:
        """Admit a message for a sender that waits until it is accepted. None: it is."""
        cell.admit(cell, item)
        return None

    def expect(self, cell: Cell) -> None:
        """The address was made ahead of its first life in this program: what is sent there waits for that."""

    def has_class(self, cell: Cell, kind: type[Actor]) -> None:
        """The actor is of this class from now on."""

    def is_open(self, cell: Cell) -> bool:
        """Whether it lets messages through to the life at the address."""
        return True

    def backlog(self, cell: Cell, running: int) -> int:
        """Messages that wait, as far as is known here; `running` is the input in hand, -1 if none is known."""
        raise NotImplementedError

    def load(self, cell: Cell) -> int:
        """Messages that wait and those in hand; cheap, for it may be a guess."""
        raise NotImplementedError

    def work(self, cell: Cell, running: int) -> Work:
        """What the actor is at; `running` is the number of the input in hand, -1 if none is known."""
        turn, item = cell.more.turn if cell.more is not None else None, cell.item
        has_answered = isinstance(item, Ask) and item.is_done
        return Work(item, turn is not None, None if turn is None else turn.since, has_answered, newest=item)

    def rests(self, cell: Cell) -> list[TurnRest]:
        """What the turn in hand waits for that is no other actor's work; empty if that is not known in this process."""
        more = cell.more
        if more is None or more.turn is None or not (begun := more.belongings.rests):
            return []
        return [rest for item, rest in begun.values() if item is more.turn.item]

    def awaits(self, cell: Cell) -> str:
        """The address of the actor for whose reply alone the turn in hand waits; "" if there is none that is known."""
        more, ctx = cell.more, cell.ctx
        return "" if more is None or more.turn is None or ctx is None else ctx._whom(more.turn.waiting)

    def ask_turns(self, cell: Cell) -> None:
        """Have its process tell of its turns, for the next `work`, `rests` and `awaits`; nothing where all is known."""

    def mailbox(self, cell: Cell) -> Capacity | None:
        """How full the mailbox is; None if it takes any number of messages."""
        return cell.more.bound if cell.more is not None else None

    def progress(self, cell: Cell) -> object:
        """How far the start that is under way has come, as `Host.progress` says."""
        return None

    def cause(self, reason: ExitReason) -> ExitReason:
        """Why the present life ends, as all are told: `reason`, unless that only carries out what the home wants."""
        return reason

    def recovers(self, reason: ExitReason) -> bool:
        """Whether a life that ended for this reason is brought back with its state."""
        return False

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        """Whether the turn of an ask may have begun whose deadline is over, and which was handed on with a number."""
        return True

    def withdraw(self, cell: Cell, ask: Ask, then: Callable[[bool], None]) -> None:
        """See to it that such an ask, which has not begun, never does; `then` hears, soon, whether that is sure."""
        then(True)  # Its deadline goes with it, and nothing of it outlives this process.

    def holds_back(self, cell: Cell) -> str:
        """Why replies of turns that have ended do not leave now; "" if nothing keeps them."""
        return ""

    def hangs(self, cell: Cell) -> None:
        """The life is told to end because it works badly: a turn that has to be cut off for that did not end."""

    def faulted(self, cell: Cell, by: str) -> None:
        """The life is killed, and no supervisor has ordered that: a turn in hand counts it as any death.

        `by` is the address of the actor whose turn has called for it; "" if that was no actor.
        """
        if cell.state == RUNNING and cell.node.events.has_listeners:
            cell.node.emit(ActorKilled(cell.path, by))

    def handed_to(self, parent: Parent) -> None:
        """Another supervisor has the address from now on."""

    def retired(self, cell: Cell) -> None:
        """The address is gone for good; called before its queue is drained."""


class Place:
    """Where the turns of an address run, life after life."""

    is_here: bool
    """Whether that is this process."""
    owns_processes: bool = False
    """Whether each life has a process of its own, or several."""
    kind: str = "task"
    """Where that is, in a word, for whoever counts."""
    limits_turns: bool = True
    """Whether a turn that takes longer than its class allows is ended where it runs, and not by others."""

    def name(self, cell: Cell, name: GivenName) -> asyncio.Future[None] | None:
        """Have the life that is about to begin found by a name. None: it is.

        Names are the root's: an actor process asks it. Raises, or fails the future, with StartFailed: another has it.
        """
        uplink = cell.node.ports.uplink
        if uplink is not None:
            claimed: asyncio.Future[None] = uplink.claim_name(cell, name)
            return claimed
        cell.node.name_life(cell, name)
        return None

    def start(self, cell: Cell) -> asyncio.Future[None] | None:
        """Begin a life. None: it is up already. Raises, or fails the future, with StartFailed."""
        raise NotImplementedError

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        """Ask the life to end in good order."""
        raise NotImplementedError

    def kill(self, cell: Cell) -> None:
        """End the life at once."""
        raise NotImplementedError

    def require_order(self, cell: Cell, order: Order) -> None:
        """Raises NotGranted: `stop` or `kill` would, for an actor may not give such an order there."""

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        """Have an order carried out between two turns of the actor, ahead of all messages."""
        raise NotImplementedError

    def is_up(self, cell: Cell) -> bool:
        """Whether a life can take messages here."""
        return True

    @property
    def is_ending(self) -> bool:
        """Whether the life has been told to stop."""
        return False

    def lived_at(self, path: str) -> Cell | None:
        """Who is known here at an address below, though the process of its supervisor may have ended."""
        return None

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """A link, monitor or binding at this cell has changed: whoever lives its life has to know."""

    def readdress(self, cell: Cell, was: str, now: str) -> None:
        """The actor, or one above it, has moved to another supervisor: `was`, and all below it, is `now`."""

    def is_steady(self, cell: Cell) -> bool:
        """Whether the address may change now: nobody is being told of it in words that may come too late."""
        return True

    def running(self, cell: Cell) -> int:
        """The number of the input in hand, -1 if none is known."""
        return -1

    def may_have_begun(self, cell: Cell, key: int) -> bool:
        """Whether the present life may have begun a recorded input that has no end."""
        return True

    def process(self, cell: Cell) -> Any:
        """The process besides this one that the present life is lived in, if there is one now."""
        return None

    def known_as(self, cell: Cell) -> str:
        """The address by which that process knows who lives that life."""
        return cell.path

    def replica_states(self) -> Mapping[str, str] | None:
        """How each replica that lives the life here does: "leads", "follows", "joining", "silent" or "down".

        Without any, none lives at the moment. None: the life here has no replicas.
        """
        return None

    def spec_data(self, cell: Cell) -> dict[str, Any]:
        """What of the spec says how lives are lived here, as data."""
        return {}

    def end(self, cell: Cell, reason: ExitReason) -> None:
        """Nobody wants the life any more, or the start that is under way: end it."""
        self.kill(cell)

    def left(self, cell: Cell) -> list[asyncio.Future[Any]]:
        """What has to come to its end before another life may begin."""
        return []

    def handed_to(self, parent: Parent) -> None:
        """Another supervisor has the address from now on."""

    def disowned(self, cell: Cell) -> None:
        """The supervisor here has lost the actor to another one: whoever waits for its start is told so."""

    def retired(self, cell: Cell) -> None:
        """The address is gone for good: what is under way there is not wanted any more."""


class Parent:
    """The supervisor of an address, as those who live its lives speak of it."""

    def life_over(self, cell: Cell, reason: ExitReason, over: Callable[[bool | None], None]) -> None:
        """A life has ended. Its supervisor decides what follows; `over` is called as soon as that is known.

        Args:
            cell: the address.
            reason: of the end.
            over: takes whether the actor is brought back with its state; None: as its spec says.
        """
        raise NotImplementedError

    def recipe(self, cell: Cell) -> Start[Any] | bytes:
        """How a life at the address begins, or that as bytes."""
        raise NotImplementedError

    def topics(self, cell: Cell) -> Iterable[str]:
        """The topics that the class at the address subscribes to."""
        raise NotImplementedError

    def is_restarting(self, cell: Cell) -> bool:
        """Whether a retired address may have its supervisor, and so itself, started again."""
        raise NotImplementedError

    def undone(self, cell: Cell) -> None:
        """A life here is over, or could not be built: what it had taken in this process is given back."""

    def retired(self, cell: Cell) -> None:
        """The address is gone for good."""

    @property
    def has_lost(self) -> bool:
        """Whether the life here has ended with the supervisor's process, and no other one is wanted here."""
        return False

    def begins_without(self, cell: Cell) -> None:
        """The supervisor has been started again, and does not bring back the actor that lived here."""

    def leaves(self, *, is_restarting: bool) -> None:
        """The supervisor gives up the address; it may have been started again by its own (`is_restarting`)."""

    def respecified(self, cell: Cell, spec: dict[str, Any]) -> None:
        """The next lives there are lived otherwise than the last: what of the spec says so, as data."""

    def begins_with(self, cell: Cell, start: Start[Any]) -> None:
        """The next lives there begin with this, and not as the last."""


class AddressHost:
    """The host of an address: a home, a place, and a parent."""

    __slots__ = ("home", "parent", "place", "takes_parcels")

    def __init__(self, home: Home, place: Place, parent: Parent) -> None:
        self.home, self.place, self.parent = home, place, parent
        self.takes_parcels = home.takes_parcels

    # -- the home's -------------------------------------------------------------------------------------------------

    def push(self, cell: Cell, item: Item) -> None:
        self.home.push(cell, item)

    def offer(self, cell: Cell, item: Any) -> Awaitable[None] | None:
        if cell.state is not GONE:
            return self.home.offer(cell, item)
        there = cell.node.successor(cell)
        if there is not None:
            return there.host.offer(there, item)
        cell.admit(cell, item)  # The home may be in a process that has ended: nobody would answer.
        return None

    def backlog(self, cell: Cell) -> int:
        return self.home.backlog(cell, self.place.running(cell))

    def load(self, cell: Cell) -> int:
        return self.home.load(cell)

    def work(self, cell: Cell) -> Work:
        return self.home.work(cell, self.place.running(cell))

    def rests(self, cell: Cell) -> list[TurnRest]:
        return self.home.rests(cell)

    def awaits(self, cell: Cell) -> str:
        return self.home.awaits(cell)

    def ask_turns(self, cell: Cell) -> None:
        self.home.ask_turns(cell)

    def mailbox(self, cell: Cell) -> Capacity | None:
        return self.home.mailbox(cell)

    def progress(self, cell: Cell) -> object:
        return self.home.progress(cell)

    def recovers(self, reason: ExitReason) -> bool:
        return self.home.recovers(reason)

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        return self.home.may_have_begun(cell, ask)

    def withdraw(self, cell: Cell, ask: Ask, then: Callable[[bool], None]) -> None:
        self.home.withdraw(cell, ask, then)

    def holds_back(self, cell: Cell) -> str:
        return self.home.holds_back(cell)

    # -- the place's ------------------------------------------------------------------------------------------------

    def start(self, cell: Cell) -> asyncio.Future[None] | None:
        try:
            up = self.place.start(cell)
        except StartFailed as error:
            self.home.start_failed(error)
            raise
        if up is not None:
            up.add_done_callback(self._started)
        return up

    def _started(self, up: asyncio.Future[None]) -> None:
        error = None if up.cancelled() else up.exception()
        if isinstance(error, StartFailed):
            self.home.start_failed(error)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        self.place.stop(cell, reason)

    def kill(self, cell: Cell) -> None:
        self.place.kill(cell)

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        self.place.control(cell, call)

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        self.place.told(cell, verb, data)

    # -- both -------------------------------------------------------------------------------------------------------

    def is_up(self, cell: Cell) -> bool:
        return self.home.is_open(cell) and self.place.is_up(cell)

    def handed_to(self, parent: Parent) -> None:
        """Have another supervisor decide what follows from the ends of lives."""
        self.parent = parent
        self.place.handed_to(parent)
        self.home.handed_to(parent)

    def retired(self, cell: Cell) -> None:
        self.place.retired(cell)
        self.home.retired(cell)
        self.parent.retired(cell)
