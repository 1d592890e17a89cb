"""All that a store holds, in memory: each change is a method, so that whoever follows a log makes the same ones."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple

from ..checkpoint.journal import Entry

Change = tuple[str, tuple[Any, ...]]
"""A method of `MemoryContents`, and its arguments."""
CHANGES = frozenset((
    "append", "cut", "erase", "keep_pack", "forget_packs", "note", "hand_out", "put_entries", "put_snapshot",
))  # fmt: skip
"""The methods that are changes."""
MOST_ENTRIES = 1000
"""Entries of one address in one change of `as_changes`."""


class KeptSnapshot(NamedTuple):
    """A snapshot, with the positions of all entries that it contains.

    Attributes:
        data: the snapshot itself, or what the store knows it by.
        turn: the turn after which it was made.
        contains: the positions, of those that the address still has.
    """

    data: Any
    turn: int
    contains: frozenset[int]


class MemoryContents:
    """All that a store holds. What takes something away returns what it has freed: data of snapshots, and packs.

    Attributes:
        last: the highest position that was ever handed out.
        entries: by address and position, in order.
        snapshots: by address, oldest first.
        packs: what the store knows the packs of blocks by, by address and number.
        notes: in the order in which they were last written.
    """

    __slots__ = ("entries", "last", "notes", "packs", "snapshots")

    def __init__(self) -> None:
        self.last = 0
        self.entries: dict[str, dict[int, Entry]] = {}
        self.snapshots: dict[str, list[KeptSnapshot]] = {}
        self.packs: dict[str, dict[int, Any]] = {}
        self.notes: dict[str, bytes] = {}

    # -- changes ----------------------------------------------------------------------------------------------------

    def make(self, change: Change) -> list[Any]:
        """Make a change; return what it has freed.

        Raises:
            ValueError: there is no such change.
        """
        name, args = change
        if name not in CHANGES:
            raise ValueError(f"no store can make the change {name!r}")
        freed: list[Any] | None = getattr(self, name)(*args)
        return freed or []

    def append(self, entries: Sequence[tuple[str, Entry]]) -> None:
        """Add entries behind the last position."""
        position = self.last
        for address, entry in entries:
            position += 1
            own = self.entries.get(address)
            if own is None:
                own = self.entries[address] = {}
            own[position] = entry
        self.last = position

    def cut(self, address: str, snapshot: Any, drop: Collection[int], turn: int, keep: int) -> list[Any]:
        """Add a snapshot, and forget what the oldest one that is kept contains."""
        kept, entries = self.snapshots.setdefault(address, []), self.entries.get(address, {})
        drop = drop if isinstance(drop, range) else frozenset(drop)
        before = kept[-1].contains if kept else frozenset[int]()
        kept.append(KeptSnapshot(snapshot, turn, frozenset(p for p in entries if p in before or p in drop)))
        freed = [one.data for one in kept[:-keep]]
        del kept[:-keep]
        for position in kept[0].contains:
            entries.pop(position, None)
        return freed

    def erase(self, address: str) -> list[Any]:
        """Forget an address."""
        self.entries.pop(address, None)
        freed = [one.data for one in self.snapshots.pop(address, ())]
        return [*freed, *self.packs.pop(address, {}).values()]

    def keep_pack(self, address: str, number: int, pack: Any) -> None:
        """Add a pack of blocks."""
        self.packs.setdefault(address, {})[number] = pack

    def forget_packs(self, address: str, numbers: Collection[int]) -> list[Any]:
        """Forget packs of an address."""
        packs = self.packs.get(address, {})
        freed = [packs.pop(number) for number in numbers if number in packs]
        if not packs:
            self.packs.pop(address, None)
        return freed

    def note(self, key: str, value: bytes | None) -> None:
        """Set or forget a note."""
        self.notes.pop(key, None)
        if value is not None:
            self.notes[key] = value

    # -- all of it as changes ---------------------------------------------------------------------------------------

    def as_changes(self) -> Iterator[Change]:
        """Changes that make the same contents of empty ones."""
        yield "hand_out", (self.last,)
        for address in self.addresses():
            entries = list(self.entries.get(address, {}).items())
            for at in range(0, len(entries), MOST_ENTRIES):
                yield "put_entries", (address, tuple(entries[at : at + MOST_ENTRIES]))
            for one in self.snapshots.get(address, ()):
                yield "put_snapshot", (address, one.data, one.turn, tuple(sorted(one.contains)))
            for number, pack in self.packs.get(address, {}).items():
                yield "keep_pack", (address, number, pack)
        for key, value in self.notes.items():
            yield "note", (key, value)

    def hand_out(self, last: int) -> None:
        """Positions up to this one have been handed out."""
        self.last = last

    def put_entries(self, address: str, entries: Sequence[tuple[int, Entry]]) -> None:
        """Put entries of an address at their positions."""
        self.entries.setdefault(address, {}).update(entries)

    def put_snapshot(self, address: str, data: Any, turn: int, contains: Sequence[int]) -> None:
        """Put a snapshot of an address behind those that are there."""
        self.snapshots.setdefault(address, []).append(KeptSnapshot(data, turn, frozenset(contains)))

    def copy(self) -> MemoryContents:
        """The same contents, to be changed on their own."""
        made = MemoryContents()
        made.last, made.notes = self.last, self.notes.copy()
        made.entries = {address: own.copy() for address, own in self.entries.items()}
        made.snapshots = {address: kept.copy() for address, kept in self.snapshots.items()}
        made.packs = {address: packs.copy() for address, packs in self.packs.items()}
        return made

    # -- looking ----------------------------------------------------------------------------------------------------

    def load(self, address: str, older: int) -> tuple[KeptSnapshot | None, list[tuple[int, Entry]]]:
        """A snapshot of an address, passing over so many newer ones, and the entries that it does not contain."""
        kept, entries = self.snapshots.get(address), self.entries.get(address, {})
        if not kept:
            return None, list(entries.items())
        found = kept[max(0, len(kept) - 1 - older)]
        return found, [(position, entry) for position, entry in entries.items() if position not in found.contains]

    def addresses(self) -> list[str]:
        """Every address of which something is kept, sorted."""
        used = {*self.snapshots, *self.packs}
        return sorted(used | {address for address, entries in self.entries.items() if entries})

    def kept(self) -> Iterator[Any]:
        """The data of all snapshots, and all packs."""
        for snapshots in self.snapshots.values():
            yield from (one.data for one in snapshots)
        for packs in self.packs.values():
            yield from packs.values()

    def notes_from(self, prefix: str) -> dict[str, bytes]:
        """The notes whose keys begin so."""
        return {key: value for key, value in self.notes.items() if key.startswith(prefix)}
