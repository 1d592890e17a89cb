"""The journal in a SQLite file: what `Journal` promises, as transactions on an open store."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import zlib
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager
from typing import Final, Literal

from ..encoding.entry_codec import check_entry, entry_packer, is_plain
from ..journal import DamagedStore, Entry, Saved, StoreFailed
from ..snapshot.shared_blocks import Segment
from ..store_key import StoreKey, read_store_key
from .append_log import Row
from .block_packs import Packs
from .entry_chains import MODULUS, Chain
from .open_store import INSERT, Store
from .read_back import ChainReader, dropped_by
from .row_codec import CHUNK, PLACE, pack_positions, snapshot_digest
from .sealing import SEALED_KIND, drops_place, entry_sealer, note_row, snapshot_place

_FEW: Final = 128  # More entries at a time, or more bytes, are worth a transaction of their own.
_SMALL: Final = 64 << 10
_INLINE_BYTES: Final = 1 << 20  # SQLite reads and writes larger blobs at less than half a file's speed.


class SqliteJournal:
    """A `Journal` in a SQLite file; one process at a time.

    Args:
        path: the database; created if missing, with mode 0600.
        takeover: kill the process that has the store open, through its pidfd, and wait until it is dead.
        synchronous: `"os"` survives the death of the process at any instant; a power loss may take the newest
            appends, but leaves the store sound. `"fsync"` survives power loss too; each append then waits for the
            disk, so call it in a worker thread, with as many entries as have gathered.
        key: with one, all that the store keeps is encrypted, from its making on: see `read_store_key`.

    Raises:
        StoreInUse: a live process, this one included, has it open.
        ForeignStore: its parts do not belong together, or others than this user may write to them; nothing was changed.
        WrongStoreKey: the key is not the store's; nothing was changed.
        DamagedStore: the file is damaged, or entries that were acknowledged are gone. Damage that concerns one address
            only is raised when that address is used; the others work.
        StoreFailed: the operating system refused.

    All methods may be called from any thread. After an I/O error the journal refuses everything (T13: what a failed
    fsync has left on the disk is unknown): open it again, which verifies it.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        takeover: bool = False,
        synchronous: Literal["os", "fsync"] = "os",
        key: StoreKey | None = None,
    ) -> None:
        if synchronous not in ("os", "fsync"):
            raise ValueError(f"synchronous is 'os' or 'fsync', not {synchronous!r}")
        if not hasattr(os, "pidfd_open"):
            raise RuntimeError("the SQLite store needs Linux: it tells and ends other owners by pidfd")
        self.durable = True
        self.path = os.path.realpath(path)
        self._pack = entry_packer()
        self._store = store = Store(self.path, read_store_key(key), fsync=synchronous == "fsync")
        if os.path.islink(path):
            store.parts.refuse_link(os.path.abspath(path))
        with store.opening(takeover=takeover):
            self._cipher = store.parts.cipher
            self._seal = entry_sealer(self._cipher)
            self._finish()
            self.epoch = store.claim.epoch
            self.in_hand = store.hands
            self._packs = Packs(self.path, store.parts)
            self._reader = ChainReader(store.reader, self.path, store.files, self._cipher)

    def _finish(self) -> None:
        """Finish what an earlier owner began."""
        store = self._store
        while store.contents.erased:
            self._finish_erase(store.contents.erased.pop())
        store.files.remove_all_but(
            {name for (name,) in store.db.execute("SELECT file FROM snapshots WHERE file NOT NULL")}
        )

    def close(self) -> None:
        """Release the store and sync it; a second call does nothing."""
        self._store.close()

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Append (address, entry) pairs as one; see `Journal`. A few cost one write to the log, many a transaction.

        Raises:
            TypeError: an entry holds something else than primitives and tuples of them; nothing was written.
            StaleEpoch: nothing counts as written; a new owner that looked at this very moment may have it all the same.
            DamagedStore, StoreFailed: nothing was written.
        """
        if not entries:
            return []
        store = self._store
        with store.lock:
            pack = self._pack
            packed: list[bytes] = []
            for _, entry in entries:
                if not is_plain(entry):
                    check_entry(entry)
                packed.append(pack(entry))
            size = sum(map(len, packed))
            if len(entries) <= _FEW and size <= _SMALL and store.takes(entries, size):
                store.in_doubt = True
                rows = self._rows(entries, packed)
                store.write_log(rows)
                return [row[0] for row in rows]
            with store.transaction(size) as db:
                first = store.contents.last + 1
                db.executemany(INSERT, self._rows(entries, packed))
                return list(range(first, store.contents.last + 1))

    def sync(self) -> None:
        """Have everything appended so far survive a power loss; see `Journal`. Appends go on meanwhile.

        Raises:
            StoreFailed: from now on everything is refused.
        """
        self._store.sync()

    def has_failed(self) -> bool:
        """Whether everything is refused from now on."""
        return self._store.failure is not None

    def _rows(self, entries: Sequence[tuple[str, Entry]], packed: list[bytes]) -> list[Row]:
        """Give each entry its position and its place in its chain."""
        rows: list[Row] = []
        seal, place, crc32 = self._seal, PLACE.pack, zlib.crc32  # `row_crc`, but this is done for every message
        position, address = self._store.contents.last, entries[0][0]
        chain = self._store.chain(address)
        for (where, entry), data in zip(entries, packed, strict=True):
            if where != address:
                address, chain = where, self._store.chain(where)
            position += 1
            number = chain.last = chain.last + 1
            chain.positions.append(position)
            key = chain.id
            at, kind = place(position, key, number), entry[0]
            if seal is not None:
                data, kind = seal(at, data), SEALED_KIND
            rows.append((position, key, number, kind, data, crc32(data, crc32(at))))
        self._store.contents.last = position
        self._store.contents.live += len(rows)
        return rows

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """Keep the snapshot, then forget what it contains; see `Journal`.

        A snapshot of more than 1 MiB becomes a file, synced before the row that names it is written. All else is one
        transaction, if there is little to remove; to remove much takes more, and long: call it in a worker thread.
        """
        self._store.refuse_failed()
        digest = snapshot_digest(address, turn, self.epoch, snapshot, self._cipher.digest_key)
        file = self._store.files.write(self.epoch, snapshot) if len(snapshot) > _INLINE_BYTES else None
        data = snapshot if file is None else None
        try:
            with self._store.transaction(len(data or b""), note=True) as db:
                chain = self._store.chain(address)
                last = self._store.contents.last  # A position that is yet to come is none that the address has.
                drops = pack_positions([position for position in drop if position <= last])
                row = chain.id, turn, self.epoch
                chain.kept.append(self._insert_snapshot(db, row, drops, file, digest, data))
                chain.floor = chain.last
                files = self._clean_at_once(chain, db, keep)
                chain.write(db, self._cipher)
        except StoreFailed:
            if file is not None and self._store.failure is None:  # After a failed sync nobody knows if the row exists.
                os.unlink(os.path.join(self._store.files.folder, file))
            raise
        try:
            if files is None:
                self._clean(chain, keep)
            else:
                self._store.remove_files(files)
        except StoreFailed:
            if self._store.failure is not None:
                raise
            # The snapshot is kept, which is what we promised; the next cut cleans up.

    def _insert_snapshot(
        self,
        db: sqlite3.Connection,
        row: tuple[int, int, int],
        drops: bytes,
        file: str | None,
        digest: bytes,
        data: bytes | None,
    ) -> int:
        """Give a snapshot its row, and return its number, which what is sealed in that row is bound to."""
        (last,) = db.execute("SELECT max(seq) FROM sqlite_sequence WHERE name = 'snapshots'").fetchone()
        number = 1 + (last or 0)
        kept_drops = self._cipher.seal(drops_place(number), drops)
        kept = None if data is None else self._cipher.seal(snapshot_place(number), data)
        db.execute(
            "INSERT INTO snapshots VALUES (?, ?, ?, ?, ?, ?, ?, ?)", (number, *row, kept_drops, file, digest, kept)
        )
        return number

    def _set_drops(self, db: sqlite3.Connection, number: int, drops: bytes) -> None:
        kept = self._cipher.seal(drops_place(number), drops)
        db.execute("UPDATE snapshots SET drops = ? WHERE id = ?", (kept, number))

    def _clean_at_once(self, chain: Chain, db: sqlite3.Connection, keep: int) -> list[str] | None:
        """Remove what only outdated snapshots need, in the transaction of the cut, if it is little.

        Returns the files to be removed when that is committed; `None` if nothing was done, because it is much or
        damaged.
        """
        if len(chain.kept) < keep:
            return []
        *outdated, heir = chain.kept[: len(chain.kept) - keep + 1]
        try:
            drops = self._drops(chain, db, [*outdated, heir])
            if len(drops) > CHUNK:
                return None
            if drops:
                self._remove_rows(chain, db, array("q", sorted(drops)))
        except DamagedStore:
            return None
        if drops:
            self._set_drops(db, heir, b"")
        del chain.kept[: len(outdated)]
        return self._delete_snapshots(db, outdated)

    def _clean(self, chain: Chain, keep: int) -> None:
        """Remove what only outdated snapshots need. A crash in between is made good by the next cut.

        First the outdated ones go, and the oldest that stays takes over what they had still to remove; only then are
        entries removed: whatever is kept at any moment has all the entries behind it.
        """
        outdated = chain.kept[:-keep]
        if outdated:
            heir = chain.kept[-keep]
            with self._store.transaction(note=True) as db:
                drops = self._drops(chain, db, [*outdated, heir])
                self._set_drops(db, heir, pack_positions(list(drops)) if drops else b"")
                files = self._delete_snapshots(db, outdated)
                del chain.kept[: len(outdated)]
                chain.write(db, self._cipher)
            self._store.remove_files(files)
        if len(chain.kept) >= keep:
            self._remove_dropped(chain, chain.kept[0])

    def _drops(self, chain: Chain, db: sqlite3.Connection, numbers: Sequence[int]) -> set[int]:
        """What these snapshots have still to remove."""
        return dropped_by(db, self.path, self._cipher, chain, numbers)

    def _remove_dropped(self, chain: Chain, number: int) -> None:
        """Physically remove the entries that a snapshot made superfluous, then forget which they were."""
        with self._store.transaction() as db:
            positions = array("q", sorted(self._drops(chain, db, [number])))
        if positions:
            for start in range(0, len(positions), CHUNK):
                self._remove(chain, positions[start : start + CHUNK])
            with self._store.transaction() as db:
                self._set_drops(db, number, b"")

    def _remove(self, chain: Chain, positions: array[int]) -> None:
        """Remove those of the sorted positions that the chain has, in one transaction."""
        with self._store.transaction(note=True) as db:
            self._remove_rows(chain, db, positions)
            chain.write(db, self._cipher)

    def _remove_rows(self, chain: Chain, db: sqlite3.Connection, positions: array[int]) -> None:
        """Remove those of the sorted positions that the chain has.

        Raises:
            DamagedStore: some of them are not there; nothing was removed.
        """
        low, high = bisect_left(chain.positions, positions[0]), bisect_right(chain.positions, positions[-1])
        doomed = set(positions)
        window = chain.positions[low:high]
        gone = [position for position in window if position in doomed]
        marks = ",".join("?" * len(gone))
        number, total = db.execute(
            f"SELECT count(*), sum(chain) FROM entries WHERE position IN ({marks})", gone
        ).fetchone()
        if number != len(gone):
            raise DamagedStore(self.path, chain.path, gone[0], "entries have vanished")
        db.execute(f"DELETE FROM entries WHERE position IN ({marks})", gone)
        chain.positions[low:high] = array("q", (position for position in window if position not in doomed))
        chain.removed += number
        chain.removed_sum = (chain.removed_sum + (total or 0)) % MODULUS
        self._store.contents.live -= number

    def _delete_snapshots(self, db: sqlite3.Connection, numbers: Sequence[int]) -> list[str]:
        """Delete the rows; return the files to be removed once that is committed."""
        files: list[str] = []
        for number in numbers:
            row = db.execute("SELECT file FROM snapshots WHERE id = ?", (number,)).fetchone()
            files += [row[0]] if row and row[0] else []
            db.execute("DELETE FROM snapshots WHERE id = ?", (number,))
        return files

    def load(self, address: str, *, older: int = False) -> Saved:
        """Read back one address; see `Journal`. Appends go on meanwhile."""
        with self._store.read_lock:
            try:
                with self._store.view(address) as view:
                    return Saved(None, 0, []) if view is None else self._reader.load(*view, older)
            except sqlite3.Error as error:
                translated = self._store.translate(error)
                if isinstance(translated, DamagedStore):
                    raise DamagedStore(self.path, address, None, translated.reason) from error
                raise translated from error

    def snapshots(self, address: str) -> list[bytes]:
        """All snapshots of an address that are kept, oldest first.

        Raises:
            DamagedStore: one of them cannot be read.
        """
        with self._store.read_lock, self._store.view(address) as view:
            if view is None:
                return []
            chain, _, kept = view
            return [self._reader.read_snapshot(chain, number)[0] for number in kept]

    def erase(self, address: str) -> None:
        """Forget everything about the address; see `Journal`."""
        with self._store.lock:
            self._store.refresh()
            if address not in self._store.contents.chains:
                self.forget_blocks(address, self.packs(address))  # of a snapshot that was never cut
                return
            files: list[str] | None = None
            with self._store.transaction(note=True) as db:
                # From here on it is gone; if we die before the rest is done, the next opening does it.
                chain = self._store.contents.chains.pop(address)
                chain.path = None
                if len(chain.positions) <= CHUNK:
                    files = self._remove_chain(chain, db)
                else:
                    chain.write(db, self._cipher)
        if files is None:
            self._finish_erase(chain)
        else:
            self._store.remove_files(files)
        if self._packs.names(address):
            self._store.sync_rows()
        self._packs.erase(address)

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        """Keep blocks of a large snapshot as a pack; see `Journal`. Call it in a thread: it waits for the disk."""
        self._store.refuse_failed()
        self._packs.write(address, number, blocks, compress)

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """Read blocks of a pack, and verify them; see `Journal`."""
        return self._packs.read(address, number, places)

    def packs(self, address: str) -> set[int]:
        """Return the packs of an address; see `Journal`."""
        return self._packs.names(address)

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """Remove packs that no kept snapshot needs; see `Journal`."""
        unneeded = self._packs.names(address).intersection(numbers)
        if not unneeded:
            return
        with self._store.transaction():
            pass  # Somebody else may own the store by now: then the packs are theirs.
        self._store.sync_rows()
        self._packs.remove(address, unneeded)

    def compact(self) -> None:
        """Give back the room of what is not needed: entries that the oldest snapshot contains, and free pages.

        The database is written anew within one transaction, which takes as much room again for as long as it lasts.

        Raises:
            StoreFailed: there is no room; all is as it was.
        """
        store = self._store
        with store.lock:
            store.refresh()
            for chain in store.contents.chains.values():
                if chain.kept and chain.damage is None:
                    with contextlib.suppress(DamagedStore):  # Then it stays as it is, to be looked at.
                        self._remove_dropped(chain, chain.kept[0])
            with store.transaction(note=True):
                pass
            try:
                store.db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()  # Its room may be all that there is.
                store.db.execute("VACUUM")
                store.db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
            except sqlite3.Error as error:
                raise store.translate(error) from error

    def _finish_erase(self, chain: Chain) -> None:
        while len(chain.positions) > CHUNK:
            self._remove(chain, chain.positions[:CHUNK])
        with self._store.transaction(note=True) as db:
            files = self._remove_chain(chain, db)
        self._store.remove_files(files)

    def _remove_chain(self, chain: Chain, db: sqlite3.Connection) -> list[str]:
        """Remove all rows of an address; return the files to be removed once that is committed."""
        if chain.positions:
            self._remove_rows(chain, db, chain.positions[:])
        files = self._delete_snapshots(db, chain.kept)
        db.execute("DELETE FROM addresses WHERE id = ?", (chain.id,))
        return files

    def addresses(self) -> list[str]:
        """Every address that has something stored, sorted."""
        with self._store.lock:
            self._store.refresh()
            return sorted(self._store.contents.chains)

    def together(self) -> AbstractContextManager[None]:
        """Have all that is written meanwhile be kept completely, or not at all; see `Journal`."""
        self._store.refuse_failed()
        return self._store.together()

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small named fact; see `Journal`."""
        with self._store.transaction(len(value or b""), note=True) as db:
            contents = self._store.contents
            contents.notes.pop(key, None)
            row = contents.note_rows.pop(key, None)
            if row is not None:
                db.execute("DELETE FROM notes WHERE key = ?", (row,))
            if value is not None:
                kept = db.execute("INSERT INTO notes VALUES (NULL, ?, ?, ?)", note_row(self._cipher, key, value))
                contents.notes[key] = value
                assert kept.lastrowid is not None
                contents.note_rows[key] = kept.lastrowid

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or `None`."""
        with self._store.lock:
            self._store.refresh()
            return self._store.contents.notes.get(key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """All facts whose keys begin so; see `Journal`."""
        with self._store.lock:
            self._store.refresh()
            return {key: value for key, value in self._store.contents.notes.items() if key.startswith(prefix)}
