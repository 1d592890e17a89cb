"""One instant of a store, seen without changing anything: of one that is closed, was left by a crash, or is open.

The mark is read first, then the logs, then the database, in a transaction that holds it still. A row that was in a log
and is there no more is in the database by then, so that nothing is missed that was acknowledged before the look began.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import uuid
from collections.abc import Callable, Generator, Iterator
from typing import Any, Final, TypeVar
from urllib.parse import quote

from ...actors.errors import HoldfastError
from ..journal import DamagedStore, StoreFailed
from ..sqlite.append_log import FrontLog, Row, batches_in, following
from ..sqlite.block_packs import Packs
from ..sqlite.database import refuse_foreign, text_of
from ..sqlite.ownership import StoreRow, living, read_store_row
from ..sqlite.position_mark import read_mark, refuse_missing
from ..sqlite.read_back import ChainReader
from ..sqlite.sealing import may_have_log
from ..sqlite.snapshot_files import SnapshotFiles
from ..sqlite.store_parts import Parts, StoreIdentity, identity_of, result_code

T = TypeVar("T")
_LOOKS: Final = 10
"""How often a store is looked at again that changes under the eyes of the reader."""


class Overtaken(Exception):
    """What was looked at is not there any more, because the store has gone on: look again."""


class StoreView:
    """A store at one instant.

    Attributes:
        db: reads the database; its transaction is never ended, so that all of it is of one instant.
        path: of the database.
        parts: what belongs to it, with its cipher.
        row: the row of the store.
        identity: of the store; None if it is of before there were any.
        last: the newest position.
        rows: those that are in the log and not in the database yet.
        mark: what the mark said before all else was read.
        pid: of the process that has it open; 0 if there is none to be seen.
        version: of the format.
        has_wal: whether the transaction holds the database still; else it counts that nobody has opened it meanwhile.
    """

    def __init__(
        self, path: str, parts: Parts, db: sqlite3.Connection, mark: bytes, log: list[bytes], has_wal: bool
    ) -> None:
        self.path, self.parts, self.db, self.mark, self.has_wal = path, parts, db, mark, has_wal
        self.files = SnapshotFiles(path, parts)
        self.packs = Packs(path, parts)
        self.reader = ChainReader(db, path, self.files, parts.cipher)
        self.row: StoreRow = read_store_row(db, path, parts.cipher.digest_key)
        self.identity: StoreIdentity | None = identity_of(db, path)
        (self.version,) = db.execute("PRAGMA user_version").fetchone()
        (newest,) = db.execute("SELECT max(position) FROM entries").fetchone()
        self.last = max(newest or 0, self.row.floor)
        identity = b"" if self.identity is None else uuid.UUID(self.identity.id).bytes
        self.rows: list[Row] = []
        if may_have_log(self.version):
            self.rows = following(batches_in(log, identity), self.last)
        if self.rows:
            self.last = self.rows[-1][0]
        with living(self.row.pid, self.row.start) as pidfd:
            self.pid = 0 if pidfd is None else self.row.pid

    def refuse_missing(self) -> None:
        """Compare with what was acknowledged.

        Raises:
            DamagedStore: not all of it is there.
        """
        refuse_missing(self.path, self.mark, self.last)

    def entries(self) -> Iterator[tuple[Any, ...]]:
        """All rows of the journal, oldest first, as they are: whatever is wrong with them is for the caller to find."""
        yield from self.db.execute("SELECT position, address, chain, kind, data, crc FROM entries ORDER BY position")
        yield from self.rows

    def is_kept(self, snapshot: int) -> bool:
        """Whether the store has this snapshot now: else its files were removed because it needs them no more."""
        with contextlib.closing(_connect(self.path, _has_wal(self.path))) as db:
            return db.execute("SELECT 1 FROM snapshots WHERE id = ?", (snapshot,)).fetchone() is not None


def look(path: str | os.PathLike[str], work: Callable[[StoreView], T], key: bytes | None = None) -> T:
    """Do some work on one instant of a store; it is done again if the store goes on in a way that spoils it.

    Raises:
        StoreFailed: it cannot be read, or there is none. DamagedStore, ForeignStore: it is damaged, or parts of it are
            another store's. WrongStoreKey: the key is not its own.
    """
    where = os.path.realpath(path)
    for attempt in range(1, _LOOKS + 1):
        before = stamp(where)
        try:
            with open_view(where, key) as view:
                done = work(view)
        except Overtaken:
            continue
        except HoldfastError:
            if attempt == _LOOKS or stamp(where) == before:
                raise
            continue
        if view.has_wal or stamp(where) == before:
            return done
    raise StoreFailed(where, f"it has changed {_LOOKS} times while it was read; try again")


def stamp(path: str) -> tuple[int, ...]:
    """What changes when somebody opens or closes a store."""
    try:
        info = os.stat(path)
    except OSError:
        return ()
    return _has_wal(path), info.st_dev, info.st_ino, info.st_size, info.st_mtime_ns, info.st_ctime_ns


def _has_wal(path: str) -> bool:
    with contextlib.suppress(OSError):
        return os.path.getsize(f"{path}-wal") > 0
    return False


@contextlib.contextmanager
def open_view(path: str, key: bytes | None = None) -> Generator[StoreView, None, None]:
    """Look at a store for as long as the block lasts; its real path is given.

    Raises:
        StoreFailed: it cannot be read, or there is none. DamagedStore, ForeignStore: it is damaged, or parts of it are
            another store's. WrongStoreKey: the key is not its own.
    """
    with reading(path):
        parts = Parts(path, key)
        if not parts.inspect():
            raise StoreFailed(path, "there is no database; name the file, as in store='sqlite:PATH'")
        mark, log = read_mark(path), FrontLog(path, is_used=False).look()
        has_wal = _has_wal(path)
        with contextlib.closing(_connect(path, has_wal)) as db:
            db.execute("BEGIN")
            refuse_foreign(db, path, is_wal=has_wal)
            parts.unlock(db)
            parts.compare(identity_of(db, path))
            yield StoreView(path, parts, db, mark, log, has_wal)


@contextlib.contextmanager
def reading(path: str) -> Generator[None, None, None]:
    """Tell of what SQLite and the operating system refuse as errors that say which store it is."""
    try:
        yield
    except sqlite3.Error as error:
        if result_code(error) in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_ERROR):
            raise DamagedStore(path, None, None, str(error)) from error
        raise StoreFailed(path, f"it cannot be read: {error}") from error
    except OSError as error:
        raise StoreFailed(path, f"it cannot be read: {error}") from error
    except UnicodeDecodeError as error:  # SQLite quotes a damaged schema, and Python cannot read the quotation.
        raise DamagedStore(path, None, None, "its tables are not as they were created") from error


def _connect(path: str, has_wal: bool) -> sqlite3.Connection:
    # Where there is no WAL, SQLite would make one before it reads.
    options = "?mode=ro" if has_wal else "?mode=ro&immutable=1"
    db = sqlite3.connect(f"file:{quote(path)}{options}", uri=True, timeout=5.0, isolation_level=None)
    db.text_factory = text_of
    return db
