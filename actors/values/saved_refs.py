"""What stands for somebody or something in values: refs, of which the address is saved, and handles."""

from __future__ import annotations

from typing import NoReturn, Self
from zlib import crc32


def hash_of_address(path: str) -> int:
    """The hash of what stands for an address: the same in every process, as that of a string is not.

    >>> hash_of_address("/app/bank/alice")
    1410990431
    """
    return crc32(path.encode("utf-8", "surrogatepass"))


class OneOfItsKind:
    """What belongs to a running system: its copy, also the one in a `copy.deepcopy` of what holds it, is itself."""

    __slots__ = ()

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError(
            f"{self!r} belongs to a running system and cannot be pickled: keep the address of a ref, `ref.path`, and "
            f"find it again by `system.ref(path)`"
        )


class Addressed(OneOfItsKind):
    """What stands for the address of an actor: a ref, or what was saved of one."""

    __slots__ = ()

    @property
    def path(self) -> str:
        """The address, such as `/app/bank/alice`."""
        raise NotImplementedError


class SavedHandle:
    """What a state may hold and no message: it is saved as its attributes, in the form of a dataclass."""

    __slots__ = ()

    @staticmethod
    def nobody(handle: SavedHandle) -> None:
        """Stands for whoever wants to know of the handles that are read."""


class SavedRef(Addressed):
    """Stands for a ref where values are read that no actor gets: nothing can be sent by it. Equal if the address is."""

    __slots__ = ("_path",)

    def __init__(self, path: str) -> None:
        self._path = path

    @property
    def path(self) -> str:
        """The address, such as `/app/bank/alice`."""
        return self._path

    def __repr__(self) -> str:
        return f"<ActorRef {self._path}>"

    def __eq__(self, other: object) -> bool:
        return self._path == other._path if isinstance(other, SavedRef) else NotImplemented

    def __hash__(self) -> int:
        return hash_of_address(self._path)
