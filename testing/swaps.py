"""Swaps: attributes exchanged for a while and put back, last first. Production code pays nothing for being testable."""

from __future__ import annotations

from types import TracebackType
from typing import Any


class Swaps:
    """A list of exchanged attributes; leaving the context puts every one back.

    >>> class Lamp: colour = "red"
    >>> with Swaps() as swaps:
    ...     swaps.put(Lamp, "colour", "green")
    ...     Lamp.colour
    'green'
    >>> Lamp.colour
    'red'
    """

    def __init__(self) -> None:
        self._made: list[tuple[Any, str, bool, Any]] = []

    def put(self, owner: Any, name: str, value: Any) -> None:
        """Set an attribute of an object, class or module until `undo`."""
        own = getattr(owner, "__dict__", None)
        had = own is None or name in own  # Slots always have it; what comes from the class is deleted again.
        self._made.append((owner, name, had, getattr(owner, name)))
        setattr(owner, name, value)

    def undo(self) -> None:
        """Put everything back; a second call changes nothing."""
        while self._made:
            owner, name, had, value = self._made.pop()
            if had:
                setattr(owner, name, value)
            else:
                delattr(owner, name)

    def __enter__(self) -> Swaps:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.undo()
