"""Messages that have crossed a process border and wait there for room at their receivers."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable, Iterable
from typing import TYPE_CHECKING

from ...control.trace_tail import enveloped
from ...errors import HoldfastError
from ...kernel.codec import Parcel
from ...kernel.envelope import Chain

if TYPE_CHECKING:
    from ...kernel.cell import Cell
    from .peer import Peer


class Offered:
    """A message from the other side on its way to receivers that may have no room yet, each of which gets it by itself.

    It is answered when all have accepted it. What is published goes to those only who still subscribe when their room
    has come, and one's trouble is not another's; of any other message it fails the sender.
    """

    __slots__ = ("_chain", "_id", "_left", "_parcel", "_peer", "_sender", "_topic")

    def __init__(
        self, peer: Peer, key: int, parcel: Parcel, origin: tuple[Cell | None, Chain], topic: str | None
    ) -> None:
        self._peer, self._id, self._parcel, self._topic = peer, key, parcel, topic
        self._sender, self._chain = origin
        self._left = 1  # receivers that have not accepted it, and we ourselves while we begin

    def begin(self, cells: Iterable[Cell]) -> None:
        """Hand it to all that have room."""
        for cell in tuple(cells):
            self._left += 1
            self._hand_to(cell)
        self._over(None, None)

    def _hand_to(self, cell: Cell, _: object = None) -> None:
        """Hand it to one receiver, now or when it has room."""
        peer, parcel = self._peer, self._parcel
        if not peer.connection.is_open:
            return  # Not accepted, and lost with its sender.
        taken: Awaitable[None] | None = None
        try:
            if self._topic is None or peer.node.topics.has(self._topic, cell):
                room = None if cell is self._sender else cell.room()  # Who waits for itself waits for ever.
                if room is not None:
                    room.add_done_callback(functools.partial(self._hand_to, cell))
                    return
                message = peer.codec.message_in(cell, parcel.name, parcel.body)
                taken = cell.host.offer(cell, enveloped(message, self._sender, self._chain))
        except HoldfastError as error:
            self._over(cell, error)
            return
        if taken is None:
            self._over(cell, None)
        else:
            asyncio.ensure_future(taken).add_done_callback(functools.partial(self._taken, cell))

    def _taken(self, cell: Cell, done: asyncio.Future[None]) -> None:
        error = None if done.cancelled() else done.exception()
        self._over(cell, error if isinstance(error, HoldfastError) else None)

    def _over(self, cell: Cell | None, error: HoldfastError | None) -> None:
        """One receiver has it, or will not."""
        self._left -= 1
        if error is not None and cell is not None:
            if self._topic is None:
                self._peer.accepted(self._id, error)
                self._left = -1  # Answered.
                return
            self._peer.node.not_taken(cell, self._parcel, error, self._sender)
        if self._left == 0 and self._peer.connection.is_open:
            self._peer.accepted(self._id, None)
