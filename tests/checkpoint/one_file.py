"""An engine as a user might write it from the documents: one pickle, written anew with each change."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pickle
import threading
from collections.abc import Collection, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from holdfast.checkpoint.journal import DamagedStore, Entry, Saved, StoreFailed, StoreInUse
from holdfast.checkpoint.snapshot.shared_blocks import Segment


def check(entry: object) -> None:
    """Raise TypeError unless it is an entry."""
    if not isinstance(entry, tuple) or not entry:
        raise TypeError(f"{entry!r} is no entry")
    check_part(entry)


def check_part(part: Any) -> None:
    """Raise TypeError unless it is made of what entries are made of."""
    if isinstance(part, tuple):
        for one in part:
            check_part(one)
    elif part is not None and not isinstance(part, (int, float, str, bytes)):
        raise TypeError(f"an entry cannot hold {part!r}")


@dataclass
class Contents:
    """Everything that is in the file."""

    epoch: int = 0
    last: int = 0
    entries: dict[str, dict[int, Entry]] = field(default_factory=dict)
    snapshots: dict[str, list[tuple[bytes, int, set[int]]]] = field(default_factory=dict)
    """Of each address, oldest first: data, turn, and all positions that it contains."""
    blocks: dict[tuple[str, int], dict[tuple[int, int], bytes]] = field(default_factory=dict)
    notes: dict[str, bytes] = field(default_factory=dict)

    def copy(self) -> Contents:
        """The same, to be changed on its own."""
        entries = {address: dict(known) for address, known in self.entries.items()}
        snapshots = {address: list(kept) for address, kept in self.snapshots.items()}
        return Contents(self.epoch, self.last, entries, snapshots, dict(self.blocks), dict(self.notes))


class OneFile:
    """Slow, and safe against kills and power losses, because the new file is synced before it replaces the old one."""

    durable = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._refusal = ""
        self._owner = self._lock_out()
        try:
            self._contents = self._read()
            with self._changing() as contents:
                contents.epoch += 1
        except BaseException:
            os.close(self._owner)
            raise
        self.epoch = self._contents.epoch

    def _lock_out(self) -> int:
        """Become the owner; the lock goes with the process."""
        owner = os.open(self.path.with_suffix(".lock"), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.flock(owner, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(owner)
            raise StoreInUse(str(self.path), 0) from error
        return owner

    def _read(self) -> Contents:
        if not self.path.exists():
            return Contents()
        contents: Contents = pickle.loads(self.path.read_bytes())
        return contents

    @contextlib.contextmanager
    def _changing(self) -> Generator[Contents, None, None]:
        """Contents to be changed; they become those of the store once they are written."""
        with self._lock:
            if self._refusal:
                raise StoreFailed(str(self.path), self._refusal)
            changed = self._contents.copy()
            yield changed
            try:
                self._write(changed)
            except OSError as error:
                raise StoreFailed(str(self.path), f"{error}; nothing was written") from error
            self._contents = changed

    def _write(self, contents: Contents) -> None:
        beside = self.path.with_suffix(".new")
        with open(beside, "wb") as file:
            file.write(pickle.dumps(contents))
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, self.path)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        for _, entry in entries:
            check(entry)
        with self._changing() as contents:
            positions = list(range(contents.last + 1, contents.last + 1 + len(entries)))
            for position, (address, entry) in zip(positions, entries, strict=True):
                contents.entries.setdefault(address, {})[position] = entry
            contents.last += len(entries)
        return positions

    def sync(self) -> None:
        with self._lock:
            if self._refusal:
                raise StoreFailed(str(self.path), self._refusal)
            try:
                self._sync()
            except OSError as error:
                self._refusal = f"{error}; open it again"
                raise StoreFailed(str(self.path), self._refusal) from error

    def _sync(self) -> None:
        """Bring the name of the newest file to the disk."""
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        with self._changing() as contents:
            kept = contents.snapshots.setdefault(address, [])
            entries = contents.entries.get(address, {})
            contained = entries.keys() & set(drop) | (kept[-1][2] if kept else set())
            kept.append((snapshot, turn, contained))
            del kept[:-keep]
            contents.entries[address] = {at: entry for at, entry in entries.items() if at not in kept[0][2]}

    def load(self, address: str, *, older: int = False) -> Saved:
        contents = self._contents
        kept, entries = contents.snapshots.get(address), contents.entries.get(address, {})
        if not kept:
            return Saved(None, 0, list(entries.items()))
        snapshot, turn, contained = kept[max(0, len(kept) - 1 - int(older))]
        return Saved(snapshot, turn, [(place, entry) for place, entry in entries.items() if place not in contained])

    def erase(self, address: str) -> None:
        with self._changing() as contents:
            contents.entries.pop(address, None)
            contents.snapshots.pop(address, None)
            contents.blocks = {key: pack for key, pack in contents.blocks.items() if key[0] != address}

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        with self._changing() as contents:
            contents.blocks[address, number] = {(offset, len(block)): bytes(block) for offset, block in blocks}

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        pack = self._contents.blocks.get((address, number), {})
        try:
            return Segment.of(number, [(place[0], pack[place]) for place in places])
        except KeyError as error:
            raise DamagedStore(str(self.path), address, None, f"there is no block at {error}") from error

    def packs(self, address: str) -> set[int]:
        return {number for owner, number in self._contents.blocks if owner == address}

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        with self._changing() as contents:
            contents.blocks = {
                key: pack for key, pack in contents.blocks.items() if key[0] != address or key[1] not in numbers
            }

    def addresses(self) -> list[str]:
        contents = self._contents
        used = (*contents.snapshots, *(address for address, entries in contents.entries.items() if entries))
        return sorted({*used, *(address for address, _ in contents.blocks)})

    def note(self, key: str, value: bytes | None) -> None:
        with self._changing() as contents:
            contents.notes.pop(key, None)
            if value is not None:
                contents.notes[key] = value

    def noted(self, key: str) -> bytes | None:
        return self._contents.notes.get(key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        return {key: value for key, value in self._contents.notes.items() if key.startswith(prefix)}

    def close(self) -> None:
        with self._lock:
            if self._owner >= 0:
                os.close(self._owner)
                self._owner, self._refusal = -1, "it is closed"
