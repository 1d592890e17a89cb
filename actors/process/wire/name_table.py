"""The names on a connection: addresses and message types go as text once, and as numbers from then on."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from .frames import BadFrame, Frame, Name

MOST_NAMES = 4096
"""Names after which a sender forgets all that it has given: whoever was written to once is not remembered for ever."""


class NameTable:
    """What one end of a connection has given numbers to, and what the other end has."""

    __slots__ = ("_given", "_got", "is_full", "kinds")

    def __init__(self) -> None:
        self._given: dict[str, int] = {}
        self._got: list[str] = []
        self.is_full = False  # so many were given that they are forgotten behind the next frame
        self.kinds: dict[type, int] = {}  # the numbers that the names of message types were given

    def to_wire(self, text: str) -> Name:
        """A name as the peer will understand it; text the first time."""
        number = self._given.get(text)
        if number is None:
            number = self._given[text] = len(self._given)
            self.is_full = number >= MOST_NAMES
            return text
        return number

    def from_wire(self, name: Name) -> str:
        """A name the peer sent.

        Raises:
            BadFrame: a number it never gave.
        """
        if type(name) is str:
            self._got.append(name)
            return name
        number = cast("int", name)
        if not 0 <= number < len(self._got):
            raise BadFrame(f"name {number} was never introduced")
        return self._got[number]

    def rename_got(self, now: Callable[[str], str]) -> None:
        """Have the names that the peer gave mean other ones from now on."""
        self._got = list(map(now, self._got))

    def number_of(self, name: Name) -> int:
        """The number of the name that `from_wire` was given last: the peer uses it from now on."""
        return len(self._got) - 1 if type(name) is str else cast("int", name)

    def withdraw(self, frame: Frame) -> None:
        """This frame does not go out: names that it would have introduced are still unknown to the peer."""
        for field in frame.__struct_fields__:
            value = getattr(frame, field)
            if field in ("to", "name", "sender") and type(value) is str:
                self._given.pop(value, None)

    def give_anew(self, path: str) -> None:
        """Give an address, and those below it, anew: the other side takes the numbers that they have for another."""
        for text in [one for one in self._given if one == path or one.startswith(f"{path}/")]:
            number = self._given.pop(text)
            self._given[f" {number}"] = number  # Nobody's name: numbers are counted by what was given.

    def forget_given(self) -> None:
        """Give all names to the other side anew, for it knows none of them."""
        self._given.clear()
        self.kinds.clear()
        self.is_full = False

    def forget_got(self) -> None:
        """The peer gives all its names anew."""
        self._got.clear()
