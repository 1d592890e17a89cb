"""The time in which this process's event loop was not late: what came in meanwhile came when it was looked at."""

from __future__ import annotations

import asyncio
import math
from typing import Final

BEAT: Final = 0.1
"""Seconds between two looks at how late the loop is; by so much the time may be wrong."""


class OwnTime:
    """Seconds on the loop clock, without those for which the loop was late while that was looked at, by `keep`.

    Args:
        loop: whose time it is; its clock says when something should have been done, and when it was.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._late = loop, 0.0
        self._due = math.inf

    def now(self) -> float:
        """The time; it does not go on while the loop is late, whoever asks first behind that."""
        now = self._loop.time()
        return now - self._late - max(0.0, now - self._due)

    async def keep(self) -> None:
        """Look again and again how late the loop is; without end."""
        while True:
            self._due = self._loop.time() + BEAT
            await asyncio.sleep(BEAT)
            self._late += max(0.0, self._loop.time() - self._due)
