"""Messages that wait for room at their receivers, on the receivers' side of a process border."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable
from typing import TYPE_CHECKING

import msgspec

from ..codec import Parcel, Raw
from ..errors import HoldfastError
from ..mail import Envelope
from . import frames

if TYPE_CHECKING:
    from ..cell import Cell
    from .relay import Peer

NIL = msgspec.msgpack.encode(None)


class Offered:
    """A message from the other side on its way to receivers that may have no room yet."""

    __slots__ = ("_cells", "_id", "_is_published", "_parcel", "_peer", "_sender")

    def __init__(
        self, peer: Peer, key: int, cells: list[Cell], parcel: Parcel, sender: Cell | None, *, is_published: bool
    ) -> None:
        self._peer, self._id, self._cells, self._parcel, self._sender = peer, key, cells, parcel, sender
        self._is_published = is_published

    def go_on(self, _: object = None) -> None:
        """Hand it to one receiver after the other; come back when the next one has room."""
        peer = self._peer
        if not peer.connection.is_open:
            return  # Not accepted, and lost with its sender.
        try:
            while self._cells:
                cell = self._cells[0]
                try:
                    room = cell.room()
                    if room is not None:
                        room.add_done_callback(self.go_on)
                        return
                    del self._cells[0]
                    taken = self._hand_to(cell)
                    if taken is not None:
                        asyncio.ensure_future(taken).add_done_callback(functools.partial(self._taken, cell))
                        return
                except HoldfastError as error:
                    if not self._is_published:
                        raise
                    self._cells = [other for other in self._cells if other is not cell]
                    peer.node.dead_letter(cell, self._parcel, str(error))  # One's trouble is not another's.
        except HoldfastError as error:
            self._fail(error)
        else:
            peer.connection.send(frames.Reply(self._id, Raw(NIL)))

    def _hand_to(self, cell: Cell) -> Awaitable[None] | None:
        message = self._peer.codec.message_in(cell, self._parcel.name, self._parcel.body)
        return cell.host.offer(cell, message if self._sender is None else Envelope(message, self._sender))

    def _taken(self, cell: Cell, done: asyncio.Future[None]) -> None:
        """One receiver has accepted it, or not; then come the others."""
        error = None if done.cancelled() else done.exception()
        if isinstance(error, HoldfastError):
            if not self._is_published:
                self._fail(error)
                return
            self._peer.node.dead_letter(cell, self._parcel, str(error))
        self.go_on()

    def _fail(self, error: HoldfastError) -> None:
        kind, name, body = self._peer.codec.encode_error(error)
        self._peer.connection.send(frames.Failure(self._id, kind, name, Raw(body)))
