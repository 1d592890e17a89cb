"""Topics: named many-to-many channels, in a name space of their own."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from ..errors import (
    ActorStopped,
    AskFailed,
    ConnectionFull,
    ConnectionLost,
    MailboxFull,
    StoreError,
    UnknownMessage,
    Unreachable,
)
from .message import require_message

if TYPE_CHECKING:
    from .cell import Cell
    from .message import Message
    from .node import Node

NOT_TAKEN = (
    ActorStopped,
    AskFailed,  # Its process has ended, which was to say that it has the message.
    ConnectionFull,
    ConnectionLost,
    MailboxFull,
    StoreError,
    UnknownMessage,
    Unreachable,
)
"""Why one subscriber may not take what is published; the others get it all the same."""


class Topics:
    """Who subscribes to what. Subscriptions belong to a life and end with it."""

    def __init__(self) -> None:
        self._cells: dict[str, dict[Cell, None]] = {}

    def subscribe(self, topic: str, cell: Cell) -> None:
        """From now on `cell` gets what is published; twice is once."""
        self._cells.setdefault(topic, {})[cell] = None
        cell.extra().belongings.topics.add(topic)

    def unsubscribe(self, topic: str, cell: Cell) -> None:
        """No more of it; unknown ones are fine."""
        cells = self._cells.get(topic)
        if cells is not None:
            cells.pop(cell, None)
            if not cells:
                del self._cells[topic]
        if cell.more is not None:
            cell.more.belongings.topics.discard(topic)

    def subscribers(self, topic: str) -> tuple[Cell, ...]:
        """In the order of subscription."""
        return tuple(self._cells.get(topic, ()))

    def has(self, topic: str, cell: Cell) -> bool:
        """Whether `cell` gets what is published there now."""
        return cell in self._cells.get(topic, ())

    def names(self) -> list[str]:
        """The topics that have subscribers."""
        return sorted(self._cells)


async def publish(
    node: Node,
    topic: str,
    message: Message[Any],
    send: Callable[[Cell], Awaitable[None]],
    publisher: Cell | None = None,
) -> None:
    """Send to every subscriber, and return when each has accepted.

    Each gets it as soon as it has room: one that is full holds the publisher back, not the others. Whoever does not
    subscribe any more when its room has come does not get it.

    Args:
        send: sends the message to one cell; raises one of `NOT_TAKEN` if that does not take it.
        publisher: an actor that publishes in its turn, which makes no room while it waits: `send` decides at once.

    Raises:
        BadMessage: this is no message.
    """

    require_message(topic, message)

    async def send_to(cell: Cell) -> None:
        try:
            while node.topics.has(topic, cell):
                room = None if cell is publisher else cell.room()
                if room is None:
                    await send(cell)
                    break
                await room
        except NOT_TAKEN as error:
            node.not_taken(cell, message, error, publisher)

    waiting: list[asyncio.Task[None]] = []
    try:
        for cell in node.topics.subscribers(topic):
            if cell is publisher or cell.has_room:
                await send_to(cell)
            else:
                waiting.append(node.loop.create_task(send_to(cell), name=f"publish to {cell.path}"))
        if waiting:
            await asyncio.gather(*waiting)
    finally:
        for task in waiting:
            task.cancel()
