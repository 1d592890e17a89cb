"""Files beside the database: snapshots too large for it, each there completely or not at all after a power loss."""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import count
from typing import IO, Final

from ..journal import StoreFailed
from .sealing import Bytes, HasCipher, file_place

_SNAPSHOT: Final = re.compile(r"\d+-\d+\.snapshot")
_MADE_HERE: Final = re.compile(r"\d+-\d+\.snapshot(\.tmp)?|new-\d+-\d+(-wal|-shm|-journal)?|store-id\.tmp")
"""Names that only a store gives to files in the folder of its snapshots."""


class SnapshotFiles:
    """The directory of snapshot files of the store at `path`; `parts` has its cipher."""

    def __init__(self, path: str, parts: HasCipher) -> None:
        self.path = path
        self._parts = parts
        self.folder = f"{path}-snapshots"
        self._numbers = count(1)

    def write(self, epoch: int, snapshot: bytes) -> str:
        """Write a new file durably; return its name.

        Raises:
            StoreFailed: it is not written, and nothing of it is left.
        """
        name = f"{epoch}-{next(self._numbers)}.snapshot"
        try:
            parts = self._parts.cipher.sealed_parts(file_place(name), snapshot)
            write_durably(os.path.join(self.folder, name), parts)
        except OSError as error:
            # The journal goes on: nothing is synced twice here, the next attempt writes a new file.
            raise StoreFailed(self.path, f"snapshot not written: {error}; older one and journal stay") from error
        return name

    def read(self, name: str) -> bytes:
        """Read a file; OSError or ValueError if there is none of that name, or it was changed."""
        if _SNAPSHOT.fullmatch(name) is None:
            raise ValueError(f"{name!r} is no name of a snapshot")
        return self._parts.cipher.unseal(file_place(name), read_own(os.path.join(self.folder, name)))

    def copied(self, source: SnapshotFiles, name: str, file: IO[bytes]) -> Iterator[Bytes]:
        """The bytes of a file of another store as it is to be in this one; what is damaged in it stays so."""
        place, kept = file_place(name), file.read()
        try:
            data = source._parts.cipher.unseal(place, kept)
        except ValueError:
            yield kept
        else:
            yield from self._parts.cipher.sealed_parts(place, data)

    def remove(self, names: Sequence[str]) -> None:
        """Remove snapshot files that no row names, which is on the disk (`sync_rows`)."""
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(os.path.join(self.folder, name))

    def sync_rows(self) -> None:
        """Bring what was committed to the disk.

        Otherwise a power loss could bring back the rows, but not the files. (The WAL has no locks, so that closing it
        drops none.)
        """
        if os.path.exists(f"{self.path}-wal"):
            sync(f"{self.path}-wal")

    def remove_all_but(self, known: Collection[str]) -> None:
        """Remove what an earlier owner has written or left half made, and never named in a row; no other file."""
        found = [name for name in os.listdir(self.folder) if _MADE_HERE.fullmatch(name) is not None]
        unknown = [name for name in found if name not in known]
        if unknown:
            self.sync_rows()
            self.remove(unknown)


class Word:
    """The first eight bytes of a file, seen and set as `at[0]` without a system call."""

    __slots__ = ("_map", "at")

    def __init__(self, fd: int) -> None:
        self._map = mmap.mmap(fd, 8)
        self.at = memoryview(self._map).cast("Q")

    def close(self) -> None:
        """Let go of the file."""
        self.at.release()
        self._map.close()


def write_durably(path: str, parts: Iterable[bytes | memoryview]) -> None:
    """Create the file so that it exists after a power loss completely or not at all."""
    temporary = f"{path}.tmp"
    with contextlib.suppress(FileNotFoundError):
        os.unlink(temporary)  # Whoever had begun it was killed.
    try:
        with open(temporary, "xb", opener=for_us) as file:
            file.writelines(parts)
            file.flush()
            os.fsync(file.fileno())
        os.rename(temporary, path)
        sync(os.path.dirname(path))
    except BaseException:
        for name in (temporary, path):
            with contextlib.suppress(OSError):
                os.unlink(name)
        raise


def for_us(path: str, flags: int) -> int:
    """An opener (the descriptor is closed if `open` fails): nobody else may read the file."""
    return os.open(path, flags, 0o600)


def no_link(path: str, flags: int) -> int:
    """An opener that follows no link."""
    return os.open(path, flags | os.O_NOFOLLOW)


def read_own(path: str) -> bytes:
    """Read a file that the store has written, and no other: no link is followed."""
    with open(path, "rb", opener=no_link) as file:
        refuse_shared(path, os.fstat(file.fileno()))
        return file.read()


def refuse_shared(path: str, info: os.stat_result) -> None:
    """Raise OSError unless it is a regular file under one name that nobody but this process's user can have written."""
    if not stat.S_ISREG(info.st_mode) or info.st_nlink != 1:
        raise OSError(errno.EPERM, "it is no regular file, or has several names", path)
    if info.st_uid != os.geteuid() or info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise OSError(errno.EPERM, "it belongs to another user, or others may write to it", path)


def sync(path: str) -> None:
    """Bring a file or a directory to the disk."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
