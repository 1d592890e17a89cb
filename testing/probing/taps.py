"""Wire-taps: a probe sees what goes to an address, and nothing about its way changes."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any

from ...actors.errors import BadMessage, SpecError, UnknownMessage
from ...actors.kernel import mailbox
from ...actors.kernel.cell import Cell
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Item, message_in
from ...actors.kernel.message import Message, message_of
from ...actors.kernel.ref import ActorRef
from ...actors.process.wire.peer import OutsideHost
from ...checkpoint.home.recorded_home import switch_of
from ...checkpoint.inputs import Input
from ...checkpoint.protocol import MESSAGE
from ..swaps import Swaps


class Tap:
    """What was put at an address; `close`, or the end of its context, takes it away.

    What an actor in another process sends to itself does not pass here, unless it is recorded.

    Raises:
        SpecError: the receiver shares a process with its senders: what they send does not pass here.
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
            self._record = switch.record
            self._swaps.put(switch, "admit", self._admit)
            self._swaps.put(switch, "record", self._recorded)
        else:
            _require_seen(self._cell, self._sender)
        self._swaps.put(self._cell, "admit", self._admit)

    def _admit(self, cell: Cell, item: Any) -> None:
        """Stands in `cell.admit`."""
        self._through(cell, item)  # What is refused is not seen.
        self._note(message_in(item), item.sender if isinstance(item, Item) else None)

    def _recorded(
        self, kind: str, name: str, body: bytes, sender: str | None, batch: Any = None, origin: str = ""
    ) -> Input:
        """Stands in the `record` of a switch: what one recorded actor sends to another comes with that one's turn."""
        source = self._record(kind, name, body, sender, batch, origin)
        if batch is not None and kind == MESSAGE:
            self._note(Parcel(name, body), None if sender is None else self._cell.node.cell_at(sender))
        return source

    def _note(self, found: object, sender: Cell | None) -> None:
        if not self._is_open:  # Another tap was put before this one, and still passes through it.
            return
        if self._sender is not None and sender is not self._sender:
            return
        message = _opened(self._cell, found) if isinstance(found, Parcel) else message_of(found)
        if message is not None:
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


def _opened(cell: Cell, parcel: Parcel) -> Message[Any] | None:
    """What one process sends to an actor in another; None: the actor will refuse it."""
    try:
        return message_of(cell.node.codec.message_for(cell, parcel.name, parcel.body))
    except (UnknownMessage, BadMessage):
        return None


def _require_seen(receiver: Cell, sender: Cell | None) -> None:
    """Make sure that what is tapped leaves the process in which it is sent.

    Raises:
        SpecError: it does not.
    """
    process = _process_of(receiver)
    if process is None:
        return
    if sender is None:
        who, stays = "whoever lives there, too,", isinstance(receiver.host, OutsideHost)
    else:
        who, stays = sender.path, switch_of(sender) is None and _process_of(sender) is process
    if stays:
        raise SpecError(
            "tap",
            f"{receiver.path} lives in another process, and what {who} sends to it never leaves that: "
            "tap(sender, receiver) with a sender outside of it",
        )


def _process_of(cell: Cell) -> object:
    """The process that an actor lives in; None: that of the system."""
    above: Cell | None = cell
    while above is not None:
        process = above.host.place.process(above)
        if process is not None:
            return process
        above = above.parent
    return None
