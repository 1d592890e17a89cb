"""Ears of observers: one for each topic, so that it is known which topic a message came on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...actors.errors import UnknownMessage
from ...actors.kernel.actor import Actor, Start, on
from ...actors.kernel.envelope import Table
from ...actors.kernel.mailbox import bounded
from ...actors.kernel.message import Message, message_name
from ...actors.kernel.ref import ActorRef

HEARD: int = 1000
"""Messages that may wait at an ear; of more, the oldest are not heard."""


class Heard(Message):
    """A message was published on a topic; `sender` is the publisher's address, if it is an actor."""

    topic: str
    message: Any
    sender: str | None = None


class Ear(Actor):
    """Passes on what comes on one topic."""

    deterministic = False

    def __init__(self, topic: str, to: ActorRef[Any]) -> None:
        self._topic, self._to = topic, to

    def on_start(self, restored: bool) -> None:
        """Subscribe to the topic that it hears."""
        self.ctx.subscribe(self._topic)

    @on(Message)
    def _pass_on(self, message: Message[Any]) -> None:
        sender = self.ctx.sender
        self._to.tell(Heard(self._topic, message, None if sender is None else sender.path))


class Everything(Table):
    """Knows every loaded message class, also by the name under which it comes from another process."""

    def kind_named(self, name: str) -> type[Message[Any]]:
        """The class. Raises UnknownMessage if this process has not loaded it."""
        kind = self.named.get(name)
        if kind is None:
            kind = next((kind for kind in _all_messages() if message_name(kind) == name), None)
            if kind is None:
                raise UnknownMessage("an observer", name.replace(":", "."))
            self.named[name] = kind
        return kind


def _all_messages() -> Iterator[type[Message[Any]]]:
    waiting: list[type[Message[Any]]] = [Message]
    while waiting:
        kind = waiting.pop()
        yield kind
        waiting.extend(kind.__subclasses__())


_heard = Everything()
_heard.update(Ear._table)
Ear._table = _heard


def listen(actor: Actor, topic: str) -> None:
    """Have `actor` get a `Heard` for each message on a topic; if the ear ends in a crash, so does the actor.

    Publishers never wait for an ear.
    """
    ctx = actor.ctx
    ear = ctx._cell.node.spawn(
        Start(Ear, (topic, ctx.ref)), parent=ctx._cell, mailbox=bounded(HEARD, overflow="drop_oldest")
    )
    ctx.link(ear.ref)
