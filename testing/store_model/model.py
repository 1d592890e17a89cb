"""The model of a store: dictionaries that hold what every acknowledged operation promises."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from ...actors.errors import StoreError
from ...checkpoint.journal import DamagedStore, Entry, Journal, Saved
from .comparing import PromiseBroken, expect, same, short

Pack = dict[tuple[int, int], bytes]
"""Blocks by (offset, length)."""


class SnapshotModel(NamedTuple):
    """One snapshot that is kept.

    Attributes:
        data: what it is.
        turn: the turn it was made after.
        contained: all positions that it makes superfluous, those of earlier snapshots included.
    """

    data: bytes
    turn: int
    contained: frozenset[int]


@dataclass
class AddressModel:
    """What a store has of one address; snapshots with the oldest first."""

    entries: dict[int, Entry] = field(default_factory=dict)
    snapshots: list[SnapshotModel] = field(default_factory=list)
    packs: dict[int, Pack] = field(default_factory=dict)

    def copy(self) -> AddressModel:
        """The same, to be changed on its own."""
        return AddressModel(dict(self.entries), list(self.snapshots), dict(self.packs))

    def keep(self, count: int) -> None:
        """Forget all snapshots but so many of the newest, and the entries that none of these needs."""
        del self.snapshots[:-count]
        gone = self.snapshots[0].contained
        self.entries = {position: entry for position, entry in self.entries.items() if position not in gone}

    def load(self, older: int = 0) -> Saved:
        """What `Journal.load` is to return."""
        if not self.snapshots:
            return Saved(None, 0, list(self.entries.items()))
        data, turn, contained = self.snapshots[max(0, len(self.snapshots) - 1 - older)]
        return Saved(data, turn, [pair for pair in self.entries.items() if pair[0] not in contained])


class StoreModel:
    """A store as it must be after everything that was acknowledged.

    Attributes:
        places: by address, those that have something stored.
        notes: in the order in which they were last written.
        last: the highest position that was ever acknowledged.
        gone: packs that must not come back, by (address, number).
        unsettled: packs whose removal was broken off: each may be there or not, but no other bytes in its place.
    """

    def __init__(self) -> None:
        self.places: dict[str, AddressModel] = {}
        self.notes: dict[str, bytes] = {}
        self.last = 0
        self.gone: dict[tuple[str, int], Pack] = {}
        self.unsettled: dict[tuple[str, int], Pack] = {}

    def copy(self) -> StoreModel:
        """The same, to be changed on its own."""
        made = StoreModel()
        made.places = {address: place.copy() for address, place in self.places.items()}
        made.notes, made.last = dict(self.notes), self.last
        made.gone, made.unsettled = dict(self.gone), dict(self.unsettled)
        return made

    def place(self, address: str) -> AddressModel:
        """The place of an address, made if there is none."""
        return self.places.setdefault(address, AddressModel())

    # ---- what is acknowledged

    def append(self, entries: Sequence[tuple[str, Entry]], positions: list[int]) -> None:
        """Take in a batch.

        Raises:
            Broken: its positions are none, or do not rise.
        """
        if type(positions) is not list or any(type(position) is not int for position in positions):
            raise PromiseBroken(f"the positions of an append must be a list of ints, not {short(positions)}")
        if len(positions) != len(entries):
            raise PromiseBroken(f"an append of {len(entries)} entries returned {len(positions)} positions")
        for (address, entry), position in zip(entries, positions, strict=True):
            if position <= self.last:
                raise PromiseBroken(f"position {position} was handed out after position {self.last}: they must rise")
            self.last = position
            self.place(address).entries[position] = entry

    def cut(self, address: str, snapshot: bytes, drop: Iterable[int], turn: int, keep: int) -> None:
        """Keep a snapshot; of the positions in `drop` those count that the address has now."""
        place = self.place(address)
        before = place.snapshots[-1].contained if place.snapshots else frozenset[int]()
        contained = before | place.entries.keys() & set(drop)
        place.snapshots.append(SnapshotModel(snapshot, turn, contained))
        place.keep(keep)

    def erase(self, address: str) -> None:
        """Forget an address."""
        place = self.places.pop(address, AddressModel())
        self.gone |= {(address, number): pack for number, pack in place.packs.items()}

    def keep_blocks(self, address: str, number: int, pack: Pack) -> None:
        """Keep a pack."""
        self.place(address).packs[number] = pack
        self.gone.pop((address, number), None)

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """Forget these packs of an address."""
        place = self.places.get(address, AddressModel())
        for number in place.packs.keys() & set(numbers):
            self.gone[address, number] = place.packs.pop(number)
        self._tidy(address)

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a note, as the last one."""
        self.notes.pop(key, None)
        if value is not None:
            self.notes[key] = value

    def _tidy(self, address: str) -> None:
        if address in self.places and self.places[address] == AddressModel():
            del self.places[address]

    # ---- what may be there when a call was broken off

    def after_broken_cut(self, before: StoreModel, address: str) -> Iterator[StoreModel]:
        """What else may be there when a cut was broken off: its snapshot is kept, older ones are not yet removed."""
        place = self.places[address]
        old = before.places.get(address, AddressModel())
        for extra in range(1, len(old.snapshots) + 2 - len(place.snapshots)):
            made = self.copy()
            kept = [*old.snapshots, place.snapshots[-1]][-len(place.snapshots) - extra :]
            made.places[address] = AddressModel(dict(old.entries), kept, dict(place.packs))
            made.places[address].keep(len(kept))
            yield made

    def unsettle(self, before: StoreModel) -> StoreModel:
        """The same, with each pack that was there before and is no more either there or not."""
        made = self.copy()
        for address, place in before.places.items():
            left = made.places[address].packs if address in made.places else {}
            for number, pack in place.packs.items():
                if number not in left:
                    made.gone.pop((address, number), None)
                    made.unsettled[address, number] = pack
        return made

    # ---- comparing

    def check(self, journal: Journal, *, others: Collection[str] = (), prefixes: Collection[str] = ()) -> None:
        """Compare everything a store can be asked with what it must answer.

        Args:
            journal: the store.
            others: addresses that may not be stored: they must be empty then.
            prefixes: of notes to ask for.

        Raises:
            Broken: an answer is wrong.
        """
        self._check_addresses(journal)
        for address in {*self.places, *others}:
            place = self.places.get(address, AddressModel())
            for older in sorted({0, 1, 2, len(place.snapshots), len(place.snapshots) + 3}):
                saved = journal.load(address, older=older)
                what = f"load({address!r:.80}, older={older})"
                if not isinstance(saved, Saved):
                    raise PromiseBroken(f"{what} returned {short(saved)}, which is no Saved")
                expect(tuple(saved)[:3], tuple(place.load(older))[:3], what)
                if saved.passed_over:
                    raise PromiseBroken(f"{what} passed over a snapshot: {saved.passed_over}")
            expect(tuple(journal.load(address))[:3], tuple(place.load())[:3], f"load({address!r:.80})")
        self._check_notes(journal, prefixes)
        self._check_packs(journal)

    def _check_addresses(self, journal: Journal) -> None:
        found = journal.addresses()
        if found != sorted(set(found)):
            raise PromiseBroken(f"the addresses must be sorted, each once, not {short(found)}")
        blocks_only = {address for address, place in self.places.items() if not place.entries and not place.snapshots}
        blocks_only |= {address for address, _ in self.unsettled if address not in self.places}
        wanted = {*self.places} - blocks_only  # Whether a pack alone makes an address known is left to the engine.
        expect(sorted({*found} - blocks_only), sorted(wanted), "addresses()")

    def _check_notes(self, journal: Journal, prefixes: Collection[str]) -> None:
        for prefix in {"", *prefixes}:
            wanted = {key: value for key, value in self.notes.items() if key.startswith(prefix)}
            expect(dict(journal.notes(prefix)), wanted, f"notes({prefix!r:.80})")
            expect(journal.noted(prefix), self.notes.get(prefix), f"noted({prefix!r:.80})")
        for key, value in self.notes.items():
            expect(journal.noted(key), value, f"noted({key!r:.80})")

    def _check_packs(self, journal: Journal) -> None:
        for address, place in self.places.items():
            unsettled = {number for owner, number in self.unsettled if owner == address}
            expect(journal.packs(address) - unsettled, set(place.packs), f"packs({address!r:.80})")
            for number, pack in place.packs.items():
                check_pack(journal, address, number, pack)
        for (address, number), pack in self.gone.items():
            try:
                journal.read_blocks(address, number, list(pack)[:1]).close()
            except DamagedStore:
                continue
            raise PromiseBroken(f"pack {number:x} of {address!r:.80}, which was forgotten, is there again")
        for (address, number), pack in self.unsettled.items():
            try:
                check_pack(journal, address, number, pack)
            except DamagedStore:
                continue


def check_pack(journal: Journal, address: str, number: int, pack: Pack) -> None:
    """Compare the blocks of a pack.

    Raises:
        Broken: they are others. DamagedStore: they are not there.
    """
    with_data = {place: data for place, data in pack.items() if place[1]}
    segment = journal.read_blocks(address, number, list(with_data))
    try:
        expect(segment.number, number, f"the number of pack {number:x} of {address!r:.80}")
        for (offset, length), data in with_data.items():
            found = bytes(segment.block(offset, length))
            if not same(found, data):
                raise PromiseBroken(f"block ({offset}, {length}) of pack {number:x} of {address!r:.80} has other bytes")
    finally:
        segment.close()


def settle(journal: Journal, candidates: Sequence[StoreModel], *, others: Collection[str] = ()) -> StoreModel:
    """Find which of several states a store is in; returns a copy of it.

    Raises:
        Broken: it is in none of them.
    """
    problems: list[str] = []
    for candidate in candidates:
        try:
            candidate.check(journal, others=others)
        except (PromiseBroken, StoreError) as error:
            text = f"{error}" if isinstance(error, PromiseBroken) else f"{type(error).__name__}: {error}"
            if text not in problems:
                problems.append(text)
        else:
            return candidate.copy()
    raise PromiseBroken("; and it is not the other state it may be in, for ".join(problems))
