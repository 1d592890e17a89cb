"""Stopping an actor from outside, and waiting for its end."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from ..exit_reasons import SHUTDOWN, ExitReason

if TYPE_CHECKING:
    from .cell import Cell

PATIENCE = 5.0
"""Seconds an actor that nobody supervises may take to stop in good order before it is killed."""


async def stop_in_time(cell: Cell, reason: ExitReason = SHUTDOWN) -> ExitReason:
    """Stop an actor that has no spec to say how: ask, wait, kill."""
    timer = cell.node.loop.call_later(PATIENCE, cell.kill)
    try:
        return await stop_and_wait(cell, reason)
    finally:
        timer.cancel()


def stop_and_wait(cell: Cell, reason: ExitReason = SHUTDOWN) -> asyncio.Future[ExitReason]:
    """Ask for an end in good order; the future has the reason it really ended with."""
    gone = cell.ended()
    cell.request_stop(reason)
    return gone
