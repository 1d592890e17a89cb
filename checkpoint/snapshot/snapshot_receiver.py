"""Receives snapshots at home, in pieces or as an image, and tries again when one could not be kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...actors.errors import HoldfastError
from ...actors.events import SnapshotTaken
from ...actors.kernel.message import message_name
from ..protocol import Snapshot, SnapshotNow
from .snapshot_record import cut

if TYPE_CHECKING:
    from ...actors.kernel.actor import Start
    from ..home.switch import Switch


class SnapshotReceiver:
    """The snapshot that is on its way to one home."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._pieces: list[bytes] = []
        self.becomes: Start[Any] | None = None  # with what the next lives begin once its class's state has come
        self._is_ahead = False  # of the life, which does not know yet that its state is another one
        self.unsaved: list[str] = []  # why, for each state put in place from outside that could not be kept

    def cancel(self) -> None:
        """The life is over: what has come of it will not be complete."""
        self._is_ahead = False
        self._pieces.clear()
        self._home.images.cancel()

    def take_ahead(self, records: list[Snapshot]) -> None:
        """Take what the present life will be told to go on with. What it saves before it is, is of no use any more."""
        self.cancel()
        for record in records:
            self.take(record)
        self._is_ahead = bool(records)

    def take(self, record: Snapshot) -> None:
        """One more piece, or an image; the last piece completes it."""
        home = self._home
        if self._is_ahead and not record.is_replaced:
            return
        if record.image is not None:
            home.images.take(record, record.image)
            return
        self._pieces.append(record.data)
        if not record.is_last:
            return
        self._is_ahead = False
        state = b"".join(self._pieces)
        self._pieces.clear()
        if record.turn < home.ledger.state_turn and not record.is_replaced:
            return  # A later one is here.
        try:
            cut(home, state, record)
        except HoldfastError as error:
            self._refused(record, error)
            return
        becomes = self.becomes
        kind = "" if becomes is None or not record.is_replaced else message_name(becomes.kind)
        if becomes is not None and home.cell is not None and record.kind == kind:
            # Now: the answer to whoever has replaced the code may never come.
            home.node.ports.respec(home.cell, becomes)
        home.limit.cut()
        home.due.kept(record.turn)
        if home.node.events.has_listeners:
            home.node.emit(SnapshotTaken(home.path, record.turn, len(state), record.pause, len(state)))

    def _refused(self, record: Snapshot, error: HoldfastError) -> None:
        """It could not be kept: the older snapshot and the whole journal are still there."""
        home = self._home
        home.due.failed(str(error))
        if home.life.port is not None:
            home.life.port.to_life(SnapshotNow(at_once=False))
        if record.is_replaced and home.cell is not None:
            home.life.is_void = True
            self.unsaved.append(str(error))
            home.cell.kill()
