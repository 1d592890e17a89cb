"""State images in checksummed blocks: blocks that two images share are kept and sent once.

A large state is encoded variable by variable (`checkpoint.image`), and each piece is cut into blocks. A block in which
nothing has changed is the very object that the last image has; an array is compared where it lies, a list of plain
values entry by entry (`entry_rows.py`), and only the blocks that differ are made. A `Patch` has the blocks that another
replica lacks. It fits one image only: that is known by a checksum of all checksums, and what comes out is compared with
the checksum of what went in.
"""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ...actors.errors import DamagedValue
from ...actors.values import SavedRef, decode_value
from ...checkpoint.snapshot.key_variables import save_state, state_of
from ...checkpoint.snapshot.state_image import Imager, Key, pieces_of, read_saved
from .entry_rows import MANY, Rows

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor

BLOCK: Final = 32 * 1024
"""Bytes of a block: small enough that one is sent as quickly as a few numbers, large enough that few are compared."""


class Misfit(Exception):  # no error of anybody's: it is answered by sending all of it
    """These differences are not to the state that is here, or have come damaged."""


class Piece(msgspec.Struct, array_like=True):
    """A piece of an image in blocks, and the checksum of each."""

    name: str
    number: int
    blocks: list[bytes]
    sums: list[int]

    @property
    def key(self) -> Key:
        """The name of the piece among the pieces of its state."""
        return self.name, self.number


class Image(msgspec.Struct, array_like=True):
    """A saved state. `digest` stands for all of its bytes."""

    pieces: list[Piece]
    size: int
    digest: int

    def check(self) -> None:
        """See whether all blocks are as they were made.

        Raises:
            DamagedValue: one is not.
        """
        for piece in self.pieces:
            if list(map(zlib.crc32, piece.blocks)) != piece.sums:
                raise DamagedValue("a block of a state that was handed over does not fit its checksum")
        if digest(self.pieces) != self.digest:
            raise DamagedValue("the blocks of a state that was handed over do not belong together")

    def whole(self) -> bytes:
        """Its bytes, as `restore_state` takes them.

        Raises:
            DamagedValue: they are not as they were.
        """
        self.check()
        return b"".join([block for piece in self.pieces for block in piece.blocks])

    def value(self, refs: Callable[[str], object] = SavedRef) -> Any:
        """What was saved: (schema version, form, state); None if nothing was. `refs` is as for `decode_value`."""
        data = self.whole()
        return read_saved(data, partial(decode_value, refs=refs)) if data else None


class Patched(msgspec.Struct, array_like=True):
    """A piece as it is now: `count` blocks, those at `at` new ones, the others as they were."""

    name: str
    number: int
    count: int
    at: list[int]
    blocks: list[bytes]


class Patch(msgspec.Struct, array_like=True):
    """What leads from the image with digest `base` to the one with `digest`; pieces that are not in it are gone."""

    base: int
    digest: int
    pieces: list[Patched]

    def applied(self, before: Image) -> Image:
        """The image that this leads to; nothing of `before` is changed.

        Raises:
            Misfit: it does not lead there.
        """
        if before.digest != self.base:
            raise Misfit("it is to another image")
        known = {piece.key: piece for piece in before.pieces}
        made = image_of([_patched(one, known.get((one.name, one.number))) for one in self.pieces])
        if made.digest != self.digest:
            raise Misfit("what has come out is not what went in")
        return made


def digest(pieces: list[Piece]) -> int:
    """A checksum of the checksums of pieces."""
    found = 0
    for piece in pieces:
        found = zlib.crc32(f"{piece.name}|{piece.number}|{len(piece.blocks)}".encode(), found)
        found = zlib.crc32(array("I", piece.sums).tobytes(), found)
    return found


def image_of(pieces: list[Piece]) -> Image:
    """The image that these pieces make."""
    return Image(pieces, sum(sum(map(len, piece.blocks)) for piece in pieces), digest(pieces))


def cut(pieces: Iterable[tuple[Key, Any]], before: Image | None = None) -> Image:
    """Buffers as an image; what is as it was in `before` is taken from there."""
    return image_of(_pieces(pieces, before))


def _pieces(buffers: Iterable[tuple[Key, Any]], before: Image | None) -> list[Piece]:
    known = {} if before is None else {piece.key: piece for piece in before.pieces}
    return [_piece(key, memoryview(buffer).cast("B"), known.get(key)) for key, buffer in buffers]


def image_from(data: bytes) -> Image:
    """A state that was saved elsewhere, as an image."""
    return cut([(("", 0), data)] if data else [])


def _piece(key: Key, view: memoryview, before: Piece | None) -> Piece:
    """Cut a buffer into blocks, with a checksum for each."""
    parts = [view[begin : begin + BLOCK] for begin in range(0, len(view), BLOCK)]
    if before is None:
        return Piece(*key, list(map(bytes, parts)), list(map(zlib.crc32, parts)))
    old = before.blocks
    # `startswith` compares as memcmp does, `==` of views number by number. Only the last blocks can be shorter.
    same = list(map(bytes.startswith, old, parts))
    if same and len(old[len(same) - 1]) != len(parts[len(same) - 1]):
        same[-1] = False
    if len(old) == len(parts) and all(same):
        return before
    blocks, sums = old[: len(same)], before.sums[: len(same)]
    for index in [index for index, one in enumerate(same) if not one]:
        blocks[index], sums[index] = bytes(parts[index]), zlib.crc32(parts[index])
    blocks += map(bytes, parts[len(same) :])
    sums += map(zlib.crc32, parts[len(same) :])
    return Piece(*key, blocks, sums)


def _patched(one: Patched, before: Piece | None) -> Piece:
    old = [] if before is None else before.blocks
    if before is not None and not one.at and one.count == len(old):
        return before
    blocks, sums = old[: one.count], [] if before is None else before.sums[: one.count]
    blocks += [b""] * (one.count - len(blocks))
    sums += [-1] * (one.count - len(sums))
    if len(one.at) != len(one.blocks) or not all(0 <= at < one.count for at in one.at):
        raise Misfit("it has blocks that belong nowhere")
    for at, block in zip(one.at, one.blocks, strict=True):
        blocks[at], sums[at] = block, zlib.crc32(block)
    if -1 in sums:
        raise Misfit("it lacks blocks that are not here")
    return Piece(one.name, one.number, blocks, sums)


def patch(before: Image, now: Image) -> Patch:
    """What leads from one image to another."""
    known, pieces = {piece.key: piece for piece in before.pieces}, list[Patched]()
    for piece in now.pieces:
        old = known.get(piece.key)
        was = [] if old is None else old.blocks
        at = [] if piece is old else [i for i, one in enumerate(piece.blocks) if i >= len(was) or one is not was[i]]
        pieces.append(Patched(piece.name, piece.number, len(piece.blocks), at, [piece.blocks[index] for index in at]))
    return Patch(before.digest, now.digest, pieces)


class Images:
    """Takes the images of one actor."""

    def __init__(self) -> None:
        self._imager = Imager(chunks=False)
        self._rows: dict[str, Rows] = {}

    def take(self, actor: Actor, before: Image | None) -> Image:
        """The actor's state. The same state after the same one before makes the same image.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        if before is None or before.size <= BLOCK:
            return cut([(("", 0), save_state(actor))])
        state, where = state_of(actor), actor.ctx.path
        if not (isinstance(state.value, dict) and all(type(name) is str for name in state.value)):
            return cut(self._imager.image(state.version, state.form, state.value, where), before)
        rows = self._take_rows(state.value)
        rest = {name: value for name, value in state.value.items() if name not in rows}
        sections = self._imager.sections(rest, where)
        own = {id(state.value[name]) for name in rows}
        if len(own) < len(rows) or not all(own.isdisjoint(part.objects) for one in sections for part in one.parts):
            rows, sections = {}, self._imager.sections(state.value, where)  # Two variables are one: so they stay.
        more = [([name], one.size) for name, one in rows.items()]
        pieces = _pieces(pieces_of(state.version, state.form, sections, more), before)
        return image_of([*pieces, *(Piece(name, -1, one.blocks, one.sums) for name, one in rows.items())])

    def _take_rows(self, state: dict[str, Any]) -> dict[str, Rows]:
        """Those variables that are large lists or dicts of plain values."""
        found: dict[str, Rows] = {}
        for name, value in state.items():
            kind = type(value)
            if (kind is list or kind is dict) and len(value) >= MANY:
                rows = self._rows.get(name)
                if rows is None or rows.kind is not kind:
                    rows = self._rows[name] = Rows(name, kind)
                if rows.take(value):
                    found[name] = rows
                    continue
            self._rows.pop(name, None)
        return found
