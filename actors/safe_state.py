"""The receiving side of safe state: what an actor is told, and the dead man's switch of its process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .events import SafeStateOverdue
from .kernel.message import Message

if TYPE_CHECKING:
    from .kernel.cell import Cell


class SafeStateChange(Message):
    """Told to actors that depend on one whose recovery begins, or is over; every actor handles it.

    `timeout` seconds after it has begun, the receiver that has not heard of the end raises an alarm.
    """

    entered: bool
    because: str
    timeout: float


def watch(cell: Cell, change: SafeStateChange) -> None:
    """Start the dead man's switch, or stop it: whoever should tell of the end may be no more."""
    safe, path = cell.node.safe, cell.path
    timer = safe.pop(path, None)
    if timer is not None:
        timer.cancel()
    if change.entered:
        safe[path] = cell.node.loop.call_later(change.timeout, _overdue, cell, change)


def _overdue(cell: Cell, change: SafeStateChange) -> None:
    """It stays safe: nobody has said that it may go on."""
    cell.node.safe.pop(cell.path, None)
    cell.node.emit(SafeStateOverdue(cell.path, change.timeout, change.because))
