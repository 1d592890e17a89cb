"""How long Hypothesis looks for a simpler example when a machine has failed: five minutes are its own limit."""

from __future__ import annotations

from typing import Any, Final

from hypothesis.internal.conjecture import engine
from hypothesis.reporting import report

from ..swaps import Swaps

CUT: Final = "WARNING: Hypothesis has spent more than"
"""How Hypothesis begins to say that its time is over, whatever that was."""


class ShrinkTime:
    """Limits the shrinking that follows a failure, from `begin` to `end`."""

    def __init__(self) -> None:
        self._swaps = Swaps()
        self._is_begun = self._is_over = False

    def begin(self, seconds: float) -> None:
        """Take so many seconds for it; nothing changes if it has begun."""
        if not self._is_begun:
            self._is_begun, self._is_over = True, False
            self._swaps.put(engine, "MAX_SHRINKING_SECONDS", seconds)
            self._swaps.put(engine, "report", self._hear)

    def end(self) -> bool:
        """The simplest example is shown. Returns whether the search for it was cut short."""
        self._swaps.undo()
        self._is_begun = False
        return self._is_over

    def _hear(self, text: Any) -> None:
        if isinstance(text, str) and text.startswith(CUT):
            self._is_over = True
        else:
            report(text)
