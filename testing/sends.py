"""Checks of what is sent, in tests only: each message has the types it declares, and nobody mutates it afterwards.

A message is shared by its sender and its receivers, and in process nothing copies it: a list in it that is changed
after the send changes under the receiver's hands (and not for one in another process). So it is encoded when it is
sent, and again when its turn is over.
"""

from __future__ import annotations

from typing import Any

import msgspec

from ..actors.errors import BadMessage, type_name
from ..actors.kernel.cell import Cell
from ..actors.kernel.context import ActorContext
from ..actors.kernel.message import Message, message_of
from ..actors.kernel.node import Node
from ..actors.kernel.ref import ActorRef, current
from .swaps import Swaps
from .turns import TurnWatcher, watch_turns

MOST = 10_000
"""Messages on their way that are kept for the comparison; of more, the oldest are forgotten."""


class Sent:
    """A message on its way, `turns` times."""

    __slots__ = ("body", "message", "sender", "turns")

    def __init__(self, message: Message[Any], body: bytes, sender: str) -> None:
        self.message, self.body, self.sender, self.turns = message, body, sender, 0


class SendChecks(TurnWatcher):
    """The checks of one node, from here to `close`."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.is_expected = False
        self._sent: dict[int, Sent] = {}
        self._mutated: list[str] = []
        self._doors = Doors.opened()
        self._doors.checks[node] = self
        self._unwatch = watch_turns(node, self)

    def check(self, cell: Cell, message: object) -> None:
        """Look at a message at the moment it is sent.

        Raises:
            BadMessage: a field has another type than it declares.
        """
        if not isinstance(message, Message):
            return
        kind = type(message)
        try:
            body = self.node.codec.encode(message, cell.path)
        except BadMessage:
            return  # It can be sent in process only, where whatever it holds goes by reference.
        try:
            self.node.codec.decode(kind, body)
        except msgspec.ValidationError as error:
            raise BadMessage(cell.path, type_name(kind), str(error)) from error
        sent = self._sent.get(id(message))
        if sent is None:
            sender = current.get(None)
            sent = self._sent[id(message)] = Sent(message, body, "the test" if sender is None else sender.path)
            if len(self._sent) > MOST:
                del self._sent[next(iter(self._sent))]
        sent.turns += 1

    def ended(self, cell: Cell, item: Any) -> None:
        """A turn is over: what it handled must be what was sent."""
        message = message_of(item)
        sent = self._sent.get(id(message))
        if sent is None:
            return
        sent.turns -= 1
        if not sent.turns:
            del self._sent[id(message)]
        try:
            same = self.node.codec.encode(message, cell.path) == sent.body
        except BadMessage:
            same = False
        if not same:
            was = self.node.codec.decode(type(sent.message), sent.body)
            self._mutated.append(
                f"  from {sent.sender} to {cell.path}: sent {was!r}, after its turn it was {message!r}"
            )

    def problem(self) -> str | None:
        """The mutated messages, as text."""
        if not self._mutated or self.is_expected:
            return None
        head = f"{len(self._mutated)} messages were mutated after they were sent; send a copy"
        return "\n".join([head, *self._mutated])

    def close(self) -> None:
        """No more checks."""
        self._unwatch()
        self._doors.close(self.node)
        self._sent.clear()


class Doors:
    """The ways in which messages are sent, exchanged for ones that check, while any node wants that."""

    def __init__(self) -> None:
        self.checks: dict[Node, SendChecks] = {}
        self._swaps = Swaps()
        for owner, name in ((ActorRef, "tell"), (ActorRef, "ask"), (ActorRef, "send")):
            self._swaps.put(owner, name, self._through_ref(getattr(owner, name)))
        self._swaps.put(ActorContext, "send", self._through_context(ActorContext.send))

    @staticmethod
    def opened() -> Doors:
        """Those that stand open, or new ones."""
        standing = getattr(ActorRef.tell, "doors", None)
        return standing if isinstance(standing, Doors) else Doors()

    def close(self, node: Node) -> None:
        """This node needs them no more."""
        self.checks.pop(node, None)
        if not self.checks:
            self._swaps.undo()

    def _through_ref(self, send: Any) -> Any:
        def checked(ref: ActorRef[Any], message: Message[Any], *rest: Any, **options: Any) -> Any:
            self._check(ref._cell, message)
            return send(ref, message, *rest, **options)

        checked.doors = self  # type: ignore[attr-defined]  # so that another system finds them
        return checked

    def _through_context(self, send: Any) -> Any:
        def checked(ctx: ActorContext, cell: Cell, message: Message[Any]) -> Any:
            self._check(cell, message)
            return send(ctx, cell, message)

        return checked

    def _check(self, cell: Cell, message: Message[Any]) -> None:
        checks = self.checks.get(cell.node)
        if checks is not None:
            checks.check(cell, message)
