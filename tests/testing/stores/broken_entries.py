"""Engines that lose, double, reorder or change entries, or hand out positions that do not rise."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from holdfast.checkpoint.journal import Entry, Saved
from tests.checkpoint.one_file import Contents, OneFile, check


def changed(part: Any, change: Callable[[Any], Any]) -> Any:
    """The same, with each item of a tuple, at any depth, changed."""
    return tuple(changed(one, change) for one in part) if isinstance(part, tuple) else change(part)


class Changing(OneFile):
    """Stores something else than it was given."""

    def change(self, value: Any) -> Any:
        return value

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        for _, entry in entries:
            check(entry)
        return super().append([(address, changed(entry, self.change)) for address, entry in entries])


class WritesAppendsLater(OneFile):
    """Has the newest append in memory alone, until the next write or the closing."""

    _is_late = False

    def _write(self, contents: Contents) -> None:
        if not self._is_late:
            super()._write(contents)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        self._is_late = True
        try:
            return super().append(entries)
        finally:
            self._is_late = False

    def close(self) -> None:
        if self._owner >= 0:
            self._write(self._contents)
        super().close()


class LosesTheLastOfABatch(OneFile):
    """Acknowledges a batch of several and stores all but its last entry."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions = super().append(entries)
        if len(positions) > 1:
            with self._changing() as contents:
                del contents.entries[entries[-1][0]][positions[-1]]
        return positions


class NewestFirst(OneFile):
    """Loads entries in the wrong order."""

    def load(self, address: str, *, older: int = False) -> Saved:
        saved = super().load(address, older=older)
        return saved._replace(entries=saved.entries[::-1])


class OrderedByText(OneFile):
    """Orders positions as texts: 10 comes before 9."""

    def load(self, address: str, *, older: int = False) -> Saved:
        saved = super().load(address, older=older)
        return saved._replace(entries=sorted(saved.entries, key=lambda pair: str(pair[0])))


class EntryByEntry(OneFile):
    """Writes a batch as so many batches of one: a kill or an error inside leaves its first part."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        for _, entry in entries:
            check(entry)
        return [position for one in entries for position in super(EntryByEntry, self).append([one])]


class AddressByAddress(OneFile):
    """Writes a batch in as many parts as it has addresses."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        for _, entry in entries:
            check(entry)
        positions: list[int] = []
        batch: list[tuple[str, Entry]] = []
        for one in entries:
            if batch and batch[-1][0] != one[0]:
                positions += super().append(batch)
                batch = []
            batch.append(one)
        return positions + super().append(batch)


class ChecksAsItGoes(OneFile):
    """Finds out what is no entry when those before it are stored."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions: list[int] = []
        for one in entries:
            positions += super().append([one])
        return positions


class PositionsAgain(OneFile):
    """Goes on, at an opening, from the highest position that is still there."""

    def _read(self) -> Contents:
        contents = super()._read()
        contents.last = max((position for known in contents.entries.values() for position in known), default=0)
        return contents


class PositionsOfEachAddress(OneFile):
    """Counts the positions of each address on its own."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions: list[int] = []
        for address, entry in entries:
            check(entry)
            with self._changing() as contents:
                known = contents.entries.setdefault(address, {})
                positions.append(max(known, default=0) + 1)
                known[positions[-1]] = entry
        return positions


class PositionsAfterAnErasure(OneFile):
    """Hands out the newest position again when its entry was erased."""

    def erase(self, address: str) -> None:
        super().erase(address)
        with self._changing() as contents:
            contents.last = max((position for known in contents.entries.values() for position in known), default=0)


class TupleOfPositions(OneFile):
    """Returns positions as a tuple."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions: Any = tuple(super().append(entries))
        return positions


class OnePositionOfABatch(OneFile):
    """Returns the position of the first entry of a batch alone."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        return super().append(entries)[:1]


class AThousandAtMost(OneFile):
    """Stores the first thousand entries of a batch, and acknowledges all."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions = super().append(entries)
        if len(positions) > 1000:
            with self._changing() as contents:
                for (address, _), position in list(zip(entries, positions, strict=True))[1000:]:
                    del contents.entries[address][position]
        return positions


class TenAddresses(OneFile):
    """Keeps the entries of ten addresses."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions = super().append(entries)
        while len(self._contents.entries) > 10:
            self._contents.entries.pop(next(iter(self._contents.entries)))
        return positions


class EqualOnesOnce(OneFile):
    """Takes an entry that is equal to the one before it for a repetition."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions = super().append(entries)
        with self._changing() as contents:
            for known in contents.entries.values():
                for before, position in zip(list(known), list(known)[1:], strict=False):
                    if before in known and known[before] == known[position]:
                        del known[position]
        return positions


class DoubledAtOpening(OneFile):
    """Finds the newest entry of each address twice when it is opened."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with self._changing() as contents:
            for known in contents.entries.values():
                if known:
                    contents.last += 1
                    known[contents.last] = list(known.values())[-1]


class BooleansAreInts(Changing):
    """Gives True and False back as 1 and 0."""

    def change(self, value: Any) -> Any:
        return int(value) if isinstance(value, bool) else value


class IntsAreBooleans(Changing):
    """Gives 0 and 1 back as False and True."""

    def change(self, value: Any) -> Any:
        return bool(value) if type(value) is int and value in (0, 1) else value


class SixtyFourBits(Changing):
    """Has ints wrap around at 64 bits."""

    def change(self, value: Any) -> Any:
        return (value + 2**63) % 2**64 - 2**63 if type(value) is int else value


class IntsAreFloats(Changing):
    """Passes ints through floats, as JSON readers do."""

    def change(self, value: Any) -> Any:
        return int(float(value)) if type(value) is int and 2**53 < abs(value) < 2**100 else value


class WholeFloatsAreInts(Changing):
    """Gives 1.0 back as 1."""

    def change(self, value: Any) -> Any:
        return int(value) if isinstance(value, float) and value.is_integer() else value


class NoNegativeZero(Changing):
    """Gives -0.0 back as 0.0."""

    def change(self, value: Any) -> Any:
        return value + 0.0 if isinstance(value, float) else value


class NoNumberIsNone(Changing):
    """Gives NaN back as None, as SQL does."""

    def change(self, value: Any) -> Any:
        return None if isinstance(value, float) and value != value else value


class TextsAreBytes(Changing):
    """Gives bytes that are text back as str."""

    def change(self, value: Any) -> Any:
        return value.decode() if isinstance(value, bytes) and value.isalnum() else value


class ReplacesSurrogates(Changing):
    """Replaces what is not valid in UTF-8."""

    def change(self, value: Any) -> Any:
        return value.encode(errors="replace").decode() if isinstance(value, str) else value


class NormalisesText(Changing):
    """Composes characters and their accents."""

    def change(self, value: Any) -> Any:
        return unicodedata.normalize("NFC", value) if isinstance(value, str) else value


class EndsAtNul(Changing):
    """Ends a text at its first NUL."""

    def change(self, value: Any) -> Any:
        return value.split("\0")[0] if isinstance(value, str) else value


class SixtyFourKibibytes(Changing):
    """Cuts long values off."""

    def change(self, value: Any) -> Any:
        return value[:65535] if isinstance(value, str | bytes) else value


class TwoMebibytes(Changing):
    """Cuts very long values off."""

    def change(self, value: Any) -> Any:
        return value[: 2 << 20] if isinstance(value, str | bytes) and len(value) > 2 << 20 else value


class EmptyIsNone(Changing):
    """Gives empty bytes back as None."""

    def change(self, value: Any) -> Any:
        return None if value == b"" and isinstance(value, bytes) else value


class PlainTypes(Changing):
    """Accepts subclasses of str and int, and gives them back as what they are derived from."""

    def change(self, value: Any) -> Any:
        for kind in (bool, int, str):
            if isinstance(value, kind):
                return kind(value)
        return value


class TakesLists(OneFile):
    """Accepts lists inside entries, and gives them back as tuples."""

    def append(self, entries: Sequence[tuple[str, Any]]) -> list[int]:
        return super().append([(address, self._frozen(entry)) for address, entry in entries])

    def _frozen(self, part: Any) -> Any:
        return tuple(map(self._frozen, part)) if isinstance(part, list | tuple) else part


class TakesBuffers(OneFile):
    """Accepts bytearrays and memoryviews, and gives them back as bytes."""

    def append(self, entries: Sequence[tuple[str, Any]]) -> list[int]:
        def frozen(value: Any) -> Any:
            return bytes(value) if isinstance(value, bytearray | memoryview) else value

        return super().append([(address, changed(entry, frozen)) for address, entry in entries])


class GivesItsOwnList(OneFile):
    """Returns from `load` the list that it answers from the next time."""

    _answers: dict[tuple[str, int], Saved]
    _answered: Contents | None = None

    def load(self, address: str, *, older: int = False) -> Saved:
        if self._answered is not self._contents:
            self._answered, self._answers = self._contents, {}
        return self._answers.setdefault((address, older), super().load(address, older=older))
