"""A disk that can be cut off at any operation: what was not synced is there, lost, torn, or out of order."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

SECTOR = 512
HEAD = struct.Struct("<cqqq")


class Op(NamedTuple):
    """One operation, as `disk.c` notes it."""

    kind: str  # write, truncate, sync, unlink, rename
    path: str  # within the folder
    at: int
    data: bytes


def operations(log: Path, root: Path) -> Iterator[Op]:
    """All of a log, oldest first."""
    data, at = log.read_bytes(), 0
    while at < len(data):
        kind, length, offset, size = HEAD.unpack_from(data, at)
        at += HEAD.size
        path = data[at : at + length].decode()
        at += length
        yield Op(kind.decode(), path.removeprefix(f"{root}/"), offset, data[at : at + size])
        at += size


class File:
    """What the disk has of a file for certain, and what it may have."""

    def __init__(self, content: bytes = b"") -> None:
        self.certain = bytearray(content)
        self.pending: list[Op] = []

    def do(self, op: Op) -> None:
        if op.kind == "s":
            for one in self.pending:
                apply(self.certain, one)
            self.pending.clear()
        else:
            self.pending.append(op)

    def after_power_loss(self, draw: random.Random) -> bytes:
        """Any of what was not synced, in any order of its sectors."""
        content = bytearray(self.certain)
        share = draw.choice([0.0, 0.5, 0.9, 1.0])
        for op in self.pending:
            if op.kind == "t":
                if draw.random() < share:
                    apply(content, op)
                continue
            for start in range(0, len(op.data), SECTOR):  # Sector by sector: a write can be torn.
                if draw.random() < share:
                    apply(content, Op("w", op.path, op.at + start, op.data[start : start + SECTOR]))
        return bytes(content)

    def now(self) -> bytes:
        content = bytearray(self.certain)
        for op in self.pending:
            apply(content, op)
        return bytes(content)


def apply(content: bytearray, op: Op) -> None:
    end = op.at + len(op.data)
    if op.kind == "t":
        del content[op.at :]
        content.extend(bytes(op.at - len(content)))
    else:
        content.extend(bytes(max(0, end - len(content))))
        content[op.at : end] = op.data


class Disk:
    """A folder as it was before the first operation, and what was done to it since."""

    def __init__(self, folder: Path) -> None:
        self.files = {
            str(path.relative_to(folder)): File(path.read_bytes())
            for path in folder.rglob("*")
            if path.is_file() and not path.name.endswith("-shm")
        }

    def do(self, op: Op, root: Path) -> None:
        """One more operation. Names are changed at once: file systems journal them, in order."""
        if op.kind == "u":
            self.files.pop(op.path, None)
        elif op.kind == "r":
            self.files[op.data.decode().removeprefix(f"{root}/")] = self.files.pop(op.path, File())
        elif op.kind == "s" and op.path not in self.files:
            pass  # a folder
        else:
            self.files.setdefault(op.path, File()).do(op)

    def cut_off(self, folder: Path, draw: random.Random) -> None:
        """Write to `folder` what is there when the power is back."""
        for name, file in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            content = file.after_power_loss(draw)
            if name.endswith("-mark"):
                content = content[:9] + b"another boot".ljust(36) + content[45:]
            path.write_bytes(content)
        (folder / "app.db-snapshots").mkdir(exist_ok=True)
