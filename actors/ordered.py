"""A set in the order of insertion."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


class Ordered(dict[T, None]):
    """A set that is iterated in the order of insertion, so that what is done for each is done in the same order again.

    >>> names = Ordered[str]()
    >>> names.add("b"), names.add("a"), names.discard("c")
    (None, None, None)
    >>> list(names)
    ['b', 'a']
    """

    __slots__ = ()

    def add(self, one: T) -> None:
        """Take it in, if it is not there."""
        self[one] = None

    def discard(self, one: T) -> None:
        """Take it out, if it is there."""
        self.pop(one, None)
