"""The log in front of the database: an append of a few entries is one write here, and reaches the database in batches.

A file holds one generation: a head, then records. The checksum of a record goes on from the one before it, and that of
the first one from the head, so that what an earlier generation has left behind is never taken for its continuation.
Once the rows of a generation are in the database its file is written over, unless somebody was promised that they
survive a power loss (`promise`): then it stays until the database is synced, too, and another file takes over.

In front of it all is the seal. A new owner of the store sets it and then reads; who writes looks at it afterwards: one
of the two sees the other.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Final, TypeAlias

from ..encoding.entry_codec import decode_entry
from ..journal import Primitive
from .snapshot_files import Word, read_own, refuse_shared, sync

Row: TypeAlias = tuple[int, int, int, Primitive, bytes, int]
"""Of the table `entries`: position, address, chain, kind, data, crc."""

MOST_ROWS: Final = 512
"""Rows the log takes, before they go to the database: about a millisecond's work."""
MOST_BYTES: Final = 512 << 10
_NAME: Final = re.compile(r"\d+-\d+\.log")
_MAGIC: Final = b"HFLOG\x02\0\0"
_UNBOUND: Final = b"HFLOG\x01\0\0"  # of before: it does not say of which store it is
_SEAL: Final = struct.Struct("=Q")  # 0: open
_HEAD: Final = struct.Struct("<8sQQ")  # magic, epoch, generation
_RECORD: Final = struct.Struct("<II")  # checksum, length of what follows: entries
_ENTRY: Final = struct.Struct("<QQQII")  # position, address, chain, crc, length of the data that follow
_CRC: Final = struct.Struct("<I")


class LogSealed(Exception):
    """Somebody else owns the store now: nothing is acknowledged.

    Nothing was written either, except that a new owner that reads at this very moment may have seen it.
    """


class NoRoom(OSError):
    """The disk is full: nothing was written."""


@dataclass(slots=True)
class _File:
    name: str
    fd: int
    seal: Word
    is_named: bool = False  # Is its name on the disk?
    is_promised: bool = False  # Has what it holds to survive a power loss?


class FrontLog:
    """The logs of the store at `path`, in a folder of their own.

    Attributes:
        identity: of the store, 16 bytes: the checksums begin with it, so that a log of another store is none of this.
        rows: what is in the log and not in the database yet.
        size: their bytes.
        is_used: without it nothing is written to the log.
        is_broken_off: nobody knows where it ends, so that another generation has to begin.
    """

    def __init__(self, path: str, *, is_used: bool) -> None:
        self.folder = f"{path}-log"
        self.rows: list[Row] = []
        self.is_used = is_used
        self.is_broken_off = False
        self.epoch = 0
        self.identity = b""
        self.size = 0
        self._files: list[_File] = []  # all of them
        self._file: _File | None = None  # the one written to
        self._free: list[_File] = []
        self._kept: list[_File] = []  # moved to the database, which is not synced
        self._generation = 0
        self._at = self._crc = 0
        self._head = b""  # still to be written in front of the next record

    def make_folder(self) -> bool:
        """Make the folder; False if there was one."""
        try:
            os.mkdir(self.folder, mode=0o700)
        except FileExistsError:
            return False
        return True

    # ---- what earlier owners left

    def left(self) -> list[str]:
        """The logs that there are; nothing else in the folder is looked at."""
        return [os.path.join(self.folder, name) for name in os.listdir(self.folder) if _NAME.fullmatch(name)]

    def read(self, names: Sequence[str]) -> Iterator[list[Row]]:
        """Keep everybody else from writing to these files; then give what was appended as one, oldest first."""
        for name in names:
            fd = os.open(name, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                refuse_shared(name, os.fstat(fd))
                os.pwrite(fd, _SEAL.pack(1), 0)
            finally:
                os.close(fd)
        yield from batches_in([read_own(name) for name in names], self.identity)

    def look(self) -> list[bytes]:
        """The contents of all logs, while others may write; what goes meanwhile is in the database."""
        contents: list[bytes] = []
        with contextlib.suppress(FileNotFoundError):
            for name in self.left():
                with contextlib.suppress(FileNotFoundError):
                    contents.append(read_own(name))
        return contents

    def remove(self, names: Sequence[str]) -> None:
        """Remove these files for good."""
        for name in names:
            os.unlink(name)
        sync(self.folder)

    # ---- writing

    def takes(self, number: int, size: int) -> bool:
        """Whether there is room for so many more rows of so many bytes."""
        if self._file is None or self.is_broken_off:
            return False
        return len(self.rows) + number <= MOST_ROWS and self.size + size <= MOST_BYTES

    def write(self, rows: list[Row]) -> None:
        """Append these rows, all or none.

        Raises:
            Sealed, NoRoom: it is not acknowledged.
            OSError: nobody knows.
        """
        file = self._file
        assert file is not None
        parts: list[bytes] = []
        for position, key, number, _, data, crc in rows:
            parts += (_ENTRY.pack(position, key, number, crc, len(data)), data)
        body = b"".join(parts)
        crc = zlib.crc32(body, self._crc)
        record = b"".join((self._head, _RECORD.pack(crc, len(body)), body))
        at, size = self._at, len(record)
        try:
            done = os.pwrite(file.fd, record, at)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise NoRoom(*error.args) from error
            raise
        if done != size:
            raise NoRoom(errno.ENOSPC, os.strerror(errno.ENOSPC))  # The next one is written over it.
        if file.seal.at[0]:  # The file is still ours alone to write to: a new owner makes files of its own.
            os.pwrite(file.fd, bytes(len(self._head) + _RECORD.size), at)
            raise LogSealed
        self._at, self._crc, self._head = at + size, crc, b""
        self.size += size
        self.rows += rows

    def lost(self) -> str:
        """Which of the files is not in its place any more, in words; "" if all are."""
        for file in self._files:
            try:
                found = os.stat(file.name).st_ino
            except FileNotFoundError:
                return f"{file.name} was deleted or moved while the store was open"
            if found != os.fstat(file.fd).st_ino:
                return f"{file.name} was replaced while the store was open"
        return ""

    @property
    def is_due(self) -> bool:
        """Whether the next transaction is to begin another generation."""
        return bool(self.rows) or self._file is None or self.is_broken_off

    def prepare(self) -> None:
        """Have a file for the next generation.

        Within a transaction of the owner: whoever comes to own the store later then finds the file, and seals it.
        """
        if not self.is_used or self._free or (self._file is not None and not self._file.is_promised):
            return
        # Somebody may have brought back an older database, and left the logs: then the first names are taken.
        names = (os.path.join(self.folder, f"{self.epoch}-{number}.log") for number in count(1))
        name = next(name for name in names if not os.path.exists(name))
        try:
            fd = os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            try:
                os.pwrite(fd, _SEAL.pack(0), 0)
                seal = Word(fd)
            except BaseException:
                os.close(fd)
                os.unlink(name)
                raise
        except OSError as error:
            raise NoRoom(*error.args) from error
        file = _File(name, fd, seal)
        self._files.append(file)
        self._free.append(file)

    def restart(self) -> None:
        """The rows are in the database: begin the next generation."""
        self.rows, self.size, self.is_broken_off = [], 0, False
        file = self._file
        if file is None or file.is_promised:
            if file is not None:
                self._kept.append(file)
            self._file = self._free.pop() if self._free else None
        self._generation += 1
        self._at = _SEAL.size
        head = _HEAD.pack(_MAGIC, self.epoch, self._generation)
        self._crc = zlib.crc32(head, zlib.crc32(self.identity))
        self._head = head + _CRC.pack(self._crc)

    # ---- power losses

    def promise(self) -> list[_File]:
        """What is in the log is to survive a power loss: return the files to be synced, which are kept until then."""
        if self._file is None or not self.rows:
            return []
        self._file.is_promised = True
        return [self._file]

    def sync(self, files: Sequence[_File]) -> None:
        """Bring these files to the disk."""
        for file in files:
            os.fdatasync(file.fd)
            if not file.is_named:
                sync(self.folder)
                file.is_named = True

    def kept(self) -> list[_File]:
        """The files that are kept until the database is synced: what is in it now."""
        return self._kept[:]

    def free(self, files: Sequence[_File]) -> None:
        """The database is synced, with what it had when these were `kept`."""
        for file in files:
            self._kept.remove(file)
            file.is_promised = False
            self._free.append(file)

    def close(self, *, remove: bool) -> None:
        """Let go of the files, and remove them when the database has all."""
        self._file = None
        files, self._files, self._free, self._kept = self._files, [], [], []
        for file in files:
            file.seal.close()
            os.close(file.fd)
            if remove:
                with contextlib.suppress(OSError):  # The database says that they do not count.
                    os.unlink(file.name)


def batches_in(files: Sequence[bytes], identity: bytes) -> Iterator[list[Row]]:
    """What was appended as one to the store of that identity, oldest first, from the contents of logs.

    What is damaged ends its file: whether it was acknowledged, the mark knows.
    """
    found: list[tuple[int, int, bytes]] = []
    start = _SEAL.size + _HEAD.size
    for data in files:
        if len(data) < start + _CRC.size:
            continue
        magic, epoch, generation = _HEAD.unpack_from(data, _SEAL.size)
        begin = 0 if magic == _UNBOUND else zlib.crc32(identity)
        expected = zlib.crc32(data[_SEAL.size : start], begin)
        if magic in (_MAGIC, _UNBOUND) and _CRC.unpack_from(data, start)[0] == expected:
            found.append((epoch, generation, data))
    for _, _, data in sorted(found, key=lambda one: one[:2]):
        yield from _records(data)


def following(batches: Iterable[list[Row]], last: int) -> list[Row]:
    """The rows of these batches that go on behind the newest position of the database."""
    rows: list[Row] = []
    for batch in batches:
        if batch[0][0] == last + 1:
            rows += batch
            last = batch[-1][0]
        elif batch[-1][0] > last:
            break  # A power loss has taken what was before it: the mark knows whether it may be missing.
    return rows


def _records(data: bytes) -> Iterator[list[Row]]:
    at = _SEAL.size + _HEAD.size
    (crc,) = _CRC.unpack_from(data, at)
    at += _CRC.size
    while at + _RECORD.size <= len(data):
        expected, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        body = data[at : at + length]
        crc = zlib.crc32(body, crc)
        if crc != expected or not length or len(body) != length:
            return
        at += length
        yield _rows(body)


def _rows(body: bytes) -> list[Row]:
    rows: list[Row] = []
    at = 0
    while at < len(body):
        position, key, number, crc, length = _ENTRY.unpack_from(body, at)
        at += _ENTRY.size
        data = body[at : at + length]
        at += length
        rows.append((position, key, number, decode_entry(data)[0], data, crc))
    return rows
