"""A topic that must not be silent for long, whatever its rate."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from ..literals import Literal, atom_of, ok
from .observer import Manner, Observer


class TimeoutObserver(Observer):
    """Not ok when nothing has come for too long; also when nothing has ever come since this observer began.

    Args:
        topic: what it hears.
        timeout: seconds.
        atom: what is said; `ok(topic)` unless given.
        manner: see `Observer`.
    """

    def __init__(
        self, topic: str, timeout: float, *, atom: Literal | str | None = None, manner: Manner | None = None
    ) -> None:
        super().__init__(topic, manner=manner)
        if not timeout > 0:
            raise ValueError(f"timeout is {timeout!r}; it must be > 0 seconds")
        self._timeout = timeout
        self._atom = ok(topic) if atom is None else atom_of(atom)
        self._last: float | None = None
        self._since = -math.inf

    def hear(self, topic: str, message: Any) -> None:
        """Something came: that is good at once, if it was not."""
        self._last = self.now
        if self.said(self._atom) is not True:
            self.verdict(self._atom, True)

    def afresh(self, names: Collection[str]) -> None:
        """Count the time of silence from now on."""
        self._last, self._since = None, self.now

    def look(self) -> None:
        """Whether it has been too long."""
        since = self.now - (max(self._began, self._since) if self._last is None else self._last)
        if since > self._timeout:
            self.verdict(self._atom, False)
        elif self._last is not None:
            self.verdict(self._atom, True)
