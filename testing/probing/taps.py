"""Wire-taps: a probe sees what goes to an address, and nothing about its way changes."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any

from ...actors.kernel import mailbox
from ...actors.kernel.cell import Cell
from ...actors.kernel.envelope import Item
from ...actors.kernel.message import Message, message_of
from ...actors.kernel.ref import ActorRef
from ...checkpoint.home.recorded_home import switch_of
from ..swaps import Swaps


class Tap:
    """What was put at an address; `close`, or the end of its context, takes it away.

    What an actor in another process, or in a subtree there, sends to an actor of the same process does not pass here.
    """

    def __init__(
        self, receiver: ActorRef[Any], sender: ActorRef[Any] | None, hear: Callable[[Message[Any], Any], None]
    ) -> None:
        self._cell: Cell = receiver._cell
        self._sender: Cell | None = None if sender is None else sender._cell
        self._hear = hear
        self._through = self._cell.admit
        self._is_open = True
        self._swaps = Swaps()
        switch = switch_of(self._cell)
        if switch is not None:  # A recorded actor's is put there at each life.
            self._swaps.put(switch, "admit", self._admit)
        self._swaps.put(self._cell, "admit", self._admit)

    def _admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`."""
        self._through(cell, item)  # What is refused is not seen.
        if not self._is_open:  # Another tap was put before this one, and still passes through it.
            return
        message = message_of(item)
        sender = item.sender if isinstance(item, Item) else None
        if message is not None and (self._sender is None or sender is self._sender):
            self._hear(message, None if sender is None else sender.ref)

    def close(self) -> None:
        """Hear no more. A second call does nothing."""
        cell = self._cell
        self._is_open = False
        self._swaps.undo()
        if cell.admit is mailbox.admit_first and cell.queue is not None:
            cell.admit = mailbox.admit_queue

    def __enter__(self) -> Tap:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
