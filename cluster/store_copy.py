"""A copy of what one store has in another one, of whatever kind: between a file and servers, both ways.

No system may have either of them open. The copy is there completely or not at all: until it has been compared it has a
mark, by which no system takes it, and the next attempt begins with an empty store. Positions are handed out anew:
nothing that is recorded refers to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from ..actors.errors import HoldfastError
from ..checkpoint.addresses import is_of_actor
from ..checkpoint.journal import DamagedStore, Entry, NotCopied, Saved, StoreEngine
from ..checkpoint.snapshot.shared_blocks import by_segment
from ..checkpoint.snapshot.snapshot_record import decode_meta
from ..checkpoint.store_opening import UNFINISHED


class CopiedStore(NamedTuple):
    """What was copied.

    Attributes:
        addresses: of how many actors.
        snapshots: how many of them.
        entries: of their journals.
        notes: small facts, such as which children were started by hand.
    """

    addresses: int
    snapshots: int
    entries: int
    notes: int


class KeptAddress(NamedTuple):
    """What a store keeps of one address.

    Attributes:
        snapshots: oldest first, each with the turn after which it was made, and the places of those entries that it
            contains, and no older one.
        entries: all that the oldest snapshot does not contain.
        blocks: of large snapshots, by pack and offset.
    """

    snapshots: list[tuple[bytes, int, list[int]]]
    entries: list[Entry]
    blocks: dict[int, dict[int, bytes]]


def copy_store(source: StoreEngine, dest: StoreEngine, *, names: tuple[str, str]) -> CopiedStore:
    """Copy all that a store has into an empty one, and compare the two.

    Args:
        source: open, and stays as it is.
        dest: open, and has nothing.
        names: what errors call the two.

    Raises:
        NotCopied: there is something in `dest` already that is no copy which was given up; or what is there afterwards
            is not the same.
        DamagedStore: something in `source` is damaged.
        StoreFailed: one of them cannot be read or written.
    """
    if source.noted(UNFINISHED) is not None:
        raise NotCopied(*names, "it is a copy itself that was never finished", "copy the store that it was made of")
    if dest.noted(UNFINISHED) is not None:
        _clear(dest)
    elif dest.addresses() or dest.notes(""):
        raise NotCopied(*names, "there is something in it already", "name an empty store")
    dest.note(UNFINISHED, b"")
    dest.sync()  # Before anything else stands there.
    addresses = source.addresses()
    snapshots = entries = 0
    with dest.together():
        for address in addresses:
            kept = kept_of(source, address)
            snapshots, entries = snapshots + len(kept.snapshots), entries + len(kept.entries)
            _put(dest, address, kept)
        notes = source.notes("")
        for key, value in notes.items():
            dest.note(key, value)
    dest.sync()
    for problem in differences(source, dest):
        raise NotCopied(*names, problem, "no system takes it: make another")
    dest.note(UNFINISHED, None)
    dest.sync()
    return CopiedStore(len(addresses), snapshots, entries, len(notes))


def _clear(dest: StoreEngine) -> None:
    """Take out what a copy has left that was given up."""
    with dest.together():
        for address in dest.addresses():
            dest.erase(address)
        for key in dest.notes(""):
            if key != UNFINISHED:
                dest.note(key, None)


def kept_of(store: StoreEngine, address: str) -> KeptAddress:
    """All that a store keeps of an address.

    Raises:
        DamagedStore: some of it is damaged. HoldfastError: a snapshot is of a format that this holdfast does not know.
    """
    saved = _saved(store, address)
    positions = [position for position, _ in saved[0].entries]
    snapshots: list[tuple[bytes, int, list[int]]] = []
    blocks: dict[int, dict[int, bytes]] = {}
    before = set(positions)
    for one in saved:
        if one.snapshot is not None:
            if is_of_actor(address):
                _read_blocks(store, address, one.snapshot, blocks)
            left = {position for position, _ in one.entries}
            gone = before - left
            snapshots.append((one.snapshot, one.turn, [n for n, position in enumerate(positions) if position in gone]))
            before = left
    return KeptAddress(snapshots, [entry for _, entry in saved[0].entries], blocks)


def _saved(store: StoreEngine, address: str) -> list[Saved]:
    """What the store gives back with each snapshot that it keeps, the oldest first.

    Raises:
        DamagedStore: a newer one had to be passed over, or none is left.
    """
    found: list[Saved] = []
    while True:
        one = store.load(address, older=len(found))
        if one.passed_over:
            raise DamagedStore("to be copied", address, None, one.passed_over)
        if found and (one.turn, one.snapshot) == (found[-1].turn, found[-1].snapshot):
            return found[::-1]
        found.append(one)
        if one.snapshot is None:
            return found[::-1]


def _read_blocks(store: StoreEngine, address: str, snapshot: bytes, blocks: dict[int, dict[int, bytes]]) -> None:
    """Add the blocks that a snapshot of an actor consists of, by pack and offset."""
    try:
        meta = decode_meta(snapshot)
    except HoldfastError as error:
        remedy = "copy with the release of holdfast that wrote the store, or restore the store from a backup"
        raise HoldfastError(f"{address} cannot be copied: {error}; {remedy}") from error
    for number, places in by_segment(meta.blocks).items():
        segment = store.read_blocks(address, number, places)
        try:
            own = blocks.setdefault(number, {})
            own.update((offset, bytes(segment.block(offset, length))) for offset, length in places)
        finally:
            segment.close()


def _put(dest: StoreEngine, address: str, kept: KeptAddress) -> None:
    for number, blocks in kept.blocks.items():
        dest.keep_blocks(address, number, [(at, memoryview(block)) for at, block in sorted(blocks.items())], False)
    positions = dest.append([(address, entry) for entry in kept.entries])
    for data, turn, contains in kept.snapshots:
        drop = [positions[number] for number in contains]
        dest.cut(address, data, drop, turn=turn, keep=len(kept.snapshots))


def differences(one: StoreEngine, other: StoreEngine) -> Iterator[str]:
    """What two stores do not have alike, in words."""
    if one.addresses() != other.addresses():
        yield f"it has {len(other.addresses())} addresses, and not the {len(one.addresses())} of the first"
    if one.notes("") != {key: value for key, value in other.notes("").items() if key != UNFINISHED}:
        yield "its notes are others"
    for address in one.addresses():
        if kept_of(one, address) != kept_of(other, address):
            yield f"it has something else of {address}"
