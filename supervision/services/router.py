"""The router of a pool: each message goes on to one of the workers, with its sender, its deadline and its chain."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeAlias

from ...actors.errors import AskDeadlock, HoldfastError, SendError
from ...actors.kernel import mailbox
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.cell import GONE, Cell
from ...actors.kernel.context import Stashed
from ...actors.kernel.envelope import AnyTable, Ask, Envelope, Table, chain_of, message_in
from ...actors.kernel.message import Message, Refusal
from ..admin import NotSupported
from ..children import STOPPED, Child
from .partition import partition_of

Routing = Literal["round_robin", "least_loaded", "random", "hash", "broadcast"]
Restarting = Literal["skip", "wait"]
"""What happens to a worker that is between two lives: it is passed over, or its messages wait at its address."""
Key: TypeAlias = str | Callable[[Any], Any]
"""What a message is hashed by: the name of one of its fields, or a function of it."""


class NoRoute(Refusal, text="no worker can be found for the message, for its key cannot be had: {why}"):
    """No worker can be found for a message, because its key cannot be had; `why` says what is wrong with it."""

    why: str


class Router(Actor):
    """Stands in front of a pool's workers and takes the messages of their class. Started by the pool's supervisor.

    It keeps no list of its own: what the workers are in is looked at for each message, so that it is never old. While
    nobody can take a message, they wait in its queue, in order.
    """

    deterministic = False
    _is_asked_again = True
    _with_successor = "anew"  # It is nothing without its supervisor beside it.

    def __init__(self, worker: Start[Any], routing: Routing, key: Key | None, restarting: Restarting) -> None:
        self._routing: Routing = routing
        self._key = key
        self._waits = restarting == "wait"
        self._next = 0
        self._is_held = False
        self._rooms: list[asyncio.Future[None]] = []  # of full mailboxes, while we wait for one
        worker_kind: Any = worker.kind  # (mypy takes no class for hashable)
        kind = routing_to(worker_kind)
        object.__setattr__(self, "__class__", kind)
        self.ctx._cell.table = kind._table

    # -- one message ------------------------------------------------------------------------------------------------

    def route(self, message: Message[Any]) -> None:
        """The handler of all messages: hand the one in hand on."""
        item = self.ctx._item
        if self._routing == "broadcast":
            self._to_all(item)
            return
        chain = chain_of(item)
        waiting = {path for path, _ in chain}  # Their turns wait for this very ask.
        crew = [one.cell for one in self._candidates() if one.cell is not None]
        free = [cell for cell in crew if cell.path not in waiting] if waiting else crew
        if crew and not free:
            item.fail(AskDeadlock(crew[0].path, tuple(path for path, _ in chain)))
            self.ctx._cell.item = Stashed.of(item)
            return
        able = [cell for cell in free if cell.has_room]
        if able:
            self._hand_on(item, self._choose(able))
        else:
            self._hold(item, free)

    def _workers(self) -> list[Child]:
        """The workers, as their supervisor sees them: it is our own too, and lives in the same process."""
        parent = self.ctx._cell.parent
        supervisor: Any = None if parent is None else parent.actor
        crew: list[Child] = [] if supervisor is None else supervisor._crew
        return crew

    def _candidates(self) -> Iterator[Child]:
        """Who may get the message, by what the workers are in; with a key there is only one."""
        crew = self._workers()
        if self._routing == "hash" and crew:
            first = partition_of(self._key_of(self.ctx._item), len(crew))
            found = next(filter(self._is_there, (*crew[first:], *crew[:first])), None)
            return iter(() if found is None else (found,))
        return filter(self._is_there, crew)

    def _is_there(self, one: Child) -> bool:
        cell = one.cell
        if cell is None or cell.state is GONE or one.state == STOPPED:
            return False
        return self._waits or cell.host.is_up(cell)

    def _key_of(self, item: Any) -> Any:
        """The key of a message. Raises NoRoute."""
        message = message_in(item)
        assert self._key is not None
        try:
            key = getattr(message, self._key) if isinstance(self._key, str) else self._key(message)
            partition_of(key, 1)
        except BaseException as error:  # The user's own function, or a key that nothing stable can be made of.
            raise NoRoute(f"{type(error).__name__}: {error}") from error
        return key

    def _choose(self, able: list[Cell]) -> Cell:
        """One of those that can take it now."""
        match self._routing:
            case "random":
                return self.ctx.random.choice(able)
            case "least_loaded":
                self._next += 1
                turned = [able[(self._next + at) % len(able)] for at in range(len(able))]
                return min(turned, key=lambda cell: cell.host.load(cell))  # The first of several: they take turns.
            case _:
                return self._in_turn(able)

    def _in_turn(self, able: list[Cell]) -> Cell:
        """The next one in the order of the workers, of those that can take it."""
        places = {one.cell: place for place, one in enumerate(self._workers())}
        count = len(places)
        chosen = min(able, key=lambda cell: (places[cell] - self._next) % count)
        self._next = (places[chosen] + 1) % count
        return chosen

    def _hand_on(self, item: Any, cell: Cell) -> None:
        """Forward the message in hand; a worker that refuses it is no fault of ours."""
        if isinstance(item, Ask):
            item.started = False  # What we did was not its turn.
        try:
            if isinstance(item, Ask):
                self.ctx.forward(cell.ref)
            else:  # As a `send` that does not wait here: its home may be elsewhere, and say only then that it is full.
                sent = Envelope(item.message, item.sender) if isinstance(item, Envelope) else item
                taken = cell.host.offer(cell, sent)
                if taken is not None:
                    asyncio.ensure_future(taken).add_done_callback(functools.partial(self._offered, item, cell))
        except HoldfastError as error:
            self._refused(item, cell, error)

    def _offered(self, item: Any, cell: Cell, done: asyncio.Future[None]) -> None:
        error = None if done.cancelled() else done.exception()
        if isinstance(error, HoldfastError):
            self._refused(item, cell, error)

    def _refused(self, item: Any, cell: Cell, error: HoldfastError) -> None:
        if isinstance(item, Ask):
            item.fail(error)
        else:
            cell.node.dead_letter(cell, message_in(item), str(error))

    def _to_all(self, item: Any) -> None:
        if isinstance(item, Ask):
            raise NotSupported("a broadcast has no single reply: tell it, or ask the workers one by one")
        crew = [one.cell for one in self._candidates() if one.cell is not None]
        if not crew:
            self._hold(item, [])
        for cell in crew:
            self._hand_on(item, cell)

    # -- nobody can take it -----------------------------------------------------------------------------------------

    def _hold(self, item: Any, full: list[Cell]) -> None:
        """Put the message back and handle no other before `look_again`; commands are still obeyed."""
        cell = self.ctx._cell
        self.ctx._cell.item = Stashed.of(item)
        if isinstance(item, Ask):
            item.started = False
        if cell.more is not None and cell.more.bound is not None and mailbox.counts(item):
            cell.more.bound.count += 1
        mailbox.put_back(cell, (item,))
        mailbox.suspend(cell, mailbox.BY_ITSELF)
        self._is_held = True
        for one in full:
            self._wait_for_room(one)

    def _wait_for_room(self, cell: Cell) -> None:
        try:
            room = cell.room()
        except SendError:
            return  # It has ended: its supervisor tells us of the next one.
        if room is None:
            self.ctx._cell.node.loop.call_soon(self.look_again)
            return
        self._rooms.append(room)
        room.add_done_callback(self._room)

    def _room(self, room: asyncio.Future[None]) -> None:
        if not room.cancelled():
            self.look_again()

    def look_again(self) -> None:
        """Something has changed: a worker is up, or has room."""
        if not self._is_held or self.ctx._closed:
            return
        self._is_held = False
        for room in self._rooms:
            room.cancel()
        self._rooms.clear()
        cell = self.ctx._cell
        mailbox.resume(cell, mailbox.BY_ITSELF)


Router._table = AnyTable()  # The workers' class is not known here: they decide themselves what is unknown.


@functools.cache
def routing_to(kind: type[Actor]) -> type[Router]:
    """The class of routers to workers of one class: it handles what they handle."""
    table = Table()
    for message in kind._table:
        if issubclass(message, Message):
            table[message] = Router.route
    names = {"__module__": Router.__module__, "__qualname__": Router.__qualname__}
    made: Any = type(Router.__name__, (Router,), names)
    made._table = table
    routing: type[Router] = made
    return routing
