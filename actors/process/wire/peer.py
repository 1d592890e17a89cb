"""Messages that cross a process border: how they are sent, taken in and answered. The same on both sides."""

from __future__ import annotations

import asyncio
import math
import types
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, cast

import msgspec

from ...control.trace_tail import enveloped, follow
from ...errors import AskDeadlock, BadMessage, BadReply, HoldfastError, type_name
from ...exit_reasons import ExitReason, pack_exit, unpack_exit
from ...kernel import links
from ...kernel.address_host import AddressHost, Capacity, Home, Place, Work
from ...kernel.cell import Cell, Order
from ...kernel.codec import Codec, Parcel, Raw
from ...kernel.envelope import Ask, Chain, Envelope, Item, chain_of, message_in, waiters
from ...kernel.lifecycle import NEAR
from ...kernel.message import Message, message_name, reply_type
from ...values.declared_types import class_fields, lost_class, lost_from
from . import frames
from .connection import Connection
from .frames import BadFrame
from .pending_sends import Offered

if TYPE_CHECKING:
    from ...control.orders_lane import QueuedOrder
    from ...kernel.node import Node

Coroutine_ = types.CoroutineType


Route = tuple["Cell", Callable[[Any], Any], Callable[[Any], Any]]
"""Where messages of one type go, and what decodes one of them, or a run."""


class Peer:
    """One end of a connection, with the asks that wait for the other end."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.connection = cast("Connection", None)
        self.codec: Codec = node.codec
        self.pending: dict[int, Ask] = {}
        self._last_id = 0
        self.routes: dict[tuple[frames.Name, frames.Name], Route] = {}
        self.kinds_out: dict[type, int] = {}  # the connection's, once there is one
        self.record_taker: Callable[[str], frames.TakeRecord] = no_records  # the recovery method's, by address
        self._record_takers: dict[frames.Name, frames.TakeRecord] = {}

    # -- out --------------------------------------------------------------------------------------------------------

    def require_granted(self, path: str, order: str) -> None:
        """See whether an actor of this process may give an order to one that is outside of it; the root's may.

        Raises:
            NotGranted: it may not.
        """

    def send_item(self, cell: Cell, path: str, item: Any, number: int) -> None:
        """Send what `cell.admit` was given to the actor at `path` on the other side.

        Raises:
            BadMessage: it cannot be coded.
        """
        connection = self.connection
        source: Cell | None = None
        chain: Chain = ()
        message = item
        if isinstance(item, Item):
            if isinstance(item, Ask):
                self._send_ask(cell, path, item, number)
                return
            source, chain, message = item.sender, item.chain, item.message
        self.require_whole(path, message)
        # Names are numbered by first use: here in the order in which the other side reads them.
        to = connection.names.to_wire(path)
        name, body = self._payload(message)
        sender = None if source is None else connection.names.to_wire(source.path)
        connection.send(frames.Tell(to, name, body, number, sender, chain), path)

    def _send_ask(self, cell: Cell, path: str, ask: Ask, number: int) -> None:
        connection = self.connection
        self.require_whole(path, ask.message)
        key = self.next_id()
        until = self.node.clock.on_machine(ask.deadline)
        to = connection.names.to_wire(path)
        name, body = self._payload(ask.message)
        sender = None if ask.sender is None else connection.names.to_wire(ask.sender.path)
        frame = frames.Ask(key, to, name, body, until, number, sender, ask.chain)
        connection.send(frame, path)
        self.pending[key] = ask
        ask.started = number or True  # From here on only the page of its process knows, if that counts it.
        if len(self.pending) > 4096 and key % 1024 == 0:
            # Asks that expired are dropped: their replies, if any come, are late.
            self.pending = {key: ask for key, ask in self.pending.items() if not ask.is_done}

    def offer(self, path: str, item: Any) -> asyncio.Future[None]:
        """Send a message, or an envelope, to `path`; the future ends when it is accepted there.

        Raises:
            BadMessage: it cannot be coded.
        """
        connection, message = self.connection, message_in(item)
        self.require_whole(path, message)
        to = connection.names.to_wire(path)
        name, body = self._payload(message)
        sender = item.sender if isinstance(item, Item) else None
        source = None if sender is None else connection.names.to_wire(sender.path)
        key, accepted = self.acceptance()
        connection.send(frames.Offer(key, to, name, body, source, chain_of(item)), path)
        return accepted

    def acceptance(self) -> tuple[int, asyncio.Future[None]]:
        """A number for the other side to answer under, and the future of its answer."""
        accepted: asyncio.Future[None] = self.node.loop.create_future()
        return self.expect(Ask(_ACCEPTANCE, None, (), math.inf, math.inf, accepted)), accepted

    def accepted(self, key: int, error: HoldfastError | None) -> None:
        """Answer what the other side has sent under a number of its `acceptance`."""
        if error is None:
            self.connection.send(frames.Reply(key, NIL))
        else:
            kind, name, body = self.codec.encode_error(error)
            self.connection.send(frames.Failure(key, kind, name, Raw(body)))

    def expect(self, ask: Ask) -> int:
        """A number under which the other side shall answer this."""
        key = self.next_id()
        self.pending[key] = ask
        return key

    def next_id(self) -> int:
        """A number for a frame that is answered."""
        self._last_id += 1
        return self._last_id

    def require_whole(self, path: str, message: Any) -> None:
        """See whether all that a message holds arrives as what it is; one of a kind that was sent before does.

        Raises:
            BadMessage: a field holds a value of a subclass of what it declares.
        """
        if type(message) not in self.kinds_out and (lost := lost_class(message)):
            raise BadMessage(path, type_name(type(message)), lost)

    def _payload(self, message: Any) -> tuple[frames.Name, Any]:
        """Type name and body; a parcel is passed on as it is."""
        kind = type(message)
        known = self.kinds_out.get(kind)
        if known is not None:
            return known, message
        if kind is Parcel:
            return self.connection.names.to_wire(message.name), Raw(message.body)
        name = self.connection.names.to_wire(message_name(kind))
        # Text introduces the name with this frame: it is known from the next one on.
        if type(name) is int and not class_fields(kind):
            self.kinds_out[kind] = name
        return name, message

    def join(self, connection: Connection) -> None:
        """Speak with the other side over this connection."""
        self.connection, self.kinds_out = connection, connection.names.kinds

    def on_forget(self, frame: frames.Forget) -> None:
        """The other side gives all its names anew."""
        self.connection.names.forget_got()
        self.routes.clear()
        self._record_takers.clear()

    def fail_pending(self, error: HoldfastError) -> None:
        """The other side is gone."""
        for ask in self.take_pending():
            ask.fail(error)

    def take_pending(self) -> list[Ask]:
        """The asks that waited for the other side, now the caller's."""
        pending, self.pending = self.pending, {}
        return list(pending.values())

    def ignore_records(self) -> None:
        """What is said there from now on for a recovery method is not kept: the life has been moved away."""
        self.record_taker, self._record_takers = ignored, {}

    # -- in ---------------------------------------------------------------------------------------------------------

    def on_reply(self, frame: frames.Reply) -> None:
        """The other side answered an ask of ours."""
        ask = self.pending.pop(frame.id, None)
        if ask is None:
            return
        if isinstance(ask, RelayedAsk):
            ask.answer_raw(bytes(frame.body))
            return
        try:
            reply = self.codec.reply_decoder(type(ask.message))(frame.body)
        except Exception as error:  # msgspec's own, or what a hook raised: all say that it does not fit.
            ask.fail(BadReply(*asked(ask), str(error)))
        else:
            ask.answer(reply)

    def on_record(self, frame: frames.Record) -> None:
        """Something for the recovery method at an address."""
        take = self._record_takers.get(frame.to)
        if take is None:
            take = self.record_taker(self.connection.names.from_wire(frame.to))
            self._record_takers[self.connection.names.number_of(frame.to)] = take
        take(frame)

    def on_failure(self, frame: frames.Failure) -> None:
        """The other side failed an ask of ours."""
        ask = self.pending.pop(frame.id, None)
        if isinstance(ask, RelayedAsk):
            ask.fail_raw(frame.kind, frame.name, bytes(frame.body))
        elif ask is not None:
            ask.fail(self.codec.decode_error(frame.kind, frame.name, frame.body, *asked(ask)))

    def _message_in(self, cell: Cell, frame: frames.Tell | frames.Ask) -> Any:
        """The message in a frame. Raises UnknownMessage or BadMessage."""
        message = self.codec.message_in(cell, self.connection.names.from_wire(frame.name), frame.body)
        if type(frame.name) is int and cell is self.node.root and not cell.host.takes_parcels:
            # Our own actor's class stays: so does the way in for this type.
            kind: Any = type(message)
            self.routes[frame.to, frame.name] = cell, self.codec.decoder(kind), self.codec.decoder(list[kind])
        return message

    def _sender(self, name: frames.Name | None) -> Cell | None:
        return None if name is None else self.node.cell_at(self.connection.names.from_wire(name))

    def on_tell(self, cell: Cell, frame: frames.Tell, page: memoryview | None) -> None:
        """Take in a tell from the other side."""
        try:
            message = self._message_in(cell, frame)
        except HoldfastError as error:
            name = self.connection.names.from_wire(frame.name) if type(frame.name) is int else str(frame.name)
            sender = self._sender(frame.sender)
            self.node.dead_letter(cell, Parcel(name, bytes(frame.body)), str(error), sender)
            if page is not None:
                page[1] = frame.number
            return
        sender = self._sender(frame.sender)
        if page is not None:
            arrived = Arrived(message, sender, frame.number, page, frame.chain)
            if frame.chain:
                follow(arrived)
            cell.admit(cell, arrived)
        else:
            try:
                cell.admit(cell, enveloped(message, sender, frame.chain))
            except HoldfastError as error:
                self.node.dead_letter(cell, message, str(error), sender)

    def on_offer(self, cells: Iterable[Cell], frame: frames.Offer | frames.Publish, topic: str | None = None) -> None:
        """Take in a message whose sender waits until every one of `cells` has accepted it, or left the topic."""
        connection = self.connection
        name = connection.names.from_wire(frame.name)
        sender = None if frame.sender is None else self.node.cell_at(connection.names.from_wire(frame.sender))
        parcel = Parcel(name, bytes(frame.body))
        Offered(self, frame.id, parcel, (sender, frame.chain), topic).begin(cells)

    def ask_in(self, frame: frames.Ask, cell: Cell, page: memoryview | None) -> RelayedAsk:
        """The ask in a frame, without its message."""
        return RelayedAsk.taken(self, frame, cell, page)

    def on_ask(self, cell: Cell, frame: frames.Ask, page: memoryview | None) -> None:
        """Take in an ask; its outcome goes back over this connection."""
        ask = self.ask_in(frame, cell, page)
        try:
            try:
                ask.message = self._message_in(cell, frame)
            finally:
                if frame.sender is not None:
                    ask.sender = self._sender(frame.sender)
            if ask.chain:
                if (ctx := cell.ctx) is not None and ctx._turn_in(ask.chain):
                    raise AskDeadlock(cell.path, waiters(ask.chain))
                follow(ask)
            cell.admit(cell, ask)
        except HoldfastError as error:
            if page is not None:
                page[1] = frame.number
            ask.fail(error)


def no_records(path: str) -> frames.TakeRecord:
    """Nobody is recovered over this connection."""
    raise BadFrame(f"a record for {path}, which is not recovered")


def ignored(path: str) -> frames.TakeRecord:
    """The records of a life that has been moved away."""
    return lambda frame: None


NIL = Raw(msgspec.msgpack.encode(None))


def asked(ask: Ask) -> tuple[str, str]:
    """Who is asked, and what: the address and the type of the message, as errors name them."""
    actor, message = "another process" if ask.to is None else ask.to.path, ask.message
    if message is None:  # It was moved here with whoever is asked.
        return actor, "what it was asked"
    return actor, message.name.replace(":", ".") if type(message) is Parcel else type_name(type(message))


class Accepted(Message[None]):
    """Stands for a message whose sender waits for its acceptance only."""


_ACCEPTANCE = Accepted()


class Arrived(Envelope, eq=False):
    """A message from the home of this process's actor: the page says which one is being handled."""

    number: int
    page: Any
    chain: Chain = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        page = item.page
        page[0] = item.number
        result = actor._table[type(item.message)](actor, item.message)
        if type(result) is Coroutine_:
            return _until_done(result, item)
        page[1] = item.number
        return None

    def undelivered(self, cell: Cell, reason: str) -> None:
        """Nothing is lost: the home still has it."""

    def stashed(self) -> None:
        self.page = [0, 0]  # The real one counts in the order of arrival: a late number would undo later ones.


async def _until_done(turn: Any, item: Any) -> None:
    await turn
    item.page[1] = item.number


class RelayedAsk(Ask, eq=False):
    """An ask from the other side of a connection: its outcome becomes a frame."""

    peer: Any = None
    id: int = 0
    number: int = 0
    page: Any = None
    is_over: bool = False
    until: float = math.inf  # the deadline on the clock of the machine, which both sides read; without a frame, none

    @classmethod
    def taken(cls, peer: Peer, frame: frames.Ask, cell: Cell, page: memoryview | None) -> RelayedAsk:
        """The ask that a frame carries; its message is decoded behind it."""
        left = frame.until - peer.node.clock.machine()
        deadline = peer.node.loop.time() + left
        number, until = frame.number, frame.until
        return cls(
            None, None, frame.chain, left, deadline, None, cell, False, peer, frame.id, number, page, False, until
        )  # fmt: skip

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        page = item.page
        if page is not None:
            page[0] = item.number
        # In this order: if the page did not say so at the deadline, it is not run.
        if item.until <= item.to.node.clock.machine():
            item.expire()
            if page is not None:
                page[1] = item.number
            return None
        result = Ask.run(actor, item)
        if page is None:
            return result
        if type(result) is Coroutine_:
            return _until_done(result, item)
        page[1] = item.number
        return result

    @property
    def is_done(self) -> bool:
        return self.is_over

    def answer(self, reply: object) -> None:
        from ...kernel.envelope import AskHandle

        if type(reply) is AskHandle or self.is_over:
            return
        self.is_over = True
        connection = self.peer.connection
        kind: Any = type(self.message)
        try:
            if lost := lost_from(reply_type(kind), reply):
                raise BadMessage("", type_name(type(reply)), lost)
            connection.send(frames.Reply(self.id, cast("Any", reply)))
        except (BadMessage, TypeError) as error:  # A name in the type of the reply may not be known in its module.
            self.is_over = False
            self.fail(BadReply(*asked(self), error.problem if isinstance(error, BadMessage) else str(error)))

    def answer_raw(self, body: bytes) -> None:
        """Pass an encoded reply on."""
        if not self.is_over:
            self.is_over = True
            self.peer.connection.send(frames.Reply(self.id, Raw(body)))

    def fail(self, error: BaseException) -> None:
        if not self.is_over:
            self.tell_failure(error)
        self.fail_raw(*self.peer.codec.encode_error(error, *asked(self)))

    def fail_raw(self, kind: str, name: str, body: bytes) -> None:
        """Pass an encoded error on."""
        if not self.is_over:
            self.is_over = True
            self.peer.connection.send(frames.Failure(self.id, kind, name, Raw(body)))

    def undelivered(self, cell: Cell, reason: str) -> None:
        if self.page is None:
            super().undelivered(cell, reason)

    def stashed(self) -> None:
        if self.page is not None:
            self.page = [0, 0]  # The real one counts in the order of arrival: a late number would undo later ones.


class RemoteHome(Home):
    """The home of an address is in another process: everything goes over the connection."""

    takes_parcels = True

    def __init__(self, peer: Peer) -> None:
        self.peer = peer

    def push(self, cell: Cell, item: Item) -> None:
        send_signal(self.peer, cell.path, item)

    def offer(self, cell: Cell, item: Any) -> asyncio.Future[None]:
        return self.peer.offer(cell.path, item)

    def backlog(self, cell: Cell, running: int) -> int:
        return 0

    def load(self, cell: Cell) -> int:
        return 0

    def work(self, cell: Cell, running: int) -> Work:
        return Work()  # Its own process knows.

    def mailbox(self, cell: Cell) -> Capacity | None:
        return None

    def faulted(self, cell: Cell, by: str) -> None:
        self.peer.require_granted(cell.path, "kill")
        connection = self.peer.connection
        connection.send(frames.Command(connection.names.to_wire(cell.path), "faulted", {"by": by}))

    def admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit` of the stand-ins."""
        self.peer.send_item(cell, cell.path, item, 0)


class OutsidePlace(Place):
    """Wherever the process at the other end has an actor."""

    is_here = False
    kind = "elsewhere"

    def __init__(self, peer: Peer) -> None:
        self.peer = peer

    def start(self, cell: Cell) -> None:
        raise HoldfastError(f"{cell.path} is in another process")

    def require_order(self, cell: Cell, order: Order) -> None:
        self.peer.require_granted(cell.path, order)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        self.require_order(cell, "stop")
        self.told(cell, "stop", {"reason": pack_exit(reason)})

    def kill(self, cell: Cell) -> None:
        self.require_order(cell, "kill")
        self.told(cell, "kill", {})

    def control(self, cell: Cell, call: QueuedOrder) -> None:
        from ...control.orders_lane import send_call

        send_call(self.peer, cell.path, call)

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        connection = self.peer.connection
        connection.send(frames.Command(connection.names.to_wire(cell.path), verb, data))


class OutsideHost(AddressHost):
    """The host of stand-ins for actors in another process."""

    home: RemoteHome

    def __init__(self, peer: Peer) -> None:
        super().__init__(RemoteHome(peer), OutsidePlace(peer), NEAR)
        self.peer = peer


def send_signal(peer: Peer, path: str, item: Item) -> None:
    """Carry an EXIT or DOWN over; other items of the runtime never cross a border."""
    connection = peer.connection
    if isinstance(item, links.Exit):
        data: dict[str, Any] = {"source": item.name, "reason": pack_exit(item.reason)}
        if item.is_carried:
            data["carried"] = True
        connection.send(frames.Command(connection.names.to_wire(path), "exit", data))
    elif isinstance(item, links.Down):
        data = {
            "source": item.watch.name,
            "reason": pack_exit(item.reason),
            "recovering": item.recovering,
            "for_good": item.watch.for_good,
        }
        if item.is_carried:
            data["carried"] = True
        connection.send(frames.Command(connection.names.to_wire(path), "down", data))
    else:
        raise HoldfastError(f"{type(item).__name__} cannot be sent to {path}")


def obey(node: Node, cell: Cell, name: str, frame: frames.Command, *, by_root: bool = False) -> None:
    """Do what the other side wants of an actor on this one: stop and kill, and all about links and monitors.

    `name` is the address that it has given; the actor may have moved since. The root alone may carry a signal behind an
    actor whose tie is over: a process could end anybody by it.

    Raises:
        BadFrame, DecodeError: it is no such command.
    """
    data = frame.data
    match frame.verb:
        case "stop":
            cell.request_stop(unpack_exit(data.get("reason")))
        case "kill":
            cell.kill()
        case "hangs":
            cell.host.home.hangs(cell)
        case "faulted":
            by = data.get("by")
            cell.host.home.faulted(cell, by if isinstance(by, str) else "")
        case "exit":
            source, reason = named(node, frame, "source"), unpack_exit(data.get("reason"))
            known = cell.more.ties.links.get(source) if cell.more is not None else None
            is_carried = by_root and bool(data.get("carried"))
            if links.sever(cell, source) or is_carried:  # Else it was unlinked while this was on its way.
                cell.push(links.Exit(source, reason, known or ""))
        case "down":
            source, reason = named(node, frame, "source"), unpack_exit(data.get("reason"))
            recovering, for_good = bool(data.get("recovering")), bool(data.get("for_good"))
            carried = by_root and bool(data.get("carried"))
            links.down_arrived(cell, source, reason, recovering=recovering, for_good=for_good, is_carried=carried)
        case "monitor":
            watcher, for_good = named(node, frame, "watcher"), bool(data.get("for_good"))
            watch = links.monitor(watcher, cell, for_good=for_good, name=name)
            if data.get("life", cell.life) != cell.life:  # It was watched where its supervisor was.
                links.has_missed(watch)
        case "demonitor":
            links.demonitor(named(node, frame, "watcher"), cell, for_good=bool(data.get("for_good")))
        case "link":
            links.link(named(node, frame, "peer"), cell, name)
        case "replaces" if by_root:
            links.hand_over(named(node, frame, "was"), cell)
        case "unlink":
            links.sever(named(node, frame, "peer"), cell)
        case verb:
            raise BadFrame(f"unknown command {verb!r}")


def named(node: Node, frame: frames.Command, key: str) -> Cell:
    """The cell whose address a command gives."""
    return node.cell_at(str(frame.data[key]))
