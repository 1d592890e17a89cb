"""The message switch as an actor: it tells what became of the messages that came while actors were recovered."""

from __future__ import annotations

from ...actors.kernel.actor import on
from ...actors.kernel.message import Message
from .part import RecoveryPart


class LookAtHeld(Message):
    """A home has let its actor at the messages that it held."""


class MessageSwitch(RecoveryPart):
    """Tells of messages held, dropped and refused. Holding and letting in is done by the homes (`held_messages.py`)."""

    def on_start(self, restored: bool) -> None:
        recoveries, cell = self._homes.recoveries, self.ctx._cell

        def wake() -> None:
            cell.admit(cell, LookAtHeld())

        recoveries.on_held = wake
        self._tell()

    @on(LookAtHeld)
    def _look(self, message: LookAtHeld) -> None:
        self._tell()

    def _tell(self) -> None:
        held, node = self._homes.recoveries.held, self.ctx._cell.node
        while held:
            node.emit(held.popleft())
