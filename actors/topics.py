"""Topics: named many-to-many channels, in a name space of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .errors import ActorStopped, MailboxFull, StoreError, UnknownMessage

if TYPE_CHECKING:
    from .cell import Cell

NOT_TAKEN = (ActorStopped, MailboxFull, StoreError, UnknownMessage)
"""Why one subscriber may not take what is published; the others get it all the same."""


class Topics:
    """Who subscribes to what. Subscriptions belong to a life and end with it."""

    def __init__(self) -> None:
        self._cells: dict[str, dict[Cell, None]] = {}

    def subscribe(self, topic: str, cell: Cell) -> None:
        """From now on `cell` gets what is published; twice is once."""
        if not topic.startswith("/"):
            raise ValueError(f"topic {topic!r} must start with '/'")
        self._cells.setdefault(topic, {})[cell] = None
        cell.extra().topics.add(topic)

    def unsubscribe(self, topic: str, cell: Cell) -> None:
        """No more of it; unknown ones are fine."""
        cells = self._cells.get(topic)
        if cells is not None:
            cells.pop(cell, None)
            if not cells:
                del self._cells[topic]
        if cell.more is not None:
            cell.more.topics.discard(topic)

    def subscribers(self, topic: str) -> tuple[Cell, ...]:
        """In the order of subscription."""
        return tuple(self._cells.get(topic, ()))

    def names(self) -> list[str]:
        """Topics that have subscribers."""
        return sorted(self._cells)
