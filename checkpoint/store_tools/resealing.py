"""The rows of a store, written anew for another one that has another key, or none.

What is damaged stays damaged: it is copied as it is, with a checksum that nothing has.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from typing import Any

from ..sqlite.database import create_tables
from ..sqlite.entry_chains import CHAINS, Chain
from ..sqlite.open_store import INSERT
from ..sqlite.read_back import opened_entry
from ..sqlite.row_codec import PLACE, row_crc, snapshot_digest
from ..sqlite.sealing import Cipher, drops_place, note_row, read_note, sealed_entry, snapshot_place
from ..sqlite.snapshot_files import SnapshotFiles
from ..sqlite.store_parts import is_hidden
from .store_view import StoreView

Row = tuple[Any, ...]


class Resealing:
    """Writes the rows of a view into a new database.

    Args:
        view: of the old store.
        cipher: of the new one.
        files: of snapshots, which the new one has already: the old one may have gone on, and have removed its own.
    """

    def __init__(self, view: StoreView, cipher: Cipher, files: SnapshotFiles) -> None:
        self._view, self._old, self._new, self._files = view, view.parts.cipher, cipher, files
        self._chains: dict[int, Chain] = {}

    def write(self, db: sqlite3.Connection) -> None:
        """Write all rows but those that say which store it is."""
        create_tables(db, self._new)
        db.execute("BEGIN IMMEDIATE")
        db.executemany("INSERT INTO addresses VALUES (?, ?, ?, ?, ?, ?, ?)", self._addresses())
        db.executemany(INSERT, self._entries())
        db.executemany("INSERT INTO snapshots VALUES (?, ?, ?, ?, ?, ?, ?, ?)", self._snapshots())
        db.executemany("INSERT INTO notes VALUES (NULL, ?, ?, ?)", self._notes())
        db.execute("DELETE FROM sqlite_sequence")  # No number is given twice, not even one of what is gone.
        sequences = self._view.db.execute("SELECT name, seq FROM sqlite_sequence")
        db.executemany("INSERT INTO sqlite_sequence VALUES (?, ?)", sequences)
        db.execute("COMMIT")

    def _addresses(self) -> Iterator[Row]:
        for row in self._view.db.execute(CHAINS):
            try:
                chain = Chain.read(row, self._old)
            except ValueError:
                yield (*row[:-1], None)
            else:
                self._chains[chain.id] = chain
                yield chain.row(self._new)

    def _entries(self) -> Iterator[Row]:
        for row in self._view.entries():
            try:
                encoded, entry = opened_entry(self._old, *row)
            except (TypeError, ValueError, struct.error):
                yield (*row[:-1], None)
            else:
                position, address, number, *_ = row
                kind, data = sealed_entry(self._new, PLACE.pack(position, address, number), entry, encoded)
                yield position, address, number, kind, data, row_crc(position, address, number, data)

    def _snapshots(self) -> Iterator[Row]:
        query = "SELECT id, address, turn, epoch, drops, file, digest, data FROM snapshots"
        for number, address, turn, epoch, drops, file, digest, data in self._view.db.execute(query):
            chain, kept = self._chains.get(address), data
            about = ("" if chain is None else chain.path or "", turn, epoch)
            try:
                if file is None:
                    state = self._old.unseal(snapshot_place(number), data)
                    kept = self._new.seal(snapshot_place(number), state)
                else:
                    state = self._files.read(str(file))
                is_good = digest == snapshot_digest(*about, state, self._old.digest_key)
                new_digest = snapshot_digest(*about, state, self._new.digest_key) if is_good else b""
            except (OSError, ValueError, TypeError):
                new_digest = b""
            try:
                kept_drops = self._new.seal(drops_place(number), self._old.unseal(drops_place(number), drops))
            except ValueError:
                kept_drops = drops
            yield number, address, turn, epoch, kept_drops, file, new_digest, kept

    def _notes(self) -> Iterator[Row]:
        for name, value, crc in self._view.db.execute("SELECT name, value, crc FROM notes ORDER BY key"):
            if is_hidden(name):
                continue
            try:
                yield note_row(self._new, *read_note(self._old, name, value, crc))
            except ValueError:
                yield name, value, None
