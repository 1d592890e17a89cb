"""The state of an actor as an image: the same bytes from one snapshot to the next wherever nothing has changed.

An image is a head (what the sections are) and one section per variable. Small sections lie together behind the head; a
large buffer (an array) is a piece of its own, seen where it lies and not copied. Large lists and dicts are cut into
chunks of entries (`entry_chunks.py`), each of which is a piece; one that has not changed is not encoded.

The bytes: 2 or 3, the length of the head (8 bytes, big endian), the head (msgpack), and the sections in order, each as
`encode_value` writes it, or chunk by chunk. With 2 each section is whole and stands for itself; the variables of one
may be several. With 3 sections and chunks refer to what those before them have (`image_parts.py`).
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, Final

import msgspec

from ...actors.errors import DamagedValue, UnsavableValue
from ...actors.kernel.actor import Actor
from ...actors.values import ALONE, ByteParts, decode_value, in_one
from .entry_chunks import ChunkTable, is_large
from .image_parts import ImagePart, link, shared_ids

WHOLE, LINKED = 2, 3
"""The first byte of an image. (A state that was saved as one value begins with the format of values, 1.)"""
HEAD: Final = struct.Struct(">BQ")
LARGE: Final = 64 * 1024
"""Buffers from this size on are pieces of their own."""
LOOKED_AT: Final = 1000
"""Members of a list or dict that are looked at for an estimate."""
WHOLE_IMAGES: Final = 16
"""Images until it is looked again whether a list or dict that stands at two places still does."""
IMAGE_BYTES: Final = 1024 * 1024
"""States from this size on are saved as images: below, a snapshot is one record and one row."""
_KINDS: Final = ("", "list", "dict")
_UNCHANGING: Final = frozenset({int, float, complex, bool, str, bytes, type(None)})

Key = tuple[str, int]
"""Which piece of an image: the variable of its section ("": the head, or all), and its number there."""


class Head(msgspec.Struct, array_like=True, frozen=True):
    """What an image consists of: `sections` are names and lengths; no names: the section is the whole state."""

    version: int
    form: str
    sections: list[tuple[list[str], int]]


class LinkedHead(msgspec.Struct, array_like=True, frozen=True):
    """The same, with the kind of each section (list, dict; none: it is whole), and its chunks: number, length.

    The number of a section that is whole is 0 where it lies in the piece of the head, else 1.
    """

    version: int
    form: str
    sections: list[tuple[list[str], str, list[tuple[int, int]]]]


class Section:
    """A variable, or the whole state: in one part, or a list or dict (`table`) in chunks."""

    __slots__ = ("is_small", "name", "parts", "table")

    def __init__(self, name: str | None, parts: Sequence[ImagePart], table: object = None) -> None:
        self.name, self.parts, self.table = name, parts, table
        self.is_small = table is None and self.size < LARGE

    @property
    def names(self) -> list[str]:
        """What the head says of it."""
        return [] if self.name is None else [self.name]

    @property
    def kind(self) -> str:
        """Of what its chunks are the entries; "" if it is whole."""
        return "" if self.table is None else type(self.table).__name__

    def place_of(self, part: ImagePart) -> int:
        """The number of the first piece of one of its parts."""
        return part.number if self.table is not None else int(not self.is_small)

    @property
    def size(self) -> int:
        """How many bytes all parts of the image have."""
        return sum(part.size for part in self.parts)


class Imager:
    """Makes images of one actor's state; remembers what cannot have changed.

    Args:
        chunks: whether large lists and dicts are cut into chunks.
    """

    def __init__(self, *, chunks: bool = True) -> None:
        self._chunks = chunks
        self._unchanged: dict[str | None, tuple[object, ImagePart]] = {}
        self._tables: dict[str | None, ChunkTable] = {}
        self._whole: dict[str | None, int] = {}  # tables that another variable holds too; for how many images
        self._shared = set[int]()  # what the last image has at several places, by id

    def image(self, version: int, form: str, state: object, where: str) -> list[tuple[Key, Any]]:
        """The state's pieces in order; large buffers are still the actor's own memory, and chunks are `Chunk`s.

        Raises:
            UnsavableValue: naming the variable and the type.
        """
        if isinstance(state, dict) and all(type(name) is str for name in state):
            return pieces_of(version, form, self.sections(state, where))
        return pieces_of(version, form, self._sections({None: state}, where))

    def sections(self, state: dict[str, Any], where: str) -> list[Section]:
        """The variables, each by itself, in the order of the image; what they share is numbered.

        Raises:
            UnsavableValue: naming the variable and the type.
        """
        return self._sections(state, where)

    def remember(self) -> None:
        """Note what the chunks of the last image are made of: in the next one, those that are the same are not made."""
        for table in self._tables.values():
            table.remember()
        self._whole = {name: left - 1 for name, left in self._whole.items() if left > 1}

    def _sections(self, state: dict[Any, Any], where: str) -> list[Section]:
        """As `sections`; the name None stands for a state that has no variables."""
        for gone in self._tables.keys() - state.keys():
            del self._tables[gone]
        made = [self._section(name, value, where) for name, value in state.items()]
        made.sort(key=lambda one: (one.table is not None, not one.is_small))
        parts, tables = [part for one in made for part in one.parts], [one for one in made if one.table is not None]
        shared = shared_ids(parts, self._shared, [id(one.table) for one in tables])
        twice = [one.name for one in tables if id(one.table) in shared]
        if twice:  # What stands elsewhere, too, is to be one object again.
            self._whole |= dict.fromkeys(twice, WHOLE_IMAGES)
            return self._sections(state, where)
        link(parts, shared)
        self._shared = shared
        return made

    def _section(self, name: str | None, value: Any, where: str) -> Section:
        known = self._unchanged.pop(name, None)
        if known is not None and known[0] is value:
            self._unchanged[name] = known
            return Section(name, [known[1]])
        where = where if name is None else f"{where}.{name}"
        table = self._table(name, value, where)
        if table is not None:
            return Section(name, table.chunks, value)
        part = ImagePart(name or "", value if name is None else {name: value}, where)
        if type(value) in _UNCHANGING:
            self._unchanged[name] = value, part
        return Section(name, [part])

    def _table(self, name: str | None, value: Any, where: str) -> ChunkTable | None:
        """The chunks of a large list or dict; None of another value."""
        table = self._tables.get(name)
        if table is not None and (name in self._whole or not table.fits(value)):
            del self._tables[name]
            table = None
        if table is None:
            if not self._chunks or name in self._whole or not is_large(value):
                return None
            table = self._tables[name] = ChunkTable(name or "", type(value), where)
        try:
            table.take(value)
        except UnsavableValue:  # It is said of the whole variable, and where in it that is.
            del self._tables[name]
            return None
        return table


def pieces_of(
    version: int, form: str, sections: list[Section], more: Sequence[tuple[list[str], int]] = ()
) -> list[tuple[Key, Any]]:
    """The pieces of an image; those of `more` (names, size) come behind them."""
    is_linked = any(one.table is not None or one.parts[0].links != ALONE for one in sections)
    head: Any = Head(version, form, [*((one.names, one.size) for one in sections), *more])
    if is_linked:
        chunks = [(one.names, one.kind, [(one.place_of(part), part.size) for part in one.parts]) for one in sections]
        head = LinkedHead(version, form, [*chunks, *((names, "", [(1, size)]) for names, size in more)])
    data = msgspec.msgpack.encode(head)
    small = [piece for one in sections if one.is_small for piece in one.parts[0].pieces]
    first = HEAD.pack(LINKED if is_linked else WHOLE, len(data)), data, *small
    pieces: list[tuple[Key, Any]] = [(("", 0), b"".join(first))]
    for one in sections:
        name = one.name or ""
        if one.table is not None:
            pieces += [((name, chunk.number), chunk) for chunk in one.parts]
        elif not one.is_small:
            # Apart from the buffers: where one was added, those before it lie where they lay.
            parts = (*joined(one.parts[0].pieces[:2]), *joined(one.parts[0].pieces[2:]))
            pieces += [((name, number), piece) for number, piece in enumerate(parts, 1)]
    return pieces


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
    return len(data) > 0 and (data.first if isinstance(data, ByteParts) else data[0]) in (WHOLE, LINKED)


def read_saved(data: bytes | memoryview | ByteParts, read: Callable[..., object] = decode_value) -> object:
    """What was saved of an actor, as an image or as one value: schema version, form and state.

    Args:
        data: the bytes.
        read: makes values of their bytes, as `decode_value` does.

    Raises:
        DamagedValue: whatever is wrong with the bytes.
    """
    return read_image(data, read) if is_image(data) else read(data)


def read_image(
    data: bytes | memoryview | ByteParts, read: Callable[..., object] = decode_value
) -> tuple[int, str, object]:
    """Schema version, form and state of an image; `read` makes values of their bytes, as `decode_value` does.

    Raises:
        DamagedValue: whatever is wrong with the bytes.
    """
    left = data if isinstance(data, ByteParts) else ByteParts((memoryview(data).cast("B"),))
    head, is_linked = _read_head(left)
    if sum(size for _, _, chunks in head.sections for _, size in chunks) != len(left):
        raise DamagedValue("its sections are not as long as its head says")
    shared: dict[int, object] | None = {} if is_linked else None
    state: dict[str, Any] = {}
    for names, kind, chunks in head.sections:
        values = (read(left.take(size), shared=shared) for _, size in chunks)
        if kind:
            value = _table(kind, values)
            value = {names[0]: value} if names else value
        else:
            (value,) = values
        if not names:
            return head.version, head.form, value
        if not isinstance(value, dict) or list(value) != names:
            raise DamagedValue(f"section {names} has other variables")
        state.update(value)
    return head.version, head.form, state


def _read_head(left: ByteParts) -> tuple[LinkedHead, bool]:
    """The head, and whether its sections refer to each other."""
    try:
        form, length = HEAD.unpack(in_one(left.take(HEAD.size)))
        data = in_one(left.take(length))
        if form == LINKED:
            linked = msgspec.msgpack.decode(data, type=LinkedHead)
            if any(kind not in _KINDS or (not kind and len(chunks) != 1) for _, kind, chunks in linked.sections):
                raise DamagedValue("it has a section of a kind that is not known")
            return linked, True
        head = msgspec.msgpack.decode(data, type=Head)
    except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError) as error:
        raise DamagedValue(f"its head cannot be read: {error}") from error
    sections = [(names, "", [(int(size >= LARGE), size)]) for names, size in head.sections]
    return LinkedHead(head.version, head.form, sections), False


def _table(kind: str, chunks: Iterable[Any]) -> Any:
    """A list or dict of its chunks."""
    entries: list[Any] = []
    for chunk in chunks:
        if type(chunk) is not list:
            raise DamagedValue("a chunk of it is no list")
        entries += chunk
    if kind == "list":
        return entries
    if len(entries) % 2:
        raise DamagedValue("a key of it has no value")
    try:
        return dict(zip(entries[::2], entries[1::2], strict=True))
    except TypeError as error:
        raise DamagedValue(f"it has a key that is none: {error}") from error


def outline(data: ByteParts) -> list[tuple[Key, int]]:
    """Which pieces an image has, and of how many bytes; those of a large section that is whole are one.

    Raises:
        DamagedValue: its head cannot be read.
    """
    left = data.again()
    first = len(left)
    head, _ = _read_head(left)
    first -= len(left)
    found: list[tuple[Key, int]] = []
    for names, _, chunks in head.sections:
        for number, size in chunks:
            if number:
                found.append(((names[0] if names else "", number), size))
            else:
                first += size
    return [(("", 0), first), *found]


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
