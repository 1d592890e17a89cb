"""Engines that take notes, blocks or addresses for each other, or bring back what was erased."""

from __future__ import annotations

import fnmatch
import os
import re
import unicodedata
from collections.abc import Collection, Sequence
from typing import Any

from holdfast.checkpoint.journal import Entry, Saved
from holdfast.checkpoint.snapshot.shared_blocks import Segment
from tests.checkpoint.one_file import Contents, OneFile


class RenamingNotes(OneFile):
    """Stores notes under another key."""

    def renamed(self, key: str) -> str:
        return key

    def note(self, key: str, value: bytes | None) -> None:
        super().note(self.renamed(key), value)

    def noted(self, key: str) -> bytes | None:
        return super().noted(self.renamed(key))


class KeysEndAtNul(RenamingNotes):
    """Ends keys at a NUL."""

    def renamed(self, key: str) -> str:
        return key.split("\0")[0]


class ShortKeys(RenamingNotes):
    """Cuts long keys off."""

    def renamed(self, key: str) -> str:
        return key[:255]


class StripsKeys(RenamingNotes):
    """Strips white space off keys."""

    def renamed(self, key: str) -> str:
        return key.strip()


class PrefixesByPattern(OneFile):
    """Asks for a prefix as a pattern in which some characters stand for others."""

    def notes(self, prefix: str) -> dict[str, bytes]:
        found = super().notes("")
        return {key: value for key, value in found.items() if fnmatch.fnmatchcase(key, prefix + "*")}


class PrefixesLikeSql(OneFile):
    """Asks for a prefix with LIKE, which knows no case and has patterns."""

    def notes(self, prefix: str) -> dict[str, bytes]:
        pattern = re.escape(prefix).replace("%", ".*").replace("_", ".")
        matching = re.compile(pattern, re.IGNORECASE | re.DOTALL)
        return {key: value for key, value in super().notes("").items() if matching.match(key)}


class PrefixesByRange(OneFile):
    """Asks for a prefix as for a range that ends before the highest character."""

    def notes(self, prefix: str) -> dict[str, bytes]:
        found = super().notes("")
        return {key: value for key, value in found.items() if prefix <= key < prefix + "\U0010ffff"}


class PrefixesAreShorter(OneFile):
    """Does not take a key for a prefix of itself."""

    def notes(self, prefix: str) -> dict[str, bytes]:
        return {key: value for key, value in super().notes(prefix).items() if key != prefix}


class PrefixesAnywhere(OneFile):
    """Finds a prefix within keys, too."""

    def notes(self, prefix: str) -> dict[str, bytes]:
        return {key: value for key, value in super().notes("").items() if prefix in key}


class NotesByKey(OneFile):
    """Gives notes in the order of their keys."""

    def notes(self, prefix: str) -> dict[str, bytes]:
        return dict(sorted(super().notes(prefix).items()))


class NotesByFirstWrite(OneFile):
    """Leaves a note that is written again where it was."""

    def note(self, key: str, value: bytes | None) -> None:
        if value is None:
            super().note(key, value)
            return
        with self._changing() as contents:
            contents.notes[key] = value


class SameNoteStays(OneFile):
    """Leaves a note that is written again with the same value where it was."""

    def note(self, key: str, value: bytes | None) -> None:
        if value is None or self.noted(key) != value:
            super().note(key, value)


class EmptyNotesAreForgotten(OneFile):
    """Takes an empty value for none."""

    def note(self, key: str, value: bytes | None) -> None:
        super().note(key, value or None)


class ShortNotes(OneFile):
    """Cuts large notes off."""

    def note(self, key: str, value: bytes | None) -> None:
        super().note(key, value and value[: 1 << 20])


class NotesAreNeverForgotten(OneFile):
    """Keeps a forgotten note, as an empty one."""

    def note(self, key: str, value: bytes | None) -> None:
        super().note(key, value or b"")


class ForgottenNotesReturn(OneFile):
    """Forgets a note in memory alone."""

    def note(self, key: str, value: bytes | None) -> None:
        if value is None:
            self._contents.notes.pop(key, None)
        else:
            super().note(key, value)

    def _write(self, contents: Contents) -> None:
        whole = contents.copy()
        whole.notes = {**(self._read().notes), **contents.notes}
        super()._write(whole)


class HundredNotes(OneFile):
    """Keeps the newest hundred notes."""

    def note(self, key: str, value: bytes | None) -> None:
        super().note(key, value)
        while len(self._contents.notes) > 100:
            self._contents.notes.pop(next(iter(self._contents.notes)))


class GivesItsOwnNotes(OneFile):
    """Returns from `notes` the dictionary it has them in."""

    def notes(self, prefix: str) -> dict[str, bytes]:
        return super().notes(prefix) if prefix else self._contents.notes


class EraseForgetsNotes(OneFile):
    """Forgets all notes with an erasure."""

    def erase(self, address: str) -> None:
        super().erase(address)
        with self._changing() as contents:
            contents.notes.clear()


class EraseForgetsTheNoteOfItsName(OneFile):
    """Has notes and addresses in one space of names."""

    def erase(self, address: str) -> None:
        super().erase(address)
        self.note(address, None)


class ErasesBelow(OneFile):
    """Erases every address that begins alike."""

    def erase(self, address: str) -> None:
        contents = self._contents
        for one in {*contents.entries, *contents.snapshots, *(key[0] for key in contents.blocks), address}:
            if one.startswith(address):
                super().erase(one)


class ErasesInMemory(OneFile):
    """Erases what it remembers, and not what is in the file."""

    def erase(self, address: str) -> None:
        before = self._contents.copy()
        super().erase(address)
        self._write(before)


class LeavesSnapshotsBehind(OneFile):
    """Erases entries, and leaves the snapshots."""

    def erase(self, address: str) -> None:
        kept = self._contents.snapshots.get(address)
        super().erase(address)
        with self._changing() as contents:
            if kept:
                contents.snapshots[address] = kept


class LeavesPacksBehind(OneFile):
    """Erases entries and snapshots, and leaves the blocks."""

    def erase(self, address: str) -> None:
        packs = {key: pack for key, pack in self._contents.blocks.items() if key[0] == address}
        super().erase(address)
        with self._changing() as contents:
            contents.blocks.update(packs)


class HidesTheErased(OneFile):
    """Only hides what is erased, until the address is written to again."""

    def erase(self, address: str) -> None:
        hidden = self._contents.entries.get(address)
        super().erase(address)
        if hidden:
            vars(self).setdefault("_hidden", {})[address] = hidden

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        positions = super().append(entries)
        for address, _ in entries:
            hidden = vars(self).get("_hidden", {}).pop(address, {})
            self._contents.entries[address] = {**hidden, **self._contents.entries[address]}
        return positions


class RenamingAddresses(OneFile):
    """Stores entries under another address."""

    def renamed(self, address: str) -> str:
        return address

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        return super().append([(self.renamed(address), entry) for address, entry in entries])

    def load(self, address: str, *, older: int = False) -> Saved:
        return super().load(self.renamed(address), older=older)

    def cut(self, address: str, *rest: Any, **named: Any) -> None:
        super().cut(self.renamed(address), *rest, **named)

    def erase(self, address: str) -> None:
        super().erase(self.renamed(address))


class FoldsCase(RenamingAddresses):
    """Knows no case."""

    def renamed(self, address: str) -> str:
        return address.lower()


class NormalisesPaths(RenamingAddresses):
    """Takes addresses for paths of files."""

    def renamed(self, address: str) -> str:
        return os.path.normpath(address)


class NormalisesAddresses(RenamingAddresses):
    """Composes characters and their accents, as some file systems do."""

    def renamed(self, address: str) -> str:
        return unicodedata.normalize("NFC", address)


class ShortAddresses(RenamingAddresses):
    """Cuts long addresses off."""

    def renamed(self, address: str) -> str:
        return address[:255]


class UnsortedAddresses(OneFile):
    """Gives addresses as they come."""

    def addresses(self) -> list[str]:
        return super().addresses()[::-1]


class AddressesWithEntries(OneFile):
    """Forgets that an address has a snapshot when it has no entries."""

    def addresses(self) -> list[str]:
        return sorted(address for address, entries in self._contents.entries.items() if entries)


class AddressesThatWere(OneFile):
    """Still knows an address that was erased."""

    def addresses(self) -> list[str]:
        known: set[str] = vars(self).setdefault("_known", set())
        known.update(super().addresses())
        return sorted(known)


class PacksByNumber(OneFile):
    """Keeps blocks by the number of their pack, whosever it is."""

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        super().keep_blocks("", number, blocks, compress)

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        return super().read_blocks("", number, places)

    def addresses(self) -> list[str]:
        return [address for address in super().addresses() if address]


class BlocksByOffset(OneFile):
    """Gives the block at an offset, whatever length is asked for."""

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        known = {offset: (offset, length) for offset, length in self._contents.blocks.get((address, number), {})}
        return super().read_blocks(address, number, [known.get(place[0], place) for place in places])


class MissingBlocksAreZeros(OneFile):
    """Gives zeros for a block that is not there."""

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        pack = self._contents.blocks.get((address, number), {})
        return Segment.of(number, [(place[0], pack.get(place, bytes(min(place[1], 4096)))) for place in places])


class ShortPackNumbers(OneFile):
    """Stores the numbers of packs in 32 bits."""

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        super().keep_blocks(address, number % 2**32, blocks, compress)


class BorrowsBlocks(OneFile):
    """Writes blocks from the caller's memory, and once more later."""

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        super().keep_blocks(address, number, blocks, compress)
        self._borrowed = (address, number), list(blocks)

    def close(self) -> None:
        if self._owner >= 0 and "_borrowed" in vars(self) and self._borrowed[0] in self._contents.blocks:
            super().keep_blocks(*self._borrowed[0], self._borrowed[1], False)
        super().close()


class ForgetsNeededPacks(OneFile):
    """Forgets every pack of an address but the newest one."""

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        super().forget_blocks(address, [number for owner, number in self._contents.blocks if owner == address][:-1])


class ForgetsFiftyPacks(OneFile):
    """Forgets fifty packs at a time, and leaves the rest."""

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        super().forget_blocks(address, sorted(numbers)[:50])


class ForgetsPacksOfOthers(OneFile):
    """Forgets by number, whosever a pack is."""

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        with self._changing() as contents:
            contents.blocks = {key: pack for key, pack in contents.blocks.items() if key[1] not in numbers}


class NamesPacksOfOthers(OneFile):
    """Says that an address has the packs of all."""

    def packs(self, address: str) -> set[int]:
        return {number for _, number in self._contents.blocks}


class NeverForgetsPacks(OneFile):
    """Forgets nothing."""

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        pass
