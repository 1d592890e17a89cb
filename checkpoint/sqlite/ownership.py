"""Ownership of a store: one process at a time, told apart by pid and start time, and by an epoch."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sqlite3
import time
from collections.abc import Generator
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple

from ..journal import DamagedStore, StoreInUse
from .database import refuse_broken, refuse_foreign
from .row_codec import crc_of
from .store_parts import Parts, identity_of, lock_holder, result_code
from .wal import shorten

_KILL_SECONDS: Final = 10.0


class StoreRow(NamedTuple):
    """The one row of the table `store`."""

    epoch: int
    pid: int  # of the owner, 0 for none, with its start
    start: str  # and, of an owner, which file its database is
    floor: int  # up to this position there were `live` entries
    live: int


def read_store_row(db: sqlite3.Connection, path: str, key: bytes) -> StoreRow:
    """The row of the store as it is now; `key` is that of its digests.

    Raises:
        DamagedStore: it is missing or its checksum is wrong.
    """
    row = db.execute("SELECT epoch, pid, start, floor, live, crc FROM store").fetchone()
    if row is None or row[5] != crc_of(*row[:5], key=key):
        raise DamagedStore(path, None, None, "the checksum of the store row is wrong")
    return StoreRow(*row[:5])


def write_store_row(db: sqlite3.Connection, row: StoreRow, key: bytes) -> None:
    """Put the row in the place of the present one, within a transaction of the caller; `key` is that of its digests."""
    crc = crc_of(*row, key=key)
    db.execute("UPDATE store SET epoch = ?, pid = ?, start = ?, floor = ?, live = ?, crc = ?", (*row, crc))


def refuse_copy(parts: Parts) -> None:
    """Refuse files that were copied from those that a living process has open. Nothing is changed.

    Raises:
        ForeignStore: they are of no instant, and to take over would end the owner of the others.
    """
    try:
        row = parts.peek(lambda db: read_store_row(db, parts.path, parts.cipher.digest_key))
    except (sqlite3.Error, UnicodeDecodeError, DamagedStore):
        return  # The opening says what is wrong.
    with living(row.pid, row.start) as pidfd:
        if pidfd is not None and row.start.count(":") > 1 and not row.start.endswith(_file_word(parts.path)):
            raise parts.refused(
                parts.path,
                f"it is a copy of a store that process {row.pid} has open, made while that wrote to it",
                "have `holdfast store backup` make the copy; or stop that process first",
            )


class StoreClaim:
    """Our claim to be the owner of the store, made through one connection."""

    def __init__(self, db: sqlite3.Connection, parts: Parts) -> None:
        self._db = db
        self._parts = parts
        self.path = parts.path
        self.epoch = 0
        self._owner = 0, ""

    def take(self, takeover: bool) -> None:
        """Become the owner, with a new epoch, unless a living process is.

        Raises:
            StoreInUse: a living process has the store open, and it may not or cannot be killed.
            DamagedStore: the file is not ours, or is broken. ForeignStore: what lies beside it is of another store.
            WrongStoreKey: the key is not its own.
        """
        deadline = monotonic() + _KILL_SECONDS
        while True:
            try:
                refuse_foreign(self._db, self.path)
                self._parts.unlock(self._db)
                seen = self.read()
                self._refuse_living(seen.pid, seen.start, takeover)
                refuse_broken(self._db, self.path)
                self._parts.compare(identity_of(self._db, self.path))
                self._parts.lock()
                shorten(self._db, self.path)
                if self._write_in(seen):
                    return
            except sqlite3.OperationalError as error:
                if result_code(error) != sqlite3.SQLITE_BUSY or monotonic() > deadline:
                    raise
                # A process that was stopped inside a transaction, or while it opened or closed the store.
                holder = lock_holder(self.path)
                if holder is not None and holder != os.getpid():
                    self._refuse_living(holder, None, takeover)
                time.sleep(0.01)

    def _refuse_living(self, pid: int, start: str | None, takeover: bool) -> None:
        """Raise `StoreInUse` if that process lives, or see it dead first if we may."""
        with living(pid, start) as pidfd:
            if pidfd is None:
                return
            if not takeover or pid == os.getpid():
                raise StoreInUse(self.path, pid, is_here=pid == os.getpid())
            try:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            except PermissionError as error:
                raise StoreInUse(self.path, pid) from error
            except ProcessLookupError:
                pass
            if not has_ended(pidfd, _KILL_SECONDS):  # It hangs in the kernel, and may still write when it wakes.
                raise StoreInUse(self.path, pid)

    def _write_in(self, seen: StoreRow) -> bool:
        """Write ourselves in as the owner, if nobody was quicker."""
        db = self._db
        # Synced even under "os": an epoch that was seen outside must not come again after a power loss.
        db.execute("PRAGMA synchronous = FULL")
        db.execute("BEGIN IMMEDIATE")
        try:
            if self.read() != seen:
                return False
            self.epoch = seen.epoch + 1
            self._owner = os.getpid(), f"{start_of(os.getpid()) or ''}{_file_word(self.path)}"
            self.write(seen.floor, seen.live)
            db.execute("COMMIT")
        finally:
            if db.in_transaction:
                db.execute("ROLLBACK")
        return True

    def read(self) -> StoreRow:
        """The row of the store as it is now.

        Raises:
            DamagedStore: it is missing or its checksum is wrong.
        """
        return read_store_row(self._db, self.path, self._parts.cipher.digest_key)

    def write(self, floor: int, live: int) -> None:
        """Bring the row up to date, within a transaction of the caller."""
        row = StoreRow(self.epoch, *self._owner, floor, live)
        write_store_row(self._db, row, self._parts.cipher.digest_key)

    def release(self) -> None:
        """Strike ourselves out as the owner, leaving everything else as it is."""
        db = self._db
        db.execute("BEGIN IMMEDIATE")
        epoch, floor, live = db.execute("SELECT epoch, floor, live FROM store").fetchone()
        if epoch == self.epoch:
            self._owner = 0, ""
            self.write(floor, live)
        db.execute("COMMIT")


def boot_id() -> str:
    """Identify the time since the machine was started."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def start_of(pid: int) -> str | None:
    """Identify one life of a pid: boot and start time in clock ticks; `None` if that cannot be read."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return f"{boot_id()}:{fields[19]}"


def _file_word(path: str) -> str:
    """Tell a file from its copies, on one machine since its start."""
    info = os.stat(path)
    return f":{info.st_dev}:{info.st_ino}"


@contextlib.contextmanager
def living(pid: int, start: str | None) -> Generator[int | None, None, None]:
    """Hold a pidfd of that very process, or `None` if it is dead. One that may not be looked at counts as alive."""
    try:
        pidfd = os.pidfd_open(pid) if pid > 0 else None
    except ProcessLookupError:
        pidfd = None
    if pidfd is None:
        yield None
        return
    try:
        # The start time is read after the pidfd is held: the pid cannot pass to another process in between.
        same = start is None or start_of(pid) in (":".join(start.split(":")[:2]), None)
        yield pidfd if same and not has_ended(pidfd, 0.0) else None
    finally:
        os.close(pidfd)


def has_ended(pidfd: int, seconds: float) -> bool:
    """Whether the process behind the pidfd is dead, or dies within that time."""
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(seconds * 1000))
