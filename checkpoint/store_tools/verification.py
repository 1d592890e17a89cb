"""Verification: each byte of a store that counts is read, and what is damaged is told with its place and a remedy."""

from __future__ import annotations

import dataclasses
import os
import sqlite3
from typing import Final

import msgspec

from ...actors.errors import HoldfastError
from ..addresses import is_of_actor
from ..journal import DamagedStore
from ..snapshot.shared_blocks import by_segment
from ..snapshot.snapshot_record import FORMAT, IMAGES, Meta
from ..sqlite.entry_chains import Chain, StoreScan
from ..sqlite.read_back import checked_entry
from ..store_key import StoreKey, read_store_key
from .store_view import StoreView, look

MOST_DAMAGES: Final = 1000
"""How many damages are told one by one; the others are counted."""
_RESTORE: Final = "restore the store from a backup"
_ONE_ADDRESS: Final = f"{_RESTORE}, or start the actor with fresh=True, which forgets what is recorded of it"
_OLDER: Final = (
    "recovery passes it over and takes an older snapshot, with all entries since, as long as one is good: "
    "have a new snapshot taken"
)


@dataclasses.dataclass(frozen=True, slots=True)
class Damage:
    """One thing in a store that cannot be trusted.

    Attributes:
        problem: in words.
        remedy: what to do about it.
        file: in which it is.
        address: of the actor whose record it is in, if it concerns one only.
        position: of the journal entry, if it is one.
    """

    problem: str
    remedy: str
    file: str
    address: str | None = None
    position: int | None = None

    def __str__(self) -> str:
        where = self.file
        if self.address is not None:
            where += f", address {self.address}"
        if self.position is not None:
            where += f", position {self.position}"
        return f"{where}: {self.problem}; {self.remedy}"


@dataclasses.dataclass(slots=True)
class Verification:
    """The result of a verification.

    Attributes:
        path: of the store.
        identity: of the store; "" if it is not known.
        pid: of the process that had it open; 0 if there was none to be seen.
        last: the newest position at the instant that was looked at.
        entries: how many were read.
        snapshots: how many were read.
        packs: how many were read.
        damages: what was found, up to `MOST_DAMAGES`.
        untold: how many more were found.
    """

    path: str
    identity: str = ""
    pid: int = 0
    last: int = 0
    entries: int = 0
    snapshots: int = 0
    packs: int = 0
    damages: list[Damage] = dataclasses.field(default_factory=list[Damage])
    untold: int = 0

    @property
    def is_good(self) -> bool:
        """Say whether nothing is damaged."""
        return not self.damages

    def add(self, damage: Damage) -> None:
        """Take down one more damage, or count it if there are too many."""
        if damage in self.damages:
            return
        if len(self.damages) < MOST_DAMAGES:
            self.damages.append(damage)
        else:
            self.untold += 1


def verify_store(path: str | os.PathLike[str], *, key: StoreKey | None = None) -> Verification:
    """Read all of a store and compare every checksum; nothing is changed, and a system may have the store open.

    Of an open store one instant is verified, not before all that was acknowledged when the call began. Files that the
    running system removes meanwhile, because a newer snapshot has taken their place, are no damage.

    Args:
        path: the database of the store.
        key: of the store, if it is encrypted.

    Raises:
        StoreFailed: there is no store, or it cannot be read. ForeignStore: a part of it is missing or another store's,
            or this user may not read it: nothing was verified. WrongStoreKey: the key is not its own.
    """
    where, secret = os.path.realpath(path), read_store_key(key)
    try:
        return look(where, lambda view: StoreCheck(view).result(), secret)
    except DamagedStore as error:  # It is so damaged that nothing more of it can be read.
        return Verification(where, damages=[Damage(error.reason, _RESTORE, where, error.address, error.position)])


class StoreCheck:
    """Verifies one instant of a store."""

    def __init__(self, view: StoreView) -> None:
        self._view = view
        self._reader = view.reader
        identity = "" if view.identity is None else view.identity.id
        self._found = Verification(view.path, identity, view.pid, view.last)

    def result(self) -> Verification:
        """Do it.

        Raises:
            StoreFailed: it cannot be read.
        """
        view, found = self._view, self._found
        try:
            self._check_pages()
            chains = self._check_chains()
            self._check_entries(chains)
            for chain in chains.values():
                self._check_snapshots(chain)
            view.refuse_missing()
        except DamagedStore as error:
            self._tell(error)
        except sqlite3.DatabaseError as error:
            if isinstance(error, sqlite3.OperationalError):
                raise
            found.add(Damage(str(error), _RESTORE, view.path))
        return found

    def _tell(self, error: DamagedStore) -> None:
        remedy = _RESTORE if error.address is None else _ONE_ADDRESS
        self._found.add(Damage(error.reason, remedy, self._view.path, error.address, error.position))

    def _check_pages(self) -> None:
        for (verdict,) in self._view.db.execute(f"PRAGMA integrity_check({MOST_DAMAGES})"):
            if verdict != "ok":
                self._found.add(Damage(str(verdict), _RESTORE, self._view.path))

    def _check_chains(self) -> dict[int, Chain]:
        """Verify that nothing is missing; returns the chain of each address."""
        view = self._view
        contents = StoreScan(view.db, view.path, view.parts.cipher, self._tell).contents()
        contents.take_in(view.rows, view.path)
        chains = {chain.id: chain for chain in (*contents.chains.values(), *contents.erased)}
        for chain in chains.values():
            if chain.damage is not None:
                self._tell(chain.damage)
        return chains

    def _check_entries(self, chains: dict[int, Chain]) -> None:
        view = self._view
        for position, address, *rest in view.entries():
            chain = chains.get(address)
            if chain is None:
                continue  # It was told that it belongs to none.
            self._found.entries += 1
            try:
                checked_entry(view.path, view.parts.cipher, chain, position, address, *rest)
            except DamagedStore as error:
                self._tell(error)

    def _check_snapshots(self, chain: Chain) -> None:
        if chain.path is None:  # It is being erased.
            return
        wanted: dict[int, set[tuple[int, int]]] = {}
        needs: dict[int, list[int]] = {}
        for number in chain.kept:
            self._found.snapshots += 1
            try:
                data, _ = self._reader.read_snapshot(chain, number)
                self._reader.read_drops(chain, [number])
                if not is_of_actor(chain.path):
                    continue
                meta = msgspec.msgpack.decode(data, type=Meta)
                if meta.format not in (FORMAT, IMAGES):
                    raise HoldfastError(f"its format is {meta.format}, which this holdfast does not know")
            except DamagedStore as error:
                self._snapshot_damaged(chain, [number], error.reason)
            except (HoldfastError, msgspec.MsgspecError) as error:
                self._snapshot_damaged(chain, [number], f"snapshot {number} cannot be read: {error}")
            else:
                for pack, places in by_segment(meta.blocks).items():
                    wanted.setdefault(pack, set()).update(places)
                    needs.setdefault(pack, []).append(number)
        for pack, places in wanted.items():
            self._found.packs += 1
            try:
                self._view.packs.check(chain.path, pack, places)
            except DamagedStore as error:
                self._snapshot_damaged(chain, needs[pack], error.reason, self._view.packs.file(chain.path, pack))

    def _snapshot_damaged(self, chain: Chain, numbers: list[int], problem: str, file: str = "") -> None:
        """Tell of it, unless the running system needs none of these snapshots any more."""
        view = self._view
        row = view.db.execute("SELECT file FROM snapshots WHERE id = ?", (numbers[0],)).fetchone()
        if row is not None and not any(view.is_kept(number) for number in numbers):
            return
        if not file:
            file = view.path if row is None or row[0] is None else os.path.join(view.files.folder, str(row[0]))
        remedy = _OLDER if len(chain.kept) > 1 else _ONE_ADDRESS
        self._found.add(Damage(problem, remedy, file, chain.path))
