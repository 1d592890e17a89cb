"""The proxy: what the home feeds goes out in one batch at a time, and each outcome comes home once (A44, A54)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..actors.actor import Actor, on
from ..actors.bindings import Binding
from ..actors.errors import HoldfastError
from ..actors.message import Message
from .group import Flush
from .messages import Done, Outward

if TYPE_CHECKING:
    from .group import Group


class Settle(Message[None]):
    """Answered when all that came before it has been taken."""


class Proxy(Actor):
    """Between the home of a protected actor and the replica that leads. All it knows is in the group."""

    deterministic = False

    protocol: Binding[Actor]
    """Of the replica that leads."""

    def __init__(self, group: Group) -> None:
        self._group = group

    def on_start(self, restored: bool) -> None:
        """The last life may have taken an outcome, or a batch to send, and not come to its end."""
        group = self._group
        if group.out is not None:
            group.send_again()
        self._send()

    @on(Flush)
    def flush(self, message: Flush) -> None:
        """There is something to send."""
        self._send()

    @on(Done)
    def done(self, done: Done) -> Any:
        """Outcomes have come."""
        self._group.take_done(done)
        self._send()

    @on(Outward)
    def outward(self, outward: Outward) -> None:
        """Something leaves in the middle of a turn."""
        self._group.take_outward(outward)

    @on(Settle)
    def settle(self, message: Settle) -> None:
        """Nothing is left to do."""

    def _send(self) -> None:
        group = self._group
        group.is_poked = False
        inward = group.next_inward()
        if inward is not None:
            self._tell(inward)
        finished, group.finished = group.finished, []
        for ended in finished:
            self._tell(ended)
        work = group.next_work()
        if work is not None:
            self._tell(work)

    def _tell(self, message: Message[Any]) -> None:
        name = self._group.primary
        cell = None if name is None else self._group.cell_of(f"{name}/protocol")
        if cell is None:
            return  # It has died: all of it goes to the next one.
        try:
            cell.ref.tell(message)
        except HoldfastError:
            return  # The same.
