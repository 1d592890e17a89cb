"""Mailboxes: one `admit` function per situation of an address, swapped when the situation changes.

`cell.admit(cell, item)` is called for every message; which function stands there says what happens to it. No flag is
tested per message.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from ..errors import MailboxFull
from ..overflow import Overflow, check, decide, drop_reason
from .envelope import LEAVE, Ask, Envelope, Item, message_in
from .ref import current

if TYPE_CHECKING:
    from .cell import Cell
    from .node import Node


def admit_first(cell: Cell, item: Any) -> None:
    """The first message: make the queue (an empty deque is 760 bytes), then go on as `admit_queue`."""
    if type(item) not in cell.table:
        cell.require(item)
    queue_of(cell).append(item)
    cell.schedule()


def admit_queue(cell: Cell, item: Any) -> None:
    """The unbounded mailbox: the hot path."""
    if type(item) not in cell.table:
        cell.require(item)
    cell.queue.append(item)  # type: ignore[union-attr]  # this function stands there only when the queue is made
    if not cell.scheduled:
        cell.scheduled = True
        node = cell.node
        node.ready.append(cell)
        if not node.awake:
            node.wake()


def admit_bounded(cell: Cell, item: Any) -> None:
    """A mailbox with a capacity: what does not fit goes by the overflow policy."""
    if type(item) not in cell.table:
        cell.require(item)
    bound = cell.extra().bound
    assert bound is not None
    bound.admit(cell, item)


def admit_closing(cell: Cell, item: Any) -> None:
    """The actor handles what is queued and then stops: nothing new is let in. (`Cell.room` refuses a `send`.)

    What it tells itself belongs to what is queued.
    """
    if is_of_its_own(cell) and not isinstance(item, Ask):
        admit = admit_first if cell.extra().bound is None else admit_bounded
        admit(cell, item)
    elif isinstance(item, Ask):
        item.fail(cell.stopped_error("it is stopping"))
    else:
        sender = item.sender if isinstance(item, Envelope) else None
        cell.node.dead_letter(cell, message_in(item), "the actor is stopping", sender)


def is_of_its_own(cell: Cell) -> bool:
    """Whether it is the actor of this cell itself that sends, in a turn or a task of its own."""
    sender = current.get(None)
    return sender is not None and sender._cell is cell


def admit_gone(cell: Cell, item: Any) -> None:
    """The address has ended: another life may have been started there since, else it is a dead letter."""
    successor = cell.node.successor(cell)
    if successor is not None:
        successor.admit(successor, item)
    elif isinstance(item, Item):
        item.undelivered(cell, _gone_at(cell))
    else:
        cell.node.dead_letter(cell, item, SYSTEM_ENDED if is_over(cell.node) else "the actor has stopped")


SYSTEM_ENDED = "the system has ended"


def is_over(node: Node) -> bool:
    """Whether the whole system has ended, so that nobody will live at any address of it."""
    return node.root is not None and node.root.is_dead


def _gone_at(cell: Cell) -> str:
    """Why nobody is at an address."""
    root = cell.node.root
    if is_over(cell.node):
        return SYSTEM_ENDED
    if root is None or cell.parent is not None or cell.path.split("/")[1:2] == root.path.split("/")[1:2]:
        return "nobody lives at its address now"
    name = root.path.split("/")[1]
    return f"it is of another system than {name}, and a ref that was sent does not lead there: `hf.connect` does"


def queue_of(cell: Cell) -> deque[Any]:
    """The cell's queue, made now if there was none."""
    if cell.queue is None:
        bound = cell.more.bound if cell.more is not None else None
        cell.queue = deque() if bound is None else BoundedQueue(cell)
        if cell.admit is admit_first:
            cell.admit = admit_queue
    return cell.queue


def put_back(cell: Cell, items: Iterable[Any]) -> None:
    """Put items at the front of the queue, in order, but behind the commands that stand there."""
    queue = queue_of(cell)
    commands: list[Any] = []
    while queue and isinstance(queue[0], Item) and queue[0].is_command:
        commands.append(deque.popleft(queue))
    queue.extendleft(reversed(list(items)))
    queue.extendleft(reversed(commands))


def put_first(cell: Cell, message: Any) -> None:
    """Put a message ahead of all others, whatever room there is: a life that begins has to handle it first."""
    put_back(cell, (message,))
    if cell.more is not None and cell.more.bound is not None:
        cell.more.bound.count += 1


def is_queued(cell: Cell, message: Any) -> bool:
    """Whether this very message waits in the queue."""
    return any(item is message for item in cell.queue or ())


def take_out(cell: Cell, message: Any) -> None:
    """Take this very message out of the queue, if it waits there. Called between two lives."""
    for index, item in enumerate(cell.queue or ()):
        if item is message:
            del cell.queue[index]  # type: ignore[union-attr]  # there is one, for something was found in it
            if cell.more is not None and cell.more.bound is not None:
                cell.more.bound.count -= 1
            return


class Senders:
    """Who waits for room to send, first in, first served: one wakes for each free place, and tries again.

    Whoever has woken need not take the place: it may have been cancelled, have lost its life, or have gone elsewhere.
    Then it is the next one's, and nobody has to remember to say so.
    """

    __slots__ = ("_waiting",)

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] | None = (
            None  # An empty one takes 760 bytes, of each recorded actor.
        )

    def __len__(self) -> int:
        return len(self._waiting or ())

    def wait(self, loop: asyncio.AbstractEventLoop) -> asyncio.Future[None]:
        """A future that ends when it is worth trying again."""
        future: asyncio.Future[None] = loop.create_future()
        if self._waiting is None:
            self._waiting = deque()
        self._waiting.append(future)
        return future

    def wake(self, has_room: Callable[[], bool]) -> None:
        """Wake the first one, if there is room, and when it has had its turn the next one, if there still is."""
        waiting = self._waiting
        while waiting and has_room():
            sender = waiting.popleft()
            if not sender.done():
                sender.set_result(None)
                sender.get_loop().call_soon(self.wake, has_room)
                break

    def release(self) -> None:
        """Wake all senders that wait for room."""
        waiting, self._waiting = self._waiting, None
        for sender in waiting or ():
            if not sender.done():
                sender.set_result(None)


def take_back(cell: Cell, queue: deque[Any]) -> None:
    """Take the newest item out of a queue again: its sender is told that it was refused."""
    item = deque.pop(queue)
    if counts(item) and cell.more is not None and cell.more.bound is not None:
        cell.more.bound.count -= 1


class Bound:
    """A mailbox's capacity, its overflow policy, and who waits for room.

    Only messages count, and only while they are queued: commands and signals always fit.
    """

    __slots__ = ("capacity", "count", "overflow", "senders", "waiting")

    def __init__(self, capacity: int, overflow: Overflow) -> None:
        self.capacity = capacity
        self.overflow: Overflow = overflow
        self.count = 0
        self.waiting: deque[Ask] = deque()  # asks that wait for room, first in, first served
        self.senders = Senders()

    def admit(self, cell: Cell, item: Any) -> None:
        """Take the item, or let the policy decide."""
        if self.count < self.capacity and not self.waiting:
            self.put(cell, item)
            return
        verdict, keep = decide(self.overflow, self.capacity, is_ask=isinstance(item, Ask))
        match verdict:
            case "wait":
                self.waiting.append(item)
            case "refuse":
                self._refuse(cell, item)
            case "lose":
                self._lose(cell, item)
            case "take":
                self._lose_queued(cell, keep)
                self.put(cell, item)

    def inherit(self, old: Bound) -> Bound:
        """Take over who waits at the bound that stood here before."""
        self.count, self.waiting, self.senders = old.count, old.waiting, old.senders
        return self

    def put(self, cell: Cell, item: Any) -> None:
        """Append an item to the queue, and count it."""
        self.count += 1
        queue_of(cell).append(item)
        cell.schedule()

    def taken(self, cell: Cell) -> None:
        """One message has left the queue: let the next one in."""
        self.count -= 1
        while self.waiting and self.count < self.capacity:
            ask = self.waiting.popleft()
            if not ask.is_done:  # Expired or given up while it waited: never admitted.
                self.put(cell, ask)
        self.senders.wake(self._is_below)

    def moved(self, cell: Cell) -> None:
        """The actor, in another process, has begun or ended turns."""

    def has_room(self, cell: Cell) -> bool:
        """Whether a message would be taken now (or lost: only the policy "block" has a sender wait)."""
        return self.overflow != "block" or (self._is_below() and not self.waiting)

    def _is_below(self) -> bool:
        return self.count < self.capacity

    def room(self, cell: Cell) -> asyncio.Future[None] | None:
        """For `send`: None if there is room."""
        return None if self.has_room(cell) else self.senders.wait(cell.node.loop)

    def release(self) -> None:
        """The address is gone: whoever waits shall see it."""
        self.senders.release()

    def _refuse(self, cell: Cell, item: Any) -> None:
        error = MailboxFull(cell.path, self.capacity)
        cell.node.count_no_room(cell.path)
        if isinstance(item, Ask):
            item.fail(error)
            return
        raise error

    def _lose(self, cell: Cell, item: Any, displaced_by: str = "") -> None:
        message = item.message if isinstance(item, (Envelope, Ask)) else item
        cell.node.count_no_room(cell.path)
        if isinstance(item, Ask):
            item.fail(MailboxFull(cell.path, self.capacity, displaced_by))
        sender = item.sender if isinstance(item, (Envelope, Ask)) else None
        cell.node.dead_letter(cell, message, drop_reason(self.capacity, self.overflow), sender)

    def _lose_queued(self, cell: Cell, keep: int) -> None:
        """Drop queued messages, oldest first, until `keep` are left."""
        queue = queue_of(cell)
        kept: list[Any] = []
        while self.count > keep and queue:
            item = deque.popleft(queue)
            if counts(item):
                self.count -= 1
                self._lose(cell, item, self.overflow)
            else:
                kept.append(item)
        queue.extendleft(reversed(kept))


def counts(item: Any) -> bool:
    """Whether an item takes one of a bounded mailbox's places: messages do, the runtime's own do not."""
    return not isinstance(item, Item) or not item.of_life


class _Nothing(Item):
    """A turn in which nothing is done."""

    __slots__ = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        return None


NOTHING = _Nothing()


class Hold(Item):
    """Stands between the commands and the messages of a suspended actor: none of those is run, none is out of order."""

    __slots__ = ("attempt", "behind", "prepared")
    is_command = True

    def __init__(self) -> None:
        self.attempt = 0  # of a transaction that holds the actor too
        self.prepared: Any = None  # and what it has prepared for it
        self.behind: list[Callable[[], None]] = []  # what waits until that lets it go, in order

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        cell: Cell = actor.ctx._cell
        queue_of(cell).appendleft(item)
        cell.scheduled = False
        return LEAVE

    def let_go(self) -> None:
        """Have those that wait look again."""
        behind, self.behind = self.behind, []
        for look in behind:
            look()


BY_USER, BY_TRANSACTION, BY_ITSELF = 1, 2, 4
"""Who suspends an actor: bits of `suspended`."""


def suspend(cell: Cell, who: int = BY_USER) -> None:
    """Have an actor handle no message until all who suspend it have resumed it. Called between two turns."""
    more = cell.extra()
    if not more.suspended:
        put_back(cell, (Hold(),))
    more.suspended |= who


def resume(cell: Cell, who: int = BY_USER) -> None:
    """It handles messages again, as far as this one is concerned, in order. Called between two turns."""
    more = cell.extra()
    if not more.suspended:
        return
    more.suspended &= ~who
    if more.suspended:
        return
    queue = queue_of(cell)
    for index, item in enumerate(queue):  # Not removed: the run loop has counted it.
        if type(item) is Hold:
            queue[index] = NOTHING
            cell.schedule()
            return


def held(cell: Cell) -> Hold | None:
    """What holds the messages of an actor of this process; None if it is not suspended."""
    return next((item for item in cell.queue or () if type(item) is Hold), None)


def held_by_transaction(cell: Cell) -> Hold | None:
    """What holds an actor of this process for a transaction, which has tried what is to become of it."""
    hold = held(cell)
    return hold if hold is not None and hold.attempt else None


class BoundedQueue(deque[Any]):
    """The queue of a bounded mailbox: taking a message makes room. Only these actors pay for it."""

    def __init__(self, cell: Cell) -> None:
        super().__init__()
        self._cell = cell

    def popleft(self) -> Any:
        if not self:
            return NOTHING  # A turn of this slice has made an overflow drop what the run loop had counted.
        item = super().popleft()
        if counts(item):
            bound = self._cell.extra().bound
            assert bound is not None
            bound.taken(self._cell)
        return item


@dataclasses.dataclass(frozen=True, slots=True, repr=False)
class Bounded:
    """The choice of a bounded mailbox, for a child spec; made by `bounded`."""

    capacity: int
    overflow: Overflow

    def __repr__(self) -> str:
        return f"bounded({self.capacity}, overflow={self.overflow!r})"


def bounded(capacity: int, *, overflow: Overflow = "block") -> Bounded:
    """Describe a mailbox for at most `capacity` messages.

    Args:
        capacity: messages, >= 1.
        overflow: "block" (tell raises MailboxFull, send and publish wait, ask waits to its deadline), "reject" (all of
            these raise but publish), "drop_newest", "drop_oldest", or "latest" (only the newest is kept). The loser
            goes to dead letters. Asks are no exception: one that waits is displaced by what comes later, and fails
            with MailboxFull.
    """
    check("bounded", capacity, overflow)
    return Bounded(capacity, overflow)
