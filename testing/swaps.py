"""Swaps: attributes exchanged for a while and put back, in any order. Production code pays nothing for it."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterable
from types import ModuleType, TracebackType
from typing import Any, ClassVar, Final

SEALED: Final = 1 << 8
"""The flag of a class in C whose attributes cannot be set (Py_TPFLAGS_IMMUTABLETYPE)."""


class Swap:
    """One exchanged attribute: what stands there now, and what goes back."""

    __slots__ = ("had", "name", "old", "owner", "value")

    def __init__(self, owner: Any, name: str, value: Any) -> None:
        own = getattr(owner, "__dict__", None)
        self.had = own is None or name in own  # Slots always have it; what comes from the class is deleted again.
        self.owner, self.name, self.value, self.old = owner, name, value, read(owner, name)


def is_sealed(owner: Any) -> bool:
    """Whether it is a class that refuses to have an attribute set."""
    return isinstance(owner, type) and bool(owner.__flags__ & SEALED)


def read(owner: Any, name: str) -> Any:
    """What stands at an attribute; of a sealed class the descriptor itself, which is what has to go back."""
    return vars(owner)[name] if is_sealed(owner) else getattr(owner, name)


def write(owner: Any, name: str, value: Any) -> None:
    """Set an attribute, of a sealed class in its dictionary: whoever has imported the class sees it, too."""
    if not is_sealed(owner):
        setattr(owner, name, value)
        return
    (attributes,) = gc.get_referents(vars(owner))  # behind the read-only view
    attributes[name] = value
    ctypes.pythonapi.PyType_Modified(ctypes.py_object(owner))  # Else what has been looked up before stays.


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

    # Of the whole process, as the classes are whose attributes these are: by owner and name, oldest first.
    _standing: ClassVar[dict[tuple[int, str], list[Swap]]] = {}

    def __init__(self) -> None:
        self._made: list[Swap] = []

    def put(self, owner: Any, name: str, value: Any) -> None:
        """Set an attribute of an object, class or module until `undo`."""
        swap = Swap(owner, name, value)
        write(owner, name, value)
        self._made.append(swap)
        self._standing.setdefault((id(owner), name), []).append(swap)

    def follow(self, names: Iterable[tuple[ModuleType, str]]) -> None:
        """Exchange functions also where modules have imported them by name."""
        new = {
            id(swap.old): swap.value
            for swap in self._made
            if isinstance(swap.owner, ModuleType) and callable(swap.old) and callable(swap.value)
        }
        for module, name in names:
            value = new.get(id(vars(module).get(name)))
            if value is not None:
                self.put(module, name, value)

    def undo(self) -> None:
        """Put everything back; a second call changes nothing."""
        while self._made:
            swap = self._made.pop()
            same = self._standing[id(swap.owner), swap.name]  # The swap keeps its owner, and so the owner's id.
            same.remove(swap)
            if not same:
                del self._standing[id(swap.owner), swap.name]
            for other in same:
                if other.old is swap.value:
                    other.old, other.had = swap.old, swap.had
                    break
            else:
                if read(swap.owner, swap.name) is not swap.value:
                    continue
                if swap.had:
                    write(swap.owner, swap.name, swap.old)
                else:
                    delattr(swap.owner, swap.name)

    def __enter__(self) -> Swaps:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.undo()
