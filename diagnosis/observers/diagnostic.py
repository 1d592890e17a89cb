"""Rules over published values: `temp_cpu1 < 40.0 <=> ok(temp_cpu1)` (D18)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

import msgspec

from ..literals import Literal, atom_of
from .observer import Manner, Observer
from .verdicts import Filter, Limits, Read, reader


class Check(msgspec.Struct, frozen=True):
    """While the value is within limits, the atom holds.

    Attributes:
        atom: such as `ok(temp_cpu1)`.
        read: where the value is in a message.
        limits: what is good.
        filter: makes a filter that the values go through, such as `partial(Median, 5)`.
    """

    atom: Literal | str
    read: Read
    limits: Limits
    filter: Callable[[], Filter] | None = None


class _Checked:
    def __init__(self, check: Check) -> None:
        self.atom, self.read, self.limits = atom_of(check.atom), reader(check.read), check.limits
        self._new_filter = check.filter
        self.time = 0.0
        self.afresh()

    def afresh(self) -> None:
        """Forget what was filtered so far, so that the filter begins anew."""
        self.filter = self._new_filter() if self._new_filter is not None else None


class DiagnosticObserver(Observer):
    """Checks values in the messages of a topic; a value that does not come any more is unknown.

    Args:
        topic: where they are published.
        checks: what is checked. A message without the value says nothing.
        manner: see `Observer`.
    """

    def __init__(self, topic: str, checks: Iterable[Check], *, manner: Manner | None = None) -> None:
        super().__init__(topic, manner=manner)
        self._checks = [_Checked(check) for check in checks]

    def hear(self, topic: str, message: Any) -> None:
        """Check what is in it."""
        for check in self._checks:
            value = check.read(message)
            if value is not None:
                check.time = self.now
                filtered = value if check.filter is None else check.filter(value)
                self.verdict(check.atom, check.limits.holds(filtered, self.said(check.atom)))

    def afresh(self, names: Collection[str]) -> None:
        """Filters forget what came before."""
        for check in self._checks:
            check.afresh()

    def look(self) -> None:
        """What has not come within its time to live is unknown."""
        for check in self._checks:
            if self.now - check.time > self.manner.time_to_live:
                self.verdict(check.atom, None)
