"""An engine as a user might write it from the documents: one pickle, written anew with each change."""

from __future__ import annotations

import os
import pickle
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from holdfast.checkpoint.journal import DamagedStore, Entry, Saved, StoreFailed
from holdfast.checkpoint.snapshot.shared_blocks import Segment


def check(part: Any) -> None:
    """Raise TypeError unless it is made of what entries are made of."""
    if isinstance(part, tuple):
        for one in part:
            check(one)
    elif part is not None and not isinstance(part, (int, float, str, bytes)):
        raise TypeError(f"an entry cannot hold {part!r}")


class OneFile:
    """Slow, and safe against kills by rename alone."""

    durable = True

    def __init__(self, path: Path) -> None:
        self.path, self._is_open = path, True
        self._last, self.epoch = 0, 0
        self._entries: dict[str, dict[int, Entry]] = {}
        self._snapshots: dict[str, list[tuple[bytes, int, set[int]]]] = {}  # with all that each of them contains
        self._blocks: dict[tuple[str, int], dict[tuple[int, int], bytes]] = {}
        self._notes: dict[str, bytes] = {}
        if path.exists():
            vars(self).update(pickle.loads(path.read_bytes()))
        self.epoch += 1
        self._write()

    def _write(self) -> None:
        if not self._is_open:
            raise StoreFailed(str(self.path), "it is closed")
        kept = {name: value for name, value in vars(self).items() if name not in ("path", "_is_open")}
        beside = self.path.with_suffix(".new")
        beside.write_bytes(pickle.dumps(kept))
        os.replace(beside, self.path)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        for _, entry in entries:
            if not isinstance(entry, tuple) or not entry:
                raise TypeError(f"{entry!r} is no entry")
            check(entry)
        positions = list(range(self._last + 1, self._last + 1 + len(entries)))
        for position, (address, entry) in zip(positions, entries, strict=True):
            self._entries.setdefault(address, {})[position] = entry
        self._last += len(entries)
        self._write()
        return positions

    def sync(self) -> None:
        self._write()

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        kept = self._snapshots.setdefault(address, [])
        contained = {*drop, *(kept[-1][2] if kept else ())}
        kept.append((snapshot, turn, contained))
        del kept[:-keep]
        entries = self._entries.get(address, {})
        self._entries[address] = {place: entry for place, entry in entries.items() if place not in kept[0][2]}
        self._write()

    def load(self, address: str, *, older: int = False) -> Saved:
        kept, entries = self._snapshots.get(address), self._entries.get(address, {})
        if not kept:
            return Saved(None, 0, list(entries.items()))
        snapshot, turn, contained = kept[max(0, len(kept) - 1 - int(older))]
        return Saved(snapshot, turn, [(place, entry) for place, entry in entries.items() if place not in contained])

    def erase(self, address: str) -> None:
        self._entries.pop(address, None)
        self._snapshots.pop(address, None)
        self.forget_blocks(address, ())

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        self._blocks[address, number] = {(offset, len(block)): bytes(block) for offset, block in blocks}
        self._write()

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        pack = self._blocks.get((address, number), {})
        try:
            return Segment.of(number, [(place[0], pack[place]) for place in places])
        except KeyError as error:
            raise DamagedStore(str(self.path), address, None, f"there is no block at {error}") from error

    def forget_blocks(self, address: str, needed: Collection[int]) -> None:
        self._blocks = {key: pack for key, pack in self._blocks.items() if key[0] != address or key[1] in needed}
        self._write()

    def addresses(self) -> list[str]:
        used = (*self._snapshots, *(address for address, entries in self._entries.items() if entries))
        return sorted({*used, *(address for address, _ in self._blocks)})

    def note(self, key: str, value: bytes | None) -> None:
        self._notes.pop(key, None)
        if value is not None:
            self._notes[key] = value
        self._write()

    def noted(self, key: str) -> bytes | None:
        return self._notes.get(key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        return {key: value for key, value in self._notes.items() if key.startswith(prefix)}

    def close(self) -> None:
        self._is_open = False
