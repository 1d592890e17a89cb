"""Statistics of a store: what is recorded of each address, how much room it takes, and what waits."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from typing import Final

import msgspec

from ..addresses import KEY, is_of_actor
from ..home.input_ledger import InputLedger
from ..journal import DamagedStore, Entry
from ..protocol import START
from ..snapshot.snapshot_record import Meta
from ..sqlite.entry_chains import Chain, StoreScan
from ..sqlite.read_back import checked_entry
from ..sqlite.row_codec import CHUNK
from ..sqlite.store_parts import origin_of, part_names
from ..store_key import StoreKey, read_store_key
from .store_view import StoreView, look

_COLUMNS: Final = "position, address, chain, kind, data, crc"


@dataclasses.dataclass(frozen=True, slots=True)
class SnapshotStats:
    """One snapshot that is kept.

    Attributes:
        turn: after which it was made.
        size: in bytes, with its blocks in packs.
        time: when it was made, in Unix time; 0 if that is not known.
    """

    turn: int
    size: int
    time: float


@dataclasses.dataclass(slots=True)
class AddressStats:
    """The record of one actor.

    Attributes:
        address: of the actor.
        kind: its class, as "module:Class"; "" if that is not known.
        turns: the number of its last turn; its start is turn 0, and -1 stands for none.
        entries: in the journal; those that a kept snapshot contains are among them until a later one removes them.
        size: of these entries, in bytes.
        waiting: inputs that are accepted and not handled.
        snapshots: those that are kept, oldest first.
        damage: why it cannot be told all; "" if it can.
    """

    address: str
    kind: str = ""
    turns: int = -1
    entries: int = 0
    size: int = 0
    waiting: int = 0
    snapshots: list[SnapshotStats] = dataclasses.field(default_factory=list[SnapshotStats])
    damage: str = ""


@dataclasses.dataclass(slots=True)
class StoreStats:
    """The contents of a store at one instant.

    Attributes:
        path: of the store.
        identity: of the store; "" if it has none.
        origin: the identity of the store that it is a copy of; "" if it is none.
        copied_at: when it was copied, in Unix time.
        version: of the format; even while there may be something in the log, more than 2 if it is encrypted.
        epoch: how often it was opened.
        pid: of the process that has it open; 0 if there is none to be seen.
        last: the newest position.
        notes: small facts, such as group snapshots and moves.
        addresses: sorted.
        files: their sizes in bytes, by name beside the database; a folder counts with all that is in it.
    """

    path: str
    identity: str
    origin: str
    copied_at: float
    version: int
    epoch: int
    pid: int
    last: int
    notes: int
    addresses: list[AddressStats]
    files: dict[str, int]


def store_stats(path: str | os.PathLike[str], *, key: StoreKey | None = None) -> StoreStats:
    """Count what is in a store, per address and in all; nothing is changed, and a system may have the store open.

    Args:
        path: the database of the store.
        key: of the store, if it is encrypted.

    Raises:
        StoreFailed: there is no store, or it cannot be read. DamagedStore, ForeignStore: it is so damaged that its
            contents are not known; what concerns one address only is told there. WrongStoreKey: the key is not its own.
    """
    return look(path, _counted, read_store_key(key))


def _counted(view: StoreView) -> StoreStats:
    contents = StoreScan(view.db, view.path, view.parts.cipher).contents()
    contents.take_in(view.rows, view.path)
    names = {key.decode(): at.removeprefix(KEY) for at, key in contents.notes.items() if at.startswith(KEY)}
    addresses = [_count_address(view, chain, names.get(key, key)) for key, chain in sorted(contents.chains.items())]
    origin, copied_at = origin_of(view.db) or ("", 0.0)
    identity = "" if view.identity is None else view.identity.id
    return StoreStats(
        view.path,
        identity,
        origin,
        copied_at,
        view.version,
        view.row.epoch,
        view.pid,
        view.last,
        len(contents.notes),
        sorted(addresses, key=lambda one: one.address),
        files_of(view.path),
    )


def files_of(path: str) -> dict[str, int]:
    """The files and folders of a store, with their sizes in bytes."""
    return {os.path.basename(name): _size(name) for name in part_names(path) if os.path.lexists(name)}


def _size(name: str) -> int:
    """Bytes of a file, or of all files in a folder, as far as they stay where they are."""
    try:
        if not os.path.isdir(name):
            return os.lstat(name).st_size
        return sum(_size(os.path.join(name, one)) for one in os.listdir(name))
    except FileNotFoundError:
        return 0


def _count_address(view: StoreView, chain: Chain, address: str) -> AddressStats:
    found = AddressStats(address)
    if chain.damage is not None:
        found.damage = chain.damage.reason
    ledger = InputLedger(address)
    contained: set[int] = set()
    for place, number in enumerate(chain.kept):
        try:
            data, turn = view.reader.read_snapshot(chain, number)
            meta = msgspec.msgpack.decode(data, type=Meta) if is_of_actor(address) else None
            contained = view.reader.read_drops(chain, chain.kept[: place + 1])
        except (DamagedStore, msgspec.MsgspecError) as error:
            if view.is_kept(number):  # Else the running system has a newer one now.
                found.damage = found.damage or (error.reason if isinstance(error, DamagedStore) else str(error))
            continue
        if meta is None:
            found.snapshots.append(SnapshotStats(turn, len(data), 0.0))
            continue
        size = len(meta.state) + sum(length for _, _, length in meta.blocks)
        found.snapshots.append(SnapshotStats(meta.turn, size, meta.time))
        found.kind = meta.made.kind
        ledger.begin_after(msgspec.structs.replace(meta, state=b""))
    try:
        for position, size, entry in entries_of(view, chain):
            found.entries += 1
            found.size += size
            if position in contained:
                continue
            match entry:
                case ("in", _, kind, _, bytes() as body, *_):
                    if kind == START:
                        found.kind = found.kind or body.decode(errors="replace")
                    entry = (*entry[:4], b"", *entry[5:])  # It is only counted: what it says need not be held.
                case ("ins", _, _, tuple() as inputs, *_):
                    bare = tuple(b"" if isinstance(part, bytes) else part for part in inputs)
                    entry = (*entry[:3], bare, *entry[4:])
                case _:
                    pass
            ledger.read_entry(position, entry)
    except DamagedStore as error:
        found.damage = found.damage or str(error.reason)
    found.turns = ledger.turn
    found.waiting = sum(source.kind != START for source in ledger.open.values())
    return found


def entries_of(view: StoreView, chain: Chain) -> Iterator[tuple[int, int, Entry]]:
    """The entries of a chain, oldest first: position, bytes, and the entry.

    Raises:
        DamagedStore: one is damaged or missing.
    """
    in_log = {row[0] for row in view.rows}
    positions = [position for position in chain.positions if position not in in_log]
    for start in range(0, len(positions), CHUNK):
        chunk = positions[start : start + CHUNK]
        marks = ",".join("?" * len(chunk))
        query = f"SELECT {_COLUMNS} FROM entries WHERE position IN ({marks}) ORDER BY position"
        for row in view.db.execute(query, chunk):
            yield row[0], len(row[4]), checked_entry(view.path, view.parts.cipher, chain, *row)
    for row in view.rows:
        if row[1] == chain.id:
            yield row[0], len(row[4]), checked_entry(view.path, view.parts.cipher, chain, *row)
