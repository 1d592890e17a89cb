"""Swaps: attributes exchanged for a while and put back, in any order. Production code pays nothing for it."""

from __future__ import annotations

from types import TracebackType
from typing import Any, ClassVar


class Swap:
    """One exchanged attribute: what stands there now, and what goes back."""

    __slots__ = ("had", "name", "old", "owner", "value")

    def __init__(self, owner: Any, name: str, value: Any) -> None:
        own = getattr(owner, "__dict__", None)
        self.had = own is None or name in own  # Slots always have it; what comes from the class is deleted again.
        self.owner, self.name, self.value, self.old = owner, name, value, getattr(owner, name)


class Swaps:
    """A list of exchanged attributes; leaving the context puts every one back.

    Whoever has exchanged the same attribute later keeps that, and puts back what was there before both. What the
    program itself has set meanwhile stays.

    >>> class Lamp: colour = "red"
    >>> with Swaps() as swaps:
    ...     swaps.put(Lamp, "colour", "green")
    ...     Lamp.colour
    'green'
    >>> Lamp.colour
    'red'
    """

    _standing: ClassVar[list[Swap]] = []  # of the whole process, as the classes are whose attributes these are

    def __init__(self) -> None:
        self._made: list[Swap] = []

    def put(self, owner: Any, name: str, value: Any) -> None:
        """Set an attribute of an object, class or module until `undo`."""
        swap = Swap(owner, name, value)
        setattr(owner, name, value)
        self._made.append(swap)
        self._standing.append(swap)

    def undo(self) -> None:
        """Put everything back; a second call changes nothing."""
        while self._made:
            swap = self._made.pop()
            self._standing.remove(swap)
            for other in self._standing:
                if other.owner is swap.owner and other.name == swap.name and other.old is swap.value:
                    other.old, other.had = swap.old, swap.had
                    break
            else:
                if getattr(swap.owner, swap.name) is not swap.value:
                    continue
                if swap.had:
                    setattr(swap.owner, swap.name, swap.old)
                else:
                    delattr(swap.owner, swap.name)

    def __enter__(self) -> Swaps:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.undo()
