"""Messages that cross a process border: how they are sent, taken in and answered. The same on both sides."""

from __future__ import annotations

import types
from typing import TYPE_CHECKING, Any, cast

import msgspec

from ..codec import Codec, Parcel, Raw
from ..errors import BadMessage, HoldfastError, UnknownMessage
from ..mail import Ask, Chain, Envelope, Item
from ..message import Message, by_name, message_name
from . import frames
from .connection import Connection

if TYPE_CHECKING:
    from ..cell import Cell
    from ..node import Node

Coroutine_ = types.CoroutineType


class Peer:
    """One end of a connection, with the asks that wait for the other end."""

    def __init__(self, node: Node, connection: Connection | None = None) -> None:
        self.node = node
        self.connection = cast("Connection", connection)
        self.pending: dict[int, Ask] = {}
        self._kinds: dict[tuple[int, str], Any] = {}
        self._last_id = 0

    @property
    def codec(self) -> Codec:
        """The node's codec."""
        return self.node.codec

    # -- out --------------------------------------------------------------------------------------------------------

    def send_item(self, cell: Cell, path: str, item: Any, number: int) -> None:
        """Send what `cell.admit` was given to the actor at `path` on the other side.

        Raises:
            BadMessage: it cannot be coded.
        """
        connection = self.connection
        kind = type(item)
        if kind is Envelope:
            sender, message = connection.name_out(item.sender.path), item.message
        elif isinstance(item, Ask):
            self._send_ask(cell, path, item, number)
            return
        else:
            sender, message = None, item
        name, body = self._payload(message)
        connection.send(frames.Tell(connection.name_out(path), name, body, number, sender), path)

    def _send_ask(self, cell: Cell, path: str, ask: Ask, number: int) -> None:
        connection = self.connection
        self._last_id = key = self._last_id + 1
        sender = None if ask.sender is None else connection.name_out(ask.sender.path)
        left = ask.deadline - self.node.loop.time()
        name, body = self._payload(ask.message)
        frame = frames.Ask(key, connection.name_out(path), name, body, left, number, sender, ask.chain)
        connection.send(frame, path)
        self.pending[key] = ask
        ask.started = True  # From here on we cannot know.
        if len(self.pending) > 4096 and key % 1024 == 0:
            self._forget_done()

    def _payload(self, message: Any) -> tuple[frames.Name, Any]:
        """Type name and body; a parcel is passed on as it is."""
        if type(message) is Parcel:
            return self.connection.name_out(message.name), Raw(message.body)
        return self.connection.name_out(message_name(type(message))), message

    def _forget_done(self) -> None:
        """Drop asks that expired: their replies, if any come, are late."""
        self.pending = {key: ask for key, ask in self.pending.items() if not ask.is_done}

    def fail_pending(self, error: HoldfastError) -> None:
        """The other side is gone."""
        pending, self.pending = self.pending, {}
        for ask in pending.values():
            ask.fail(error)

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
            reply = self.codec.decode_reply(type(ask.message), frame.body)
        except msgspec.DecodeError as error:
            ask.fail(BadMessage("reply", message_name(type(ask.message)), str(error)))
        else:
            ask.answer(reply)

    def on_failure(self, frame: frames.Failure) -> None:
        """The other side failed an ask of ours."""
        ask = self.pending.pop(frame.id, None)
        if isinstance(ask, RelayedAsk):
            ask.fail_raw(frame.kind, frame.name, bytes(frame.body))
        elif ask is not None:
            ask.fail(self.codec.decode_error(frame.kind, frame.name, frame.body))

    def message_in(self, cell: Cell, name: str, body: Any) -> Any:
        """A message for a cell: decoded if its actor is here, else as it came.

        Raises:
            UnknownMessage: its class has no handler for this name. BadMessage: the payload does not fit the type.
        """
        if cell.host.takes_parcels:
            return Parcel(name, bytes(body))
        table = cell.table
        key = (id(table), name)
        kind = self._kinds.get(key)
        if kind is None:
            kind = by_name(table).get(name)
            if kind is None:
                raise UnknownMessage(cell.path, name.replace(":", "."))
            self._kinds[key] = kind
        try:
            return self.codec.decode(kind, body)
        except msgspec.DecodeError as error:
            raise BadMessage(cell.path, name.replace(":", "."), str(error)) from error

    def on_tell(self, cell: Cell, frame: frames.Tell, page: memoryview | None) -> None:
        """Take in a message."""
        connection = self.connection
        name = connection.name_in(frame.name)
        sender = None if frame.sender is None else self.node.cell_at(connection.name_in(frame.sender))
        try:
            message = self.message_in(cell, name, frame.body)
        except HoldfastError as error:
            self.node.dead_letter(cell, Parcel(name, bytes(frame.body)), str(error))
            if page is not None:
                page[1] = frame.number
            return
        if page is not None:
            cell.admit(cell, Arrived(message, sender, frame.number, page))
        else:
            try:
                cell.admit(cell, message if sender is None else Envelope(message, sender))
            except HoldfastError as error:
                self.node.dead_letter(cell, message, str(error))

    def on_ask(self, cell: Cell, frame: frames.Ask, page: memoryview | None) -> None:
        """Take in an ask; its outcome goes back over this connection."""
        connection = self.connection
        name = connection.name_in(frame.name)
        sender = None if frame.sender is None else self.node.cell_at(connection.name_in(frame.sender))
        ask = RelayedAsk(self, frame, sender, page)
        try:
            ask.message = self.message_in(cell, name, frame.body)
            if ask.chain and (ctx := cell.ctx) is not None and ctx.turn_in(ask.chain):
                from ..errors import AskDeadlock

                raise AskDeadlock(cell.path, tuple(path for path, _ in ask.chain))
            cell.admit(cell, ask)
        except HoldfastError as error:
            if page is not None:
                page[1] = frame.number
            ask.fail(error)


class Arrived(Envelope):
    """A message from the home of this process's actor: the page says which one is being handled."""

    __slots__ = ("number", "page")

    def __init__(self, message: Message[Any], sender: Cell | None, number: int, page: memoryview) -> None:
        self.message, self.sender, self.number, self.page = message, cast("Any", sender), number, page

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


async def _until_done(turn: Any, item: Any) -> None:
    await turn
    item.page[1] = item.number


class RelayedAsk(Ask):
    """An ask from the other side of a connection: its outcome becomes a frame."""

    __slots__ = ("_done", "_id", "_peer", "number", "page")

    def __init__(self, peer: Peer, frame: frames.Ask, sender: Cell | None, page: memoryview | None) -> None:
        deadline = peer.node.loop.time() + frame.left
        super().__init__(cast("Any", None), sender, cast("Chain", frame.chain), frame.left, deadline, cast("Any", None))
        self._peer, self._id, self._done = peer, frame.id, False
        self.number, self.page = frame.number, page

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        page = item.page
        if page is None:
            return Ask.run(actor, item)
        page[0] = item.number
        result = Ask.run(actor, item)
        if type(result) is Coroutine_:
            return _until_done(result, item)
        page[1] = item.number
        return result

    @property
    def is_done(self) -> bool:
        return self._done

    def answer(self, reply: object) -> None:
        from ..mail import ReplyHandle

        if type(reply) is ReplyHandle or self._done:
            return
        self._done = True
        connection = self._peer.connection
        try:
            connection.send(frames.Reply(self._id, cast("Any", reply)))
        except BadMessage as error:
            self._done = False
            self.fail(BadMessage("reply", error.message, error.problem))

    def answer_raw(self, body: bytes) -> None:
        """Pass an encoded reply on."""
        if not self._done:
            self._done = True
            self._peer.connection.send(frames.Reply(self._id, Raw(body)))

    def fail(self, error: BaseException) -> None:
        kind, name, body = self._peer.codec.encode_error(error)
        self.fail_raw(kind, name, body)

    def fail_raw(self, kind: str, name: str, body: bytes) -> None:
        """Pass an encoded error on."""
        if not self._done:
            self._done = True
            self._peer.connection.send(frames.Failure(self._id, kind, name, Raw(body)))

    def undelivered(self, cell: Cell, reason: str) -> None:
        if self.page is None:
            super().undelivered(cell, reason)


class OutsideHost:
    """The host of stand-ins for actors in other processes: everything goes over the connection."""

    takes_parcels = True

    def __init__(self, peer: Peer) -> None:
        self._peer = peer

    def start(self, cell: Cell) -> None:
        raise HoldfastError(f"{cell.path} is in another process")

    def stop(self, cell: Cell, reason: Any) -> None:
        from ..exits import pack_exit

        self.command(cell, "stop", {"reason": pack_exit(reason)})

    def kill(self, cell: Cell) -> None:
        self.command(cell, "kill", {})

    def retired(self, cell: Cell) -> None:
        pass

    def push(self, cell: Cell, item: Item) -> None:
        send_signal(self._peer, cell.path, item)

    def command(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        """Send a command to the actor."""
        connection = self._peer.connection
        connection.send(frames.Command(connection.name_out(cell.path), verb, data))

    def admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit` of the stand-ins."""
        self._peer.send_item(cell, cell.path, item, 0)


def send_signal(peer: Peer, path: str, item: Item) -> None:
    """Carry an EXIT or DOWN over; other items of the runtime never cross a border."""
    from ..exits import pack_exit
    from ..links import Down, Exit

    connection = peer.connection
    if isinstance(item, Exit):
        data: dict[str, Any] = {"source": item.source.path, "reason": pack_exit(item.reason)}
        connection.send(frames.Command(connection.name_out(path), "exit", data))
    elif isinstance(item, Down):
        data = {"source": item.watch.target.path, "reason": pack_exit(item.reason), "recovering": item.recovering}
        connection.send(frames.Command(connection.name_out(path), "down", data))
    else:
        raise HoldfastError(f"{type(item).__name__} cannot be sent to {path}")
