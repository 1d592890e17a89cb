"""Compaction: a store that nobody has open gives back the room of what it does not need."""

from __future__ import annotations

import dataclasses
import os
from contextlib import closing

from ...actors.errors import HoldfastError
from ..journal import StoreFailed
from ..snapshot.snapshot_record import decode_meta
from ..sqlite import SqliteJournal
from ..sqlite.store_parts import Parts
from ..store_key import StoreKey, read_store_key
from .store_counts import files_of
from .store_view import reading


@dataclasses.dataclass(frozen=True, slots=True)
class Compaction:
    """The outcome of a compaction.

    Attributes:
        path: of the store.
        before: bytes of all its files.
        after: bytes of all its files.
    """

    path: str
    before: int
    after: int


def compact_store(path: str | os.PathLike[str], *, key: StoreKey | None = None) -> Compaction:
    """Remove what a store does not need, and write its database anew without gaps.

    Removed are entries that the oldest kept snapshot contains, files that no snapshot names, and what an erase has
    left. What a recovery reads stays. The store is opened as a system opens it, so that no other can have it meanwhile.
    A kill at any moment leaves it as it was, or compact.

    Args:
        path: the database of the store.
        key: of the store, if it is encrypted.

    Raises:
        StoreInUse: a system has it open. StoreFailed: there is no store, or no room: for a moment the database takes
            up to twice as much again. DamagedStore, ForeignStore, WrongStoreKey: it cannot be opened.
    """
    where, secret = os.path.realpath(path), read_store_key(key)
    with reading(where):
        if not Parts(where, secret).inspect():
            raise StoreFailed(where, "there is no database; name the file, as in store='sqlite:PATH'")
        before = sum(files_of(where).values())
    with closing(SqliteJournal(where, key=secret)) as journal:
        for address in journal.addresses():
            _forget_packs(journal, address)
        journal.compact()
    with reading(where):
        return Compaction(where, before, sum(files_of(where).values()))


def _forget_packs(journal: SqliteJournal, address: str) -> None:
    """Remove the packs of an address that no snapshot names; all stay if one of these cannot be read."""
    there = journal.packs(address)
    if not there:
        return
    try:
        metas = [decode_meta(snapshot) for snapshot in journal.snapshots(address)]
    except HoldfastError:
        return
    needed = {number for meta in metas for number, _, _ in meta.blocks}
    journal.forget_blocks(address, there - needed.union(*(meta.earlier for meta in metas)))
