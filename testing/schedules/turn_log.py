"""The turns of a run, in the order in which they began, who waits for a number of them, and what they handled."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from ...actors.errors import HoldfastError, UnknownMessage
from ...actors.kernel.cell import NEXT_URGENT, Cell
from ...actors.kernel.codec import Parcel, encode_special
from ...actors.kernel.envelope import Ask, Item, ReplyHandle
from ...actors.kernel.message import Message, message_of
from ...actors.kernel.node import Node
from ...checkpoint.life.recorded_inbox import Fed
from ..library_code import is_module_of_library

MOST_BYTES: Final = 64 * 1024
"""Of a value that is kept whole; of a larger one its digest is."""


class Handled(NamedTuple):
    """A message that a turn handles, or a reply.

    Attributes:
        turn: its number in the run, from 1; of a reply that of the last turn that had begun.
        path: who handles the message, or replies.
        what: which message, by its class.
        is_reply: whether it is a reply to that.
        fields: the names of what stands in it.
        body: the bytes; "" if nothing is compared but the class.
    """

    turn: int
    path: str
    what: str
    is_reply: bool = False
    fields: tuple[str, ...] = ()
    body: bytes = b""

    def __str__(self) -> str:
        return f"the reply of {self.path} to {self.what}" if self.is_reply else f"{self.path} {self.what}"

    def is_same_kind(self, other: Handled) -> bool:
        """Whether the two differ in nothing but their values."""
        return self[:4] == other[:4]

    def differs(self, other: Handled) -> tuple[str, str, str]:
        """Where two of one class part: the field, and what each has there."""
        one, another = self._plain(), other._plain()
        names, where = self.fields, ""
        while isinstance(one, list) and isinstance(another, list) and len(one) == len(another):
            index = next((index for index, pair in enumerate(zip(one, another, strict=True)) if pair[0] != pair[1]), -1)
            if index < 0:
                break
            where += f".{names[index]}" if index < len(names) else f"[{index}]"
            one, another, names = one[index], another[index], ()
        return where.lstrip(".") or "its value", repr(one)[:80], repr(another)[:80]

    def _plain(self) -> Any:
        try:
            return msgspec.msgpack.decode(self.body, strict=False)
        except msgspec.DecodeError:  # It was too large to be kept, or has keys that Python cannot hash.
            return self.body


class HandledValues:
    """Notes the messages that turns handle, and the replies, as the codec encodes them.

    What it cannot encode stands there by its class.
    """

    def __init__(self, log: TurnLog) -> None:
        self.handled: list[Handled] = []
        self._log = log
        self._encode = msgspec.msgpack.Encoder(enc_hook=_special).encode

    def turn(self, cell: Cell, item: Any, what: str) -> None:
        """Note the message of a turn that begins."""
        fields: tuple[str, ...] = ()
        body = b""
        value = item.message if isinstance(item, Item) else item
        if isinstance(item, Fed) and value is None:
            value = Parcel(item.feed.name, bytes(item.feed.body))
        if isinstance(value, Parcel):
            fields, body = _fields(cell, value.name), value.body
        elif isinstance(value, Message) and not is_module_of_library(type(value).__module__):
            fields, body = value.__struct_fields__, self._bytes(value)
        self.handled.append(Handled(self._log.turns, cell.path, what, False, fields, _kept(body)))

    def answering(self, answer: Callable[[Any, object], None]) -> Callable[[Any, object], None]:
        """As `Ask.answer`, and note it."""

        def noted(ask: Any, reply: object) -> None:
            if ask.to is not None and not isinstance(reply, ReplyHandle) and not ask.future.done():
                kind = type(ask.message)
                if not is_module_of_library(kind.__module__):
                    fields = reply.__struct_fields__ if isinstance(reply, msgspec.Struct) else ()
                    body = _kept(self._bytes(reply))
                    self.handled.append(Handled(self._log.turns, ask.to.path, kind.__name__, True, fields, body))
            answer(ask, reply)

        return noted

    def _bytes(self, value: object) -> bytes:
        try:
            return self._encode(value)
        except Exception:  # msgspec raises what a field's own code raises: all means that it has no bytes.
            return type(value).__qualname__.encode()


def _fields(cell: Cell, name: str) -> tuple[str, ...]:
    """Of the message of this name, if the actor knows it."""
    try:
        return cell.table.kind_named(name).__struct_fields__
    except UnknownMessage:
        return ()


def _special(value: Any) -> Any:
    try:
        return encode_special(value)
    except (TypeError, HoldfastError):
        return f"<{type(value).__qualname__}>"


def _kept(body: bytes) -> bytes:
    return body if len(body) <= MOST_BYTES else hashlib.blake2b(body, digest_size=16).digest()


def parting(first: Sequence[Handled], again: Sequence[Handled]) -> tuple[Handled, Handled] | None:
    """The first of what two runs have handled that is not the same; None: there is none before one of them ends."""
    for one, other in zip(first, again, strict=False):
        if one != other:
            return one, other
    return None


class TurnLog:
    """Notes each turn in a trace.

    Args:
        trace: (address, what was handled) of each turn; before the address that of which program, if it has a name.

    Attributes:
        values: notes what is handled, too; None: nobody does.
    """

    def __init__(self, trace: list[tuple[str, str]]) -> None:
        self.values: HandledValues | None = None
        self._trace = trace
        self._names: dict[type, str] = {}
        self._places: dict[object, str] = {}  # what is written before the addresses of a node
        self._moments: list[tuple[int, asyncio.Future[None]]] = []  # after so many turns of the run

    @property
    def turns(self) -> int:
        """How many there have been."""
        return len(self._trace)

    def call(self, node: Node, name: str) -> None:
        """The place of a node has this name, or none."""
        if name:
            self._places[node] = f"{name}:"

    def note(self, cell: Cell) -> None:
        """A cell has the next turn."""
        if self._moments:
            self._tell_moments()
        queue = cell.queue
        if queue:
            item = queue[0]
            message: Any = item.message if type(item) is Ask else item
            name = self._names.get(type(message))
            if name is None:
                name = told(cell, item)
                if isinstance(message, Message):
                    self._names[type(message)] = name
            place = self._places.get(cell.node)
            self._trace.append((cell.path if place is None else place + cell.path, name))
            if self.values is not None:
                self.values.turn(cell, item, name)

    def await_turns(self, turns: int, moment: asyncio.Future[None]) -> None:
        """Have a future done after so many turns, if it is not done before."""
        self._moments.append((len(self._trace) + turns, moment))

    def _tell_moments(self) -> None:
        for number, moment in self._moments:
            if number <= len(self._trace) and not moment.done():
                moment.set_result(None)
        self._moments = [one for one in self._moments if not one[1].done()]


def told(cell: Cell, item: Any) -> str:
    """What a turn handles, in a word or two."""
    if item is NEXT_URGENT:
        commands = cell.more.urgent if cell.more is not None else None
        item = commands[0] if commands else item
    elif isinstance(item, Fed):
        feed = item.feed
        return feed.name.rpartition(":")[2] or feed.kind
    message = message_of(item)
    return type(item if message is None else message).__name__
