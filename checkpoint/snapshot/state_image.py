"""The state of an actor as an image: the same bytes from one snapshot to the next wherever nothing has changed.

An image is a head (what the sections are) and one section per variable. Variables that share something which can change
(the same list, the same array) are one section, so that they share it again when they come back. Small sections lie
together behind the head; a large buffer (an array) is a piece of its own, seen where it lies and not copied.

The bytes: 2, the length of the head (8 bytes, big endian), the head (msgpack: schema version, form, sections), and the
sections in order, each as `encode_value` writes it.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, Final

import msgspec

from ...actors.errors import DamagedValue
from ...actors.kernel.actor import Actor
from ...actors.values import ByteParts, decode_value, in_one, walked_pieces

IMAGE: Final = 2
"""The first byte of an image. (A state that was saved as one value begins with the format of values, 1.)"""
HEAD: Final = struct.Struct(">BQ")
LARGE: Final = 64 * 1024
"""Buffers from this size on are pieces of their own."""
LOOKED_AT: Final = 1000
"""Members of a list or dict that are looked at for an estimate."""
IMAGE_BYTES: Final = 1024 * 1024
"""States from this size on are saved as images: below, a snapshot is one record and one row."""
_UNCHANGING: Final = frozenset({int, float, complex, bool, str, bytes, type(None)})

Key = tuple[str, int]
"""Which piece of an image: the first variable of its section ("": the head), and its number there."""


class Head(msgspec.Struct, array_like=True, frozen=True):
    """What an image consists of: `sections` are names and lengths; no names: the section is the whole state."""

    version: int
    form: str
    sections: list[tuple[list[str], int]]


class Section:
    """Some variables, encoded together; the first two of `pieces` are head and tree, the others buffers."""

    __slots__ = ("names", "pieces", "seen", "size", "value")

    def __init__(self, names: list[str], pieces: list[Any], seen: dict[int, object], value: object) -> None:
        self.names, self.pieces, self.seen, self.value = names, pieces, seen, value
        self.size = sum(len(memoryview(piece).cast("B")) for piece in pieces)


class Imager:
    """Makes images of one actor's state; remembers variables that cannot have changed."""

    def __init__(self) -> None:
        self._unchanged: dict[str, Section] = {}

    def image(self, version: int, form: str, state: object, where: str) -> list[tuple[Key, Any]]:
        """The state's pieces in order; large buffers are still the actor's own memory.

        Raises:
            UnsavableValue: naming the variable and the type.
        """
        if isinstance(state, dict) and all(type(name) is str for name in state):
            sections = self.sections(state, where)
        else:
            sections = [Section([], *walked_pieces(state, where), None)]
        return pieces_of(version, form, sections)

    def sections(self, state: dict[str, Any], where: str) -> list[Section]:
        """The variables, apart wherever they can be."""
        made: list[Section] = []
        for name, value in state.items():
            known = self._unchanged.get(name)
            if known is not None and known.value is value:
                made.append(known)
                continue
            section = Section([name], *walked_pieces({name: value}, f"{where}.{name}"), value)
            section.seen = {key: one for key, one in section.seen.items() if one is not None}
            if type(value) in _UNCHANGING:
                self._unchanged[name] = section
            else:
                self._unchanged.pop(name, None)
            made.append(section)
        return [
            group[0] if len(group) == 1 else self._together([one.names[0] for one in group], state, where)
            for group in sharing(made)
        ]

    def _together(self, names: list[str], state: dict[str, Any], where: str) -> Section:
        return Section(names, *walked_pieces({name: state[name] for name in names}, where), None)


def pieces_of(
    version: int, form: str, sections: list[Section], more: Sequence[tuple[list[str], int]] = ()
) -> list[tuple[Key, Any]]:
    """The pieces of an image; those of `more` (names, size) come behind them."""
    small = [one for one in sections if one.size < LARGE]
    large = [one for one in sections if one.size >= LARGE]
    lengths = [(one.names, one.size) for one in (*small, *large)]
    head = msgspec.msgpack.encode(Head(version, form, [*lengths, *more]))
    first = [HEAD.pack(IMAGE, len(head)), head, *(piece for one in small for piece in one.pieces)]
    pieces: list[tuple[Key, Any]] = [(("", 0), b"".join(first))]
    for one in large:
        name = one.names[0] if one.names else ""
        # Apart from the buffers: where one was added, those before it lie where they lay.
        parts = (*joined(one.pieces[:2]), *joined(one.pieces[2:]))
        pieces += [((name, number), piece) for number, piece in enumerate(parts, 1)]
    return pieces


def sharing(sections: list[Section]) -> list[list[Section]]:
    """Put together those that have something in common which can change, in the order of their first."""
    groups: list[list[Section]] = []
    owner: dict[int, list[Section]] = {}
    for one in sections:
        group = [one]
        groups.append(group)
        for key in one.seen:
            other = owner.get(key)
            if other is not None and other is not group:
                other += group
                for moved in group:
                    owner.update(dict.fromkeys(moved.seen, other))
                groups = [each for each in groups if each is not group]
                group = other
            owner[key] = group
    return groups


def joined(pieces: Iterable[Any]) -> Iterator[Any]:
    """The same bytes, with small neighbours in one."""
    small: list[Any] = []
    for piece in pieces:
        if len(memoryview(piece).cast("B")) < LARGE:
            small.append(piece)
            continue
        if small:
            yield b"".join(small)
            small = []
        yield piece
    if small:
        yield b"".join(small)


def is_image(data: bytes | memoryview | ByteParts) -> bool:
    """Whether a saved state is an image."""
    return len(data) > 0 and (data.first if isinstance(data, ByteParts) else data[0]) == IMAGE


def read_image(
    data: bytes | memoryview | ByteParts, read: Callable[[Any], object] = decode_value
) -> tuple[int, str, object]:
    """Schema version, form and state of an image; `read` makes the variables of their bytes.

    Raises:
        DamagedValue: whatever is wrong with the bytes.
    """
    left = data if isinstance(data, ByteParts) else ByteParts((memoryview(data).cast("B"),))
    try:
        _, length = HEAD.unpack(in_one(left.take(HEAD.size)))
        head = msgspec.msgpack.decode(in_one(left.take(length)), type=Head)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise DamagedValue(f"its head cannot be read: {error}") from error
    if sum(size for _, size in head.sections) != len(left):
        raise DamagedValue("its sections are not as long as its head says")
    state: dict[str, Any] = {}
    for names, size in head.sections:
        value = read(left.take(size))
        if not names:
            return head.version, head.form, value
        if not isinstance(value, dict) or list(value) != names:
            raise DamagedValue(f"section {names} has other variables")
        state.update(value)
    return head.version, head.form, state


def estimate(actor: Actor, names: Iterable[str], *, below: bool = False) -> int:
    """Bytes of the state seen at a glance: arrays, and texts of bytes; with `below` also in lists and dicts."""
    root: Any = actor._state_root()
    total = 0
    for name in names:
        value: Any = root
        for part in name.split("."):
            value = getattr(value, part, None)
        total += _weight(value)
        if below and isinstance(value, list | tuple | dict):
            inner: Any = value.values() if isinstance(value, dict) else value
            total += sum(map(_weight, islice(inner, LOOKED_AT)))
    return total


def _weight(value: Any) -> int:
    numpy: Any = sys.modules.get("numpy")
    if isinstance(value, bytes | bytearray):
        return len(value)
    return int(value.nbytes) if numpy is not None and isinstance(value, numpy.ndarray) else 0
