"""How long a program has printed nothing, as whoever reads its output has lived it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

from ...actors.observer_clock import OwnClock
from ...actors.process.process_watchdog import waited_for_processor

LOOKS: Final = 4
"""How often within `silent_after` the watch looks."""


class SilenceWatch:
    """Tells once that a program has printed nothing for too long.

    Time for which this process was late, or the program waited for a processor, is no silence.

    Args:
        loop: of whoever reads the output.
        pid: of the program.
        silent_after: seconds.
        is_excused: whether it is kept from being heard at the moment; then its silence begins anew.
        silent: told how many seconds it was.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        pid: int,
        silent_after: float,
        is_excused: Callable[[], bool],
        silent: Callable[[float], None],
    ) -> None:
        self._loop, self._pid, self._silent_after = loop, pid, silent_after
        self._is_excused, self._silent = is_excused, silent
        self._period = silent_after / LOOKS
        self._clock = OwnClock(loop.time(), self._period)
        self.heard()
        self._timer = loop.call_later(self._period, self._look)

    def heard(self) -> None:
        """Begin the silence anew: the program has printed something."""
        self._last, self._waited = self._clock.at(self._loop.time()), -1.0

    def _look(self) -> None:
        now = self._clock.tick(self._loop.time())
        if self._is_excused():
            self.heard()
        if self._waited < 0.0:
            self._waited = waited_for_processor(self._pid)  # as of the first look behind its last word
        silent = now - self._last
        if silent >= self._silent_after:
            silent -= waited_for_processor(self._pid) - self._waited
        if silent >= self._silent_after:
            self._silent(silent)
            return
        self._timer = self._loop.call_later(self._period, self._look)

    def close(self) -> None:
        """Stop looking: the program is stopped, or has ended."""
        self._timer.cancel()
