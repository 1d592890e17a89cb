"""The chains of journal entries per address, found by one scan that notices whether any entry is missing."""

from __future__ import annotations

import sqlite3
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from ..journal import DamagedStore
from .append_log import Row
from .row_codec import crc_of
from .sealing import Cipher, NoCipher, read_note, seal_path, unseal_path
from .store_parts import is_hidden

CHAINS: Final = "SELECT id, path, removed, removed_sum, floor, kept, crc FROM addresses"
MODULUS: Final = 1 << 62  # SQLite integers end at 2**63


@dataclass(slots=True)
class Chain:
    """What is known of one address. `path` is `None` while an erase is under way."""

    id: int
    path: str | None
    removed: int = 0  # rows removed by cuts, and the sum of their chain numbers
    removed_sum: int = 0
    floor: int = 0  # the chain is at least this long
    kept: list[int] = field(default_factory=list[int])  # ids of its snapshots, oldest first
    last: int = 0  # newest chain number
    total: int = 0  # sum of the chain numbers of `positions`
    positions: array[int] = field(default_factory=lambda: array("q"))
    damage: DamagedStore | None = None

    @classmethod
    def read(cls, row: Sequence[Any], cipher: Cipher) -> Chain:
        """What the row of an address says.

        Raises:
            ValueError: it is damaged.
        """
        *fields, crc = row
        number, kept_path, removed, removed_sum, floor, kept = fields
        path = unseal_path(cipher, number, kept_path)
        if crc_of(*fields, key=cipher.digest_key) != crc:
            raise ValueError(f"the checksum of the row of the address {path} is wrong")
        return cls(number, path, removed, removed_sum, floor, [int(one) for one in kept.split(",") if one])

    def row(self, cipher: Cipher) -> tuple[Any, ...]:
        """The row of the address."""
        kept = ",".join(map(str, self.kept))
        fields = self.id, seal_path(cipher, self.id, self.path), self.removed, self.removed_sum, self.floor, kept
        return *fields, crc_of(*fields, key=cipher.digest_key)

    def write(self, db: sqlite3.Connection, cipher: Cipher) -> None:
        """Bring the row of the address up to date, within the running transaction."""
        number, *fields = self.row(cipher)
        db.execute(
            "UPDATE addresses SET path = ?, removed = ?, removed_sum = ?, floor = ?, kept = ?, crc = ? WHERE id = ?",
            (*fields, number),
        )


def create_chain(db: sqlite3.Connection, address: str, cipher: Cipher) -> Chain:
    """Give an address its row, within the running transaction."""
    number = db.execute("INSERT INTO addresses(path) VALUES (NULL)").lastrowid
    assert number is not None
    chain = Chain(number, address)
    chain.write(db, cipher)
    return chain


@dataclass(slots=True)
class StoreContents:
    """What the file holds, apart from entries and snapshots themselves."""

    chains: dict[str, Chain]  # by address
    erased: list[Chain]  # whose erase was begun
    notes: dict[str, bytes]
    last: int  # newest position ever handed out
    live: int  # rows in `entries`
    note_rows: dict[str, int] = field(default_factory=dict[str, int])  # where each note stands

    def take_in(self, rows: Sequence[Row], path: str) -> None:
        """Take in what is in the log of the store at `path`.

        Raises:
            DamagedStore: an entry belongs to no address.
        """
        chains = {chain.id: chain for chain in self.chains.values()}
        for position, key, number, *_ in rows:
            chain = chains.get(key)
            if chain is None:
                raise DamagedStore(path, None, position, "the entry belongs to no address")
            if number != chain.last + 1 and chain.damage is None:
                chain.damage = DamagedStore(path, chain.path, position, "entries are missing")
            chain.last = number
            chain.positions.append(position)
        if rows:
            self.last = rows[-1][0]
            self.live += len(rows)


def refuse(damage: DamagedStore) -> None:
    """Have a scan end at the first damage that cannot be laid to one address."""
    raise damage


class StoreScan:
    """One look at the whole file.

    Args:
        db: reads it.
        path: of the store.
        cipher: of the store.
        tell: is told what is damaged and cannot be laid to one address; what it does not raise is passed over.
    """

    def __init__(
        self, db: sqlite3.Connection, path: str, cipher: Cipher, tell: Callable[[DamagedStore], None] = refuse
    ) -> None:
        self._db, self._path, self._cipher, self._tell = db, path, cipher, tell

    def contents(self) -> StoreContents:
        """Find where each address has its entries, and verify that none is missing: else its chain says so (`damage`).

        Raises:
            DamagedStore: as `tell`.
        """
        floor, live = self._db.execute("SELECT floor, live FROM store").fetchone()
        chains = self._addresses()
        last, total = self._entries(chains)
        for chain in chains.values():
            self._verify(chain)
        last = max(last, floor)
        if total != live + last - floor and not any(chain.damage for chain in chains.values()):
            reason = f"there should be {live + last - floor} entries, there are {total}"
            self._tell(DamagedStore(self._path, None, None, reason))
        known = {chain.path: chain for chain in chains.values() if chain.path is not None}
        erased = [chain for chain in chains.values() if chain.path is None]
        notes, rows = self._notes()
        return StoreContents(known, erased, notes, last, total, rows)

    def _addresses(self) -> dict[int, Chain]:
        chains: dict[int, Chain] = {}
        for row in self._db.execute(CHAINS):
            try:
                chains[row[0]] = Chain.read(row, self._cipher)
            except ValueError as error:
                address = row[1] if isinstance(row[1], str) else None
                self._tell(DamagedStore(self._path, address, None, str(error)))
        for number, address in self._db.execute("SELECT id, address FROM snapshots"):
            if address not in chains:
                self._tell(DamagedStore(self._path, None, None, f"snapshot {number} belongs to no address"))
        return chains

    def _entries(self, chains: dict[int, Chain]) -> tuple[int, int]:
        """Give each chain its positions; return the newest position and the number of entries."""
        position = total = 0
        for position, address, number in self._db.execute(
            "SELECT position, address, chain FROM entries ORDER BY position"
        ):
            chain = chains.get(address)
            if chain is None or type(number) is not int:
                self._tell(DamagedStore(self._path, None, position, "the entry belongs to no address"))
                continue
            if number <= chain.last and chain.damage is None:
                chain.damage = DamagedStore(self._path, chain.path, position, "the entry is out of order")
            chain.last = number
            chain.total += number
            chain.positions.append(position)
            total += 1
        return position, total

    def _notes(self) -> tuple[dict[str, bytes], dict[str, int]]:
        notes: dict[str, bytes] = {}
        rows: dict[str, int] = {}
        for row, name, value, crc in self._db.execute("SELECT key, name, value, crc FROM notes ORDER BY key"):
            try:
                known, data = read_note(NoCipher() if is_hidden(name) else self._cipher, name, value, crc)
            except ValueError as error:
                self._tell(DamagedStore(self._path, None, None, str(error)))
                continue
            if not is_hidden(name):
                notes[known], rows[known] = data, row
        return notes, rows

    def _verify(self, chain: Chain) -> None:
        """Note the damage if entries are missing anywhere but at the end."""
        length = len(chain.positions) + chain.removed
        missing = (length * (length + 1) // 2 - chain.total - chain.removed_sum) % MODULUS
        if chain.damage is None and (missing or length < max(chain.floor, chain.last)):
            chain.damage = DamagedStore(self._path, chain.path, self._hole(chain), "entries are missing")
        chain.last = length

    def _hole(self, chain: Chain) -> int | None:
        """The position before which the missing entry was, if it is certain which one it is."""
        length = len(chain.positions) + chain.removed + 1  # if it is only one, and it is not the last
        absent = (length * (length + 1) // 2 - chain.total - chain.removed_sum) % MODULUS
        for position, number in self._db.execute(
            "SELECT position, chain FROM entries WHERE address = ? ORDER BY position", (chain.id,)
        ):
            if type(number) is int and number >= absent:
                return int(position) if number > absent else None
        return None
