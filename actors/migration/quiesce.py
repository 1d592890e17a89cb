"""Brings a moving life to rest between two turns, and holds the new life until it becomes the one.

What both sides of a process border need is here; who decides is `system/live_moves.py`.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from typing import TYPE_CHECKING, Any

from ..control.orders_lane import QueuedOrder
from ..errors import HoldfastError, error_text
from ..kernel import lifecycle, mailbox
from ..kernel.address_host import Work
from ..kernel.cell import GONE, RUNNING, Cell, Host, TurnRest
from ..kernel.codec import Parcel
from ..kernel.context import Piped
from ..kernel.envelope import LEAVE, Ask, Envelope, Item
from ..kernel.lifecycle import LOCAL, Kill
from ..kernel.links import Down, Exit
from ..kernel.timers import Tick
from ..ordered import Ordered
from ..process.wire.peer import RelayedAsk
from .luggage import Owe, Stays

if TYPE_CHECKING:
    import asyncio

    from ..exit_reasons import ExitReason
    from ..kernel.actor import Actor
    from ..kernel.address_host import Capacity, Parent

ATTEMPTS = itertools.count(1)
"""Numbers of attempts to have an actor in another process come to rest: what it says to an earlier one is void."""
LOOK_AGAIN = 0.005
"""Seconds between two looks at whether background work is over."""


class PackLife(Item):
    """A command: come to rest, as soon as no background work is out, with the state packed. Until then all goes on."""

    __slots__ = ("_ignored", "_owe", "_refused", "_stays", "_taken", "is_done", "is_void", "why")

    def __init__(
        self,
        owe: Owe,
        taken: Callable[[Actor, bytes], None],
        refused: Callable[[str], None],
        ignored: tuple[str, ...] = (),
        *,
        stays: bool = False,
    ) -> None:
        self._stays = stays  # it goes on where it is, with its children
        self._owe, self._taken, self._refused = owe, taken, refused
        self._ignored = ignored  # children that are not the actor's own
        self.is_done = False  # the actor is at rest
        self.is_void = False  # it is not wanted any more
        self.why = "a turn of it has not ended"

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        take: PackLife = item
        ctx = actor.ctx
        cell: Cell = ctx._cell
        is_adrift = ctx._is_adrift
        if take.is_void or ctx._postpones(take) or any(map(_ends, cell.extra().urgent or ())):
            return TurnLeft.run(actor, item) if is_adrift else None
        take.why = _busy(cell)
        if take.why and is_adrift:
            return TurnLeft.run(actor, item)
        if take.why:
            cell.node.loop.call_later(LOOK_AGAIN, take._again, cell, cell.life)
            return None
        try:
            children = [name for name in cell.children or () if name not in take._ignored]
            if children and not take._stays:
                raise Stays(
                    f"it has children of its own ({', '.join(children)}): have a supervisor start them beside it"
                )
            state = ctx._depart(take._owe)
            take._taken(actor, state)
        except BaseException as error:  # The user's own code, such as `get_state`: no reason to end the actor.
            take._refused(str(error) if isinstance(error, HoldfastError) else error_text(error))
            return TurnLeft.run(actor, item) if is_adrift else None
        take.is_done = True
        for timer in cell.extra().belongings.timers:
            timer.pause()
        return LEAVE  # And stays `scheduled`, so that nobody puts it on the run queue.

    def hurry(self, cell: Cell) -> None:
        """Do not wait for a turn that rests, which may be for days: it is left, and run again at the new place.

        Not while commands come first that the next life would not obey, or something is out that ends with this one.
        """
        ctx, more = cell.ctx, cell.extra()
        if ctx is None or not ctx._may_rest or self._stays or self.is_void or self.is_done:
            return
        if cell.state is not RUNNING:
            return
        first = next((one for one in more.urgent or () if not one.comes_again), None)
        stays_behind = any(name not in self._ignored for name in cell.children or ())
        if first is self and not stays_behind and not _busy(cell) and ctx._leaves_turn():
            return
        cell.node.loop.call_later(LOOK_AGAIN, self.hurry, cell)

    def withdraw(self, cell: Cell) -> None:
        """It is not wanted any more; if a turn is before it, the next such command is not behind it.

        Behind a turn that was left it stays, to end the life: that handles nothing any more.
        """
        self.is_void = True
        urgent, is_adrift = cell.extra().urgent, cell.ctx is not None and cell.ctx._is_adrift
        if urgent is not None and self in urgent and not is_adrift:
            urgent.remove(self)

    def _again(self, cell: Cell, life: int) -> None:
        if not self.is_void and cell.state is RUNNING and cell.life == life:
            lifecycle.urge(cell, self)


class TurnLeft(Item):
    """A command: end as if killed, for the turn in hand was left for a move that has not come about."""

    is_command = True

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        lifecycle.killed(actor.ctx._cell)
        return LEAVE


def _ends(command: Item) -> bool:
    """Whether a command is one to stop or to be killed."""
    return isinstance(command, Kill) or command.stops is not None


def _busy(cell: Cell) -> str:
    """Why an actor cannot be brought to rest yet; "" if it can."""
    more = cell.extra()
    if more.belongings.tasks:
        return "background work (pipe_to_self, create_task) is out"
    # Of another actor, what it has passed on is answered from here on.
    own = cell.node.ports.uplink if cell is cell.node.root else None
    for item in cell.queue or ():
        if isinstance(item, Piped):
            return "the result of background work waits for its turn"
        if own is not None and isinstance(item, Ask) and not isinstance(item, RelayedAsk) and not item.is_done:
            return "it waits for a reply of its own"
    if own is not None and any(isinstance(ask, RelayedAsk) and not ask.is_done for ask in own.pending.values()):
        return "an ask that it has passed on is not answered"
    return ""


def resume(cell: Cell) -> None:
    """The life that had been brought to rest goes on where it was."""
    for timer in cell.extra().belongings.timers:
        timer.resume()
    if cell.ctx is not None and cell.ctx._is_adrift:
        mailbox.queue_of(cell).appendleft(TurnLeft())
    lifecycle.up(cell)


class Settle(Item):
    """Behind `on_start` in the queue of a new life: it is up, and handles nothing until it is let go."""

    __slots__ = ("settled",)

    def __init__(self, settled: asyncio.Future[None]) -> None:
        self.settled = settled

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        if not item.settled.done():
            item.settled.set_result(None)
        return LEAVE


def carry(items: Iterable[Any]) -> None:
    """Have the signals among them told where the actor goes, though the ties that they come from are over."""
    for item in items:
        if isinstance(item, (Exit, Down)):
            item.is_carried = True


class Transit:
    """Stands for the host of an actor that is at rest: what is asked for is done when it is known where it lives."""

    def __init__(self, old: Host, give_up: Callable[[str], None]) -> None:
        self.old, self._give_up = old, give_up
        self.home, self.place, self.parent = old.home, old.place, old.parent
        self.waiting: list[Callable[[Host], object]] = []
        self.is_killed = False
        self.takes_parcels = old.takes_parcels

    def start(self, cell: Cell) -> asyncio.Future[None] | None:
        raise HoldfastError(f"{cell.path} is alive: it is being moved")

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        self.waiting.append(lambda host: host.stop(cell, reason))

    def kill(self, cell: Cell) -> None:
        self.is_killed = True
        self._give_up("it is killed")

    def retired(self, cell: Cell) -> None:
        self.old.retired(cell)

    def handed_to(self, parent: Parent) -> None:
        self.parent = parent
        self.old.handed_to(parent)

    def push(self, cell: Cell, item: Item) -> None:
        carry([item])
        self.waiting.append(lambda host: host.push(cell, item))

    def offer(self, cell: Cell, item: Any) -> Awaitable[None] | None:
        return self.home.offer(cell, item)

    def progress(self, cell: Cell) -> object:
        return None

    def recovers(self, reason: ExitReason) -> bool:
        return self.home.recovers(reason)

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        return True

    def withdraw(self, cell: Cell, ask: Ask, then: Callable[[bool], None]) -> None:
        then(False)

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        self.waiting.append(lambda host: host.control(cell, call))

    def control_first(self, cell: Cell, calls: list[QueuedOrder]) -> None:
        """These orders were given before all that waits here."""
        waiting, self.waiting = self.waiting, []
        for call in calls:
            self.control(cell, call)
        self.waiting += waiting

    def is_up(self, cell: Cell) -> bool:
        return True

    def holds_back(self, cell: Cell) -> str:
        return ""  # It is at rest: no turn has an end.

    def backlog(self, cell: Cell) -> int:
        return sum(map(mailbox.counts, cell.queue or ()))

    def load(self, cell: Cell) -> int:
        return len(cell.queue or ())

    def work(self, cell: Cell) -> Work:
        return Work()  # While it moves it is not up, and nothing is held against it.

    def rests(self, cell: Cell) -> list[TurnRest]:
        return []

    def awaits(self, cell: Cell) -> str:
        return ""

    def ask_turns(self, cell: Cell) -> None:
        pass

    def mailbox(self, cell: Cell) -> Capacity | None:
        return None

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        self.waiting.append(lambda host: host.told(cell, verb, data))

    def over(self, cell: Cell, host: Host) -> None:
        """It is known where the actor lives: there."""
        cell.host = host
        for do in self.waiting:
            do(host)
        if self.is_killed:
            host.kill(cell)


def twin(cell: Cell) -> Cell:
    """Another cell at the same address, found by nobody: for a life that is not the one there yet, or any more."""
    other = Cell(cell.node, cell.parent, cell.name, LOCAL)
    other.table, other.life, other.state = cell.table, cell.life, RUNNING
    return other


def settle(twin: Cell, cell: Cell) -> None:
    """The life at a twin, which is at rest, becomes that of the cell itself. The queues are left to the caller."""
    ctx, node = twin.ctx, cell.node
    assert ctx is not None
    cell.actor, cell.ctx, cell.context, cell.table = twin.actor, ctx, twin.context, twin.table
    ctx._cell = cell
    ctx._keep_promises()
    mine, its = cell.extra(), twin.extra()
    has, had, ties, tied = mine.belongings, its.belongings, mine.ties, its.ties
    has.timers, has.tasks, mine.stash = had.timers, had.tasks, its.stash
    mine.trap_exits = its.trap_exits
    for timer in has.timers:
        timer.belongs_to(cell)
    for topic in list(had.topics):
        node.topics.unsubscribe(topic, twin)
        node.topics.subscribe(topic, cell)
    for name, scope in had.names.items():
        node.names[name] = cell
        has.names[name] = scope
    for peer, name in tied.links.items():
        peer.extra().ties.links.pop(twin, None)
        peer.extra().ties.links[cell], ties.links[peer] = cell.path, name
    for watch in tied.watching:
        watch.watcher, watch.life = cell, cell.life
        ties.watching[watch] = None
    ties.monitors += tied.monitors
    for watch in tied.monitors:
        watch.target = cell
    for child in (twin.children or {}).values():
        child.parent = cell
        cell.children = {**(cell.children or {}), child.name: child}
    _forward(twin)


def settle_with_queue(twin: Cell, cell: Cell) -> None:
    """As `settle`, of a recorded life: what is in its queue comes along, for its home has fed it."""
    queue, its = twin.queue, twin.extra()
    urgent, suspended = its.urgent, its.suspended
    settle(twin, cell)
    more = cell.extra()
    cell.queue, more.urgent, more.suspended = deque(queue or ()), urgent, suspended


def _forward(twin: Cell) -> None:
    """Whoever has a ref to the twin reaches the actor all the same."""
    twin.actor = twin.ctx = twin.context = twin.children = twin.queue = twin.more = None
    twin.state, twin.admit = GONE, mailbox.admit_gone


def part(cell: Cell) -> Cell:
    """The life at a cell, which is at rest, becomes that of a twin; the cell has none in this process any more.

    What belongs to the address (links, monitors, names, topics, bindings, the queue) stays.
    """
    old, more = twin(cell), cell.extra()
    ctx = cell.ctx
    assert ctx is not None
    old.actor, old.ctx, old.context = cell.actor, ctx, cell.context
    ctx._cell = old
    its = old.extra()
    gone, kept = its.belongings, more.belongings
    gone.timers, kept.timers = kept.timers, Ordered()
    gone.tasks, kept.tasks = kept.tasks, Ordered()
    its.bindings = more.bindings
    for timer in list(gone.timers):
        timer.belongs_to(old)
        timer.cancel()
    cell.actor = cell.ctx = cell.context = None
    more.trap_exits, more.suspended = False, 0
    more.stash = None
    return old


def replaced(cell: Cell) -> tuple[Cell, list[Any], list[Item]]:
    """Part with a life whose place another one takes.

    Returns that life, what has waited for it, and the commands ahead of that. What it had put aside comes first, and
    what has waited for room in its mailbox last.
    """
    more = cell.extra()
    stash, bound = list(more.stash or ()), more.bound
    life = part(cell)
    items, commands = sorted_out(cell)
    late = without_room(cell) if bound is not None else []
    return life, handed_on([*stash, *items, *late]), commands


def without_room(cell: Cell) -> list[Any]:
    """What waits for room in a bounded mailbox; those who wait to send try again, at whoever has the address then."""
    bound = cell.extra().bound
    assert bound is not None
    waiting, bound.waiting = list(bound.waiting), deque()
    cell.node.loop.call_soon(bound.release)
    return waiting


def farewell(old: Cell, stop: Item) -> None:
    """Have the life at a twin end; nobody is told but the actor itself."""
    old.queue = None
    if old.ctx is not None:
        old.ctx._hand_on_promises()
    mailbox.queue_of(old).append(stop)
    lifecycle.up(old)


# -- the queue -------------------------------------------------------------------------------------------------------


def sorted_out(cell: Cell, *, ticks: bool = False) -> tuple[list[Any], list[Item]]:
    """Empty the queue of a cell: what is for the actor wherever it lives, and the commands ahead of it."""
    more = cell.extra()
    items: list[Any] = []
    for item in list(cell.queue or ()):
        if isinstance(item, Item) and (type(item) is mailbox.Hold or item is mailbox.NOTHING or item.is_command):
            continue
        if isinstance(item, Settle) or (isinstance(item, Tick) and not ticks):
            continue  # Ticks of an actor that leaves are with its timers.
        items.append(item)
    commands = list(more.urgent or ())
    more.urgent, cell.queue = None, None
    return items, commands


def handed_on(items: Iterable[Any]) -> list[Any]:
    """The messages among what has waited for a life; the rest was of that life alone."""
    return [item for item in items if not isinstance(item, Item) or isinstance(item, (Ask, Envelope))]


def obey_commands(cell: Cell, commands: list[Item]) -> None:
    """What had been ordered of a life before it was moved is ordered of it now."""
    for command in commands:
        if isinstance(command, QueuedOrder):
            cell.host.control(cell, command)
        elif isinstance(command, Kill):
            cell.host.kill(cell)
        elif command.stops is not None:
            cell.host.stop(cell, command.stops)


def decoded(cell: Cell, item: Any) -> Any:
    """An item whose message came encoded, as its actor takes it here; None if it is none of its messages."""
    message = item.message if isinstance(item, (Ask, Envelope)) else item
    if type(message) is not Parcel:
        return item
    try:
        plain = cell.node.codec.decode(cell.table.kind_named(message.name), message.body)
    except Exception as error:  # msgspec's own, or what a hook raised: all say that it does not fit.
        if isinstance(item, Ask):
            item.fail(error if isinstance(error, HoldfastError) else HoldfastError(str(error)))
        else:
            cell.node.dead_letter(cell, message, error_text(error))
        return None
    if item is message:
        return plain
    item.message = plain
    return item


def now() -> float:
    """A clock that all processes of this machine share."""
    return time.monotonic()
