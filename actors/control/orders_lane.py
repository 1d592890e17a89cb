"""The system lane: orders reach an actor ahead of its messages, wherever it lives, and are answered."""

from __future__ import annotations

import asyncio
import functools
from typing import TYPE_CHECKING, Any

from ..errors import ControlFailed, HoldfastError, error_text, type_name
from ..kernel import lifecycle, mailbox
from ..kernel.cell import Cell
from ..kernel.codec import MAX_BYTES
from ..kernel.envelope import NO_DEADLINE, Ask, Item
from ..kernel.message import Message
from ..process.wire import frames
from ..process.wire.frames import BadFrame
from ..process.wire.peer import Peer, RelayedAsk
from ..values import SavedRef, decode_value, encode_value
from .orders import ORDERS, GetState, Mark, Order, status_of, turns_of

if TYPE_CHECKING:
    from ..process.worker_node import Guest


class OrderAsked(Message[bytes]):
    """Stands for an order in its ask: what comes over a border as the reply is a value, encoded."""


ORDERED = OrderAsked()
LOOK_AGAIN = 0.01
"""Seconds between two looks at whether the life is there that an order waits for, and that a transaction holds."""
MOST_TOLD = MAX_BYTES - 4096
"""Bytes of what an order may give: with what stands around it, it fits into one message."""


class OrderAsk(Ask, eq=False):
    """The ask of an order, where it was given."""

    call: Any = None  # what was sent to another process: it may have to be sent elsewhere

    def answer(self, reply: object) -> None:
        """The reply came from another process."""
        try:
            refs = SavedRef if self.to is None else self.to.node.ref_at
            value = decode_value(reply, imports=False, refs=refs)  # type: ignore[arg-type]  # bytes: it is the reply of `OrderAsked`
        except HoldfastError as error:
            self.fail(error)
        else:
            self.give(value)

    def give(self, value: object) -> None:
        """The order was carried out in this very process."""
        if not self.future.done():
            self.future.set_result(value)


class QueuedOrder(Item):
    """An order in the queue of its actor: a command, ahead of all messages (but for `Mark`)."""

    __slots__ = ("ask", "has_looked", "order")
    of_life = False
    comes_again = True

    def __init__(self, ask: Ask, order: Order) -> None:
        self.ask, self.order, self.has_looked = ask, order, False

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        call: QueuedOrder = item
        ask, ctx = call.ask, actor.ctx
        if ask.is_done or ask.deadline <= ctx._cell.node.loop.time():
            return None  # Whoever gave it was told that it was not carried out.
        if ctx._postpones(call):
            return None
        hold = mailbox.held_by_transaction(ctx._cell) if call.order.is_behind_transactions else None
        if hold is not None:
            if not hold.behind:  # A life may end, or leave, while it is held.
                ctx._cell.node.loop.call_later(LOOK_AGAIN, hold.let_go)
            hold.behind.append(functools.partial(call._again, ctx._cell))
            return None
        ask.started = True
        try:
            value = call.order.run(ctx._cell, actor)
        except HoldfastError as error:
            ask.fail(error)
        except BaseException as error:  # The user's own code, such as `get_state`: no reason to end the actor.
            ask.fail(ControlFailed(ctx.path, call.order.verb, f"{type_name(type(error))}: {error_text(error)}"))
        else:
            call.give(value)
        return None

    def give(self, value: object) -> None:
        """Answer whoever waits for this order."""
        ask = self.ask
        if isinstance(ask, OrderAsk):
            ask.give(value)
            return
        try:
            ask.answer(answer_bytes(value, ask.to.path if ask.to is not None else "", self.order.verb))
        except HoldfastError as error:
            ask.fail(error)

    def undelivered(self, cell: Cell, reason: str) -> None:
        self.ask.undelivered(cell, reason)

    @property
    def is_urgent(self) -> bool:
        """Whether it goes ahead of the messages."""
        return type(self.order) is not Mark

    def runs_beside(self, cell: Cell) -> bool:
        """Whether it is obeyed beside the turn that waits: just now, or, if it looks at the state, soon."""
        if cell.actor is None or cell.more is None or cell.more.turn is None:
            return False
        if self.order.is_beside:
            QueuedOrder.run(cell.actor, self)
            return True
        if not self.order.is_look or self.has_looked or cell.ctx is None or not cell.ctx._is_open:
            return False
        self.has_looked = True
        cell.node.loop.call_soon(self._look, cell)  # Not here and now: this may be called in a turn.
        return True

    def _look(self, cell: Cell) -> None:
        """Look at the state beside the turn that rests; if it does not any more, behind it."""
        ctx, actor = cell.ctx, cell.actor
        if self.ask.is_done:
            return
        seen = None if ctx is None or actor is None else ctx._look_beside(lambda: self.order.run(cell, actor))
        if seen is not None:
            self.give(seen[0])
        else:
            self._again(cell)

    def _again(self, cell: Cell) -> None:
        """Obey it later, wherever the actor lives then."""
        if self.ask.is_done:
            return
        if cell.is_dead:
            self.undelivered(cell, "it has ended")
        else:
            cell.host.control(cell, self)


def answer_bytes(value: object, path: str, verb: str) -> bytes:
    """What an order gives, as bytes that fit into one frame.

    Raises:
        ControlFailed: it is too large to be passed on. UnsavableValue: it cannot be encoded.
    """
    data = encode_value(value)
    if len(data) > MOST_TOLD:
        done = "" if verb == GetState.verb else "it was carried out, but "
        size = f"what it gives is too large to be passed on ({len(data)} bytes, the limit is {MOST_TOLD})"
        outline = "`holdfast inspect PATH --state` without --json, or `system.outline`, shows a state in outline"
        whole = "`holdfast store export` has all of what is recorded"
        raise ControlFailed(path, verb, f"{done}{size}; {outline}; {whole}")
    return data


def order(cell: Cell, wanted: Order, timeout: float) -> asyncio.Future[Any]:
    """Give an order to the actor at `cell`.

    Returns:
        A future of what comes of it; never without an outcome.

    Raises (by the future):
        ActorStopped: nobody lives there. AskTimeout: it was not carried out in time (`handled` False), or nobody
        knows. AskFailed: the actor's process ended meanwhile. ControlFailed: it could not be carried out. SpecError:
        the actor lives in another process, and the order cannot be sent there.

    Raises (at once):
        SpecError: `timeout` is no finite number of seconds > 0.
    """
    node = cell.node
    future: asyncio.Future[Any] = node.loop.create_future()
    living = cell.living
    if living.is_dead:
        future.set_exception(lifecycle.nobody_at(living))
        return future
    ask = OrderAsk(ORDERED, None, (), timeout, NO_DEADLINE, future, living)
    node.deadlines.add(ask)
    living.host.control(living, QueuedOrder(ask, wanted))
    return future


def send_call(peer: Peer, path: str, call: QueuedOrder) -> None:
    """Give the order to the actor at `path` on the other side of a connection.

    One that cannot be sent there fails. Nothing is raised: it may come out of a queue, in the middle of a move or of a
    start that has nothing to do with it.
    """
    try:
        data = encode_value(call.order.pack(path), where=f"{call.order.verb} of {path}")
    except HoldfastError as error:
        call.ask.fail(error)
        return
    if isinstance(call.ask, OrderAsk):
        call.ask.call = call
    _send(peer, path, call.ask, call.order.verb, data)


def _send(peer: Peer, path: str, ask: Ask, verb: str, data: bytes) -> None:
    left = ask.deadline - peer.node.loop.time()
    key = peer.expect(ask)
    connection = peer.connection
    fields = {"id": key, "order": verb, "data": data, "left": left}
    connection.send(frames.Command(connection.names.to_wire(path), "control", fields), path)
    ask.started = True  # From here on we cannot know.


def take_orders(peer: Peer, cell: Cell | None = None) -> list[QueuedOrder]:
    """Take back what the process of an actor that leaves it has not carried out: it is to be ordered elsewhere.

    The actor has come to rest, so whatever was carried out has been answered. An answer that still comes is dropped.

    Args:
        cell: the actor; left out where the process is its own.
    """
    found = {
        key: ask
        for key, ask in peer.pending.items()
        if isinstance(ask, OrderAsk) and ask.call is not None and (cell is None or ask.to is cell)
    }
    peer.pending = {key: ask for key, ask in peer.pending.items() if key not in found}
    waiting = [ask for ask in found.values() if not ask.is_done]
    for ask in waiting:
        ask.started = False
    return [ask.call for ask in waiting]


def ask_status(peer: Peer, cell: Cell, timeout: float, path: str = "") -> asyncio.Future[Any]:
    """The status that the process of an actor gives of it, as it knows it at `path`, which may be another address."""
    return _ask_beside(peer, cell, "status", timeout, path)


def ask_turns(peer: Peer, cell: Cell, timeout: float) -> asyncio.Future[Any]:
    """What the process of an actor knows of its turns, as `turns_of` tells it."""
    return _ask_beside(peer, cell, "turns", timeout)


def _ask_beside(peer: Peer, cell: Cell, verb: str, timeout: float, path: str = "") -> asyncio.Future[Any]:
    """Ask what the process of an actor tells at once, also while a turn waits."""
    node = cell.node
    future: asyncio.Future[Any] = node.loop.create_future()
    ask = OrderAsk(ORDERED, None, (), timeout, NO_DEADLINE, future, cell)
    node.deadlines.add(ask)
    _send(peer, path or cell.path, ask, verb, encode_value({}))
    return future


def obey_order(guest: Guest, cell: Cell, frame: frames.Command) -> None:
    """Do what the root orders of an actor in this process.

    Raises:
        BadFrame: it is no such order.
    """
    data = frame.data
    key, verb, body, left = data.get("id"), data.get("order"), data.get("data"), data.get("left")
    if not isinstance(key, int) or not isinstance(body, bytes) or not isinstance(left, (int, float)):
        raise BadFrame(f"order {verb!r} is no order")
    deadline = guest.node.loop.time() + left
    ask = RelayedAsk(ORDERED, None, (), left, deadline, None, cell, False, guest, key)
    if cell.is_dead:
        if cell is not guest.node.root:  # Else the root hears that this life is over, and tells whoever waits.
            ask.fail(lifecycle.nobody_at(cell))
        return
    beside = {"status": status_of, "turns": turns_of}.get(str(verb))
    if beside is not None:
        ask.answer(encode_value(beside(cell)))
        return
    kind = ORDERS.get(str(verb))
    if kind is None:
        raise BadFrame(f"unknown order {verb!r}")
    try:
        fields: Any = decode_value(body, refs=cell.node.ref_at)
        call = QueuedOrder(ask, kind.unpack(fields))
    except HoldfastError as error:
        ask.fail(error)
        return
    cell.host.control(cell, call)
