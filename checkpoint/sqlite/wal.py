"""The WAL of the database: when it is synced, brought into the database, and begun anew.

SQLite begins it anew with the next write after all of it has come into the database. While writers go on that seldom
happens by itself, and its file never gets shorter by itself. So a thread brings it over now and then, and makes the
writers wait for its last pages once the file is longer than `longest` says, or when the disk is full.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
from collections.abc import Callable
from time import monotonic
from typing import Final

from .database import connect
from .store_parts import result_code

LEAST_BYTES: Final = 4 << 20
"""As long as this the file may always be, and as long it stays when it is begun anew."""
MOST_BYTES: Final = 64 << 20
TIMES: Final = 4
_BESIDE_BYTES: Final = 1 << 20  # for the log, and what is written first
_FULL_SECONDS: Final = 0.5  # A disk that stays full is not written to again and again.


def longest(database_bytes: int) -> int:
    """How long the WAL may be before the writers wait for its last pages: some times the database, within bounds.

    >>> longest(900_000), longest(5_000_000), longest(10**9)
    (4194304, 20000000, 67108864)
    """
    return min(max(TIMES * database_bytes, LEAST_BYTES), MOST_BYTES)


def shorten(db: sqlite3.Connection, path: str) -> None:
    """Before the first write of a new owner: have the room that a long WAL takes, which may be all that there is."""
    disk = os.statvfs(path)
    free = disk.f_bavail * disk.f_frsize
    with contextlib.suppress(FileNotFoundError):
        if os.path.getsize(f"{path}-wal") > free:  # Else it is brought over while the store works.
            try:
                db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
            except sqlite3.OperationalError as error:
                if result_code(error) != sqlite3.SQLITE_FULL:  # Else there may be room enough for what is written next.
                    raise


def room_wanted(db: sqlite3.Connection, path: str) -> int:
    """Bytes with which the WAL can be brought into the database, and the store goes on, with the room of the WAL."""
    pages: int
    page_bytes: int
    (pages,) = db.execute("PRAGMA page_count").fetchone()
    (page_bytes,) = db.execute("PRAGMA page_size").fetchone()
    return max(0, pages * page_bytes - os.path.getsize(path)) + _BESIDE_BYTES


class Wal:
    """The WAL of one open store.

    Args:
        path: of the database.
        writers: the lock that all writers hold.
        failed: is told what SQLite says of a checkpoint that failed.

    Attributes:
        is_unsynced: whether something was committed since the last sync.
        syncing: the lock of the syncs: there is one at a time.
    """

    def __init__(self, path: str, writers: threading.RLock, failed: Callable[[sqlite3.Error], object]) -> None:
        self._path, self._fd = path, -1
        self._writers, self._failed = writers, failed
        self.is_unsynced = True
        self.syncing = threading.Lock()
        self._written = 0  # bytes since the last checkpoint, roughly
        self._most = LEAST_BYTES  # so long the file may become before the writers wait
        self._full_at = 0.0  # when the disk was last found full
        self._thread: threading.Thread | None = None

    # ---- syncs

    def begin_sync(self) -> bool:
        """Whether there is anything to sync; from now on what is committed is for the next one."""
        is_unsynced, self.is_unsynced = self.is_unsynced, False
        return is_unsynced

    def sync(self) -> None:
        """Bring it to the disk. Raises OSError."""
        os.fdatasync(self._file())

    def _file(self) -> int:
        if self._fd < 0:  # It has no locks: to close it later drops none.
            self._fd = os.open(f"{self._path}-wal", os.O_RDONLY | os.O_CLOEXEC)
        return self._fd

    def close(self) -> None:
        """Close the file, if it was ever opened."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)

    # ---- checkpoints

    def committed(self, db: sqlite3.Connection, size: int) -> None:
        """A writer, which has the lock, has committed about so many bytes: see whether it is time for a checkpoint."""
        self._written += size
        is_long = os.fstat(self._file()).st_size > self._most
        if is_long or self._written > LEAST_BYTES:
            # Whoever begins the file anew leaves it so long: to write over it costs less than to have it grow.
            db.execute(f"PRAGMA journal_size_limit = {longest(os.path.getsize(self._path))}")
            self._start(is_long, False)

    def make_room(self) -> None:
        """The disk is full: have the room of the WAL, with which the store may go on."""
        if monotonic() - self._full_at >= _FULL_SECONDS:
            self._start(True, True)

    def _start(self, is_long: bool, is_full: bool) -> None:
        if self._thread is None or not self._thread.is_alive():
            self._written = 0
            if is_full:
                self._full_at = monotonic()
            self._thread = threading.Thread(
                target=self._checkpoint, args=(is_long, is_full), name="holdfast-store", daemon=True
            )
            self._thread.start()

    def join(self) -> None:
        """Wait for the end of a checkpoint that is under way; not with the writers' lock, which it may need."""
        if self._thread is not None:
            self._thread.join()

    def _checkpoint(self, is_long: bool, is_full: bool) -> None:
        """Bring the WAL into the database: in a thread, for it syncs twice, which takes milliseconds."""
        try:
            with contextlib.closing(connect(self._path)) as db:
                db.execute("PRAGMA busy_timeout = 0")  # Of a reader: the writers do not wait for it.
                db.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
                if is_long:
                    db.execute(
                        "PRAGMA wal_checkpoint(PASSIVE)"
                    ).fetchone()  # What came meanwhile: so the rest is short.
                    with self._writers:
                        self._finish(db, "TRUNCATE" if is_full else "PASSIVE")
        except sqlite3.Error as error:
            self._failed(error)  # A failed sync stops the journal; a lock in the way, or a full disk, does not.

    def _finish(self, db: sqlite3.Connection, mode: str) -> None:
        """Bring over the last pages, so that the next write begins the WAL anew."""
        size = os.fstat(self._file()).st_size
        self._most = size + LEAST_BYTES  # if that fails, as beside a reader that needs what is in it
        is_busy, pages, done = db.execute(f"PRAGMA wal_checkpoint({mode})").fetchone()
        if not is_busy and pages == done:
            self._most = longest(os.path.getsize(self._path))
