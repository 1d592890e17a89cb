"""The message handler as an actor: it has each tick's submissions of all homes written at once.

What waits to be written stands in `homes.journal`, not here: a handler that is killed loses nothing, its next life goes
on with what it finds. If it does not come in time, the journal does its work itself.
"""

from __future__ import annotations

from ...actors.exit_reasons import ExitReason
from ...actors.kernel.actor import on
from ...actors.kernel.message import Message
from .part import RecoveryPart


class WriteSubmitted(Message):
    """Something was submitted since the last one."""


FLUSH = WriteSubmitted()


class MessageHandler(RecoveryPart):
    """Writes what was submitted, and lets what is safe take effect."""

    def on_start(self, restored: bool) -> None:
        """Take up what waits, and be woken from now on."""
        cell = self.ctx._cell
        # Not `ref.tell`: that would speak in the name of whoever has submitted something.
        self._homes.journal.wake_handler = lambda: cell.admit(cell, FLUSH)
        self._homes.journal.come()

    def on_stop(self, reason: ExitReason) -> None:
        """Be woken no more: what is submitted from now on, the journal writes by itself."""
        self._homes.journal.wake_handler = None

    @on(WriteSubmitted)
    def flush(self, message: WriteSubmitted) -> None:
        """Write what homes have submitted to the journal."""
        self._homes.journal.come()
