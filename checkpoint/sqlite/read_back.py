"""Reading one address back: the newest snapshot that can be trusted, and every entry it does not contain."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from array import array
from collections.abc import Sequence

from ..encoding.entry_codec import decode_entry
from ..journal import DamagedStore, Entry, Saved
from .entry_chains import Chain
from .row_codec import CHUNK, PLACE, row_crc, snapshot_digest, unpack_positions
from .sealing import Cipher, drops_place, kept_kind, snapshot_place, unseal_entry
from .snapshot_files import SnapshotFiles


class ChainReader:
    """Reads chains through one connection, within a transaction that holds the file still."""

    def __init__(self, db: sqlite3.Connection, path: str, files: SnapshotFiles, cipher: Cipher) -> None:
        self._db, self.path, self._files, self._cipher = db, path, files, cipher

    def load(self, chain: Chain, positions: array[int], kept: list[int], older: int) -> Saved:
        """Read snapshot and entries of the chain, as they were when `positions` and `kept` were.

        Raises:
            DamagedStore: as `Journal.load`.
        """
        reason = ""
        snapshot, turn = None, 0
        dropped: set[int] = set()
        candidates = kept[: max(1, len(kept) - older)]
        for number in reversed(candidates):
            try:
                found = self.read_snapshot(chain, number)
                dropped = self.read_drops(chain, kept[: kept.index(number) + 1])
                snapshot, turn = found
                break
            except DamagedStore as error:
                reason = reason or error.reason
        if kept and snapshot is None:
            raise DamagedStore(self.path, chain.path, None, f"no snapshot is left: {reason}")
        entries = self._read_entries(chain, positions)
        return Saved(snapshot, turn, [pair for pair in entries if pair[0] not in dropped], reason)

    def read_snapshot(self, chain: Chain, number: int) -> tuple[bytes, int]:
        """A snapshot and its turn.

        Raises:
            DamagedStore: it is missing or damaged.
        """
        row = self._db.execute(
            "SELECT turn, epoch, file, digest, data FROM snapshots WHERE id = ?", (number,)
        ).fetchone()
        if row is None:
            raise DamagedStore(self.path, chain.path, None, f"snapshot {number} is missing")
        turn, epoch, file, digest, data = row
        where = f"snapshot {number}" if file is None else f"snapshot file {self._files.folder}/{file}"
        try:
            if file is None:
                data = self._cipher.unseal(snapshot_place(number), data)
            else:
                data = self._files.read(str(file))
        except (OSError, ValueError) as error:
            raise DamagedStore(self.path, chain.path, None, f"{where} cannot be read: {error}") from error
        key = self._cipher.digest_key
        if not isinstance(data, bytes) or digest != snapshot_digest(chain.path or "", turn, epoch, data, key):
            raise DamagedStore(self.path, chain.path, None, f"the checksum of {where} is wrong")
        return data, turn

    def read_drops(self, chain: Chain, numbers: list[int]) -> set[int]:
        """The positions that the newest of these snapshots contains, as far as they are not yet removed.

        Raises:
            DamagedStore: a list of them is damaged.
        """
        return dropped_by(self._db, self.path, self._cipher, chain, numbers)

    def _read_entries(self, chain: Chain, positions: array[int]) -> list[tuple[int, Entry]]:
        """Read and verify all rows of the chain, in order."""
        entries: list[tuple[int, Entry]] = []
        for start in range(0, len(positions), CHUNK):
            chunk = positions[start : start + CHUNK].tolist()
            rows = self._db.execute(
                "SELECT position, address, chain, kind, data, crc FROM entries"
                f" WHERE position IN ({','.join('?' * len(chunk))}) ORDER BY position",
                chunk,
            ).fetchall()
            if len(rows) != len(chunk):
                lost = min(set(chunk) - {row[0] for row in rows})
                raise DamagedStore(self.path, chain.path, lost, "the entry is missing")
            entries += [(row[0], checked_entry(self.path, self._cipher, chain, *row)) for row in rows]
        return entries


def dropped_by(db: sqlite3.Connection, path: str, cipher: Cipher, chain: Chain, numbers: Sequence[int]) -> set[int]:
    """The positions that these snapshots have still to remove.

    Raises:
        DamagedStore: a list of them is damaged.
    """
    dropped: set[int] = set()
    for number in numbers:
        row = db.execute("SELECT drops FROM snapshots WHERE id = ?", (number,)).fetchone()
        try:
            dropped.update(unpack_positions(cipher.unseal(drops_place(number), row[0])))
        except (TypeError, ValueError, zlib.error) as error:
            reason = f"the drop list of snapshot {number} is damaged"
            raise DamagedStore(path, chain.path, None, reason) from error
    return dropped


def checked_entry(
    path: str,
    cipher: Cipher,
    chain: Chain,
    position: int,
    address: int,
    number: int,
    kind: object,
    data: bytes,
    crc: int,
) -> Entry:
    """The entry of a row, which is to be one of this chain.

    Raises:
        DamagedStore: it is damaged.
    """
    try:
        if address == chain.id:
            return opened_entry(cipher, position, address, number, kind, data, crc)[1]
    except (TypeError, ValueError, struct.error):
        pass  # A flipped bit may also change the type of a column.
    raise DamagedStore(path, chain.path, position, "the checksum of the entry is wrong")


def opened_entry(
    cipher: Cipher, position: int, address: int, number: int, kind: object, data: bytes, crc: int
) -> tuple[bytes, Entry]:
    """The entry of a row, as it was encoded and decoded again.

    Raises:
        ValueError, TypeError, struct.error: it is damaged.
    """
    if crc != row_crc(position, address, number, data):
        raise ValueError("the checksum of the entry is wrong")
    encoded = unseal_entry(cipher, PLACE.pack(position, address, number), data)
    entry = decode_entry(encoded)
    if kind != kept_kind(cipher, entry):
        raise ValueError("the kind of the entry is wrong")
    return encoded, entry
