"""The SQLite file itself: its tables, how it is created and opened, and whether it is one of ours and whole."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
import uuid
from pathlib import Path
from typing import Final

from ..journal import DamagedStore
from .row_codec import crc_of
from .sealing import FORMATS, Cipher, format_of
from .snapshot_files import sync
from .store_parts import APPLICATION, new_cipher, new_notes

_TABLES: Final = {
    "store": "one INTEGER PRIMARY KEY, epoch INTEGER, pid INTEGER, start TEXT, floor INTEGER, live INTEGER, "
    "crc INTEGER",
    "addresses": "id INTEGER PRIMARY KEY AUTOINCREMENT, path TEXT, removed INTEGER, removed_sum INTEGER, "
    "floor INTEGER, kept TEXT, crc INTEGER",
    "entries": "position INTEGER PRIMARY KEY, address INTEGER, chain INTEGER, kind TEXT, data BLOB, crc INTEGER",
    "snapshots": "id INTEGER PRIMARY KEY AUTOINCREMENT, address INTEGER, turn INTEGER, epoch INTEGER, drops BLOB, "
    "file TEXT, digest BLOB, data BLOB",
    "notes": "key INTEGER PRIMARY KEY, name TEXT, value BLOB, crc INTEGER",
}
_SCHEMA: Final = [f"CREATE TABLE {name}({columns})" for name, columns in _TABLES.items()]
_BUSY_SECONDS: Final = 0.25  # Nobody holds a lock for long, except a stopped process, and that one is looked up.


def create_database(path: str, folder: str, key: bytes | None) -> None:
    """Make the database in `folder` and link it into place: half a database is then never seen under its name.

    Another opener may be quicker, and as the owner sweep ours away at any moment: then there is one, and ours is not
    needed.
    """
    new = os.path.join(folder, f"new-{os.getpid()}-{threading.get_ident()}")
    with contextlib.suppress(FileNotFoundError):
        os.unlink(new)  # left by an earlier process with our pid
    try:
        _write_database(new, key)
        os.link(new, path)
    except (OSError, sqlite3.Error):
        if not os.path.exists(path):
            raise
    else:
        sync(os.path.dirname(path))
    with contextlib.suppress(FileNotFoundError):
        os.unlink(new)


def _write_database(path: str, key: bytes | None) -> None:
    """Make a new store, all of which is on the disk."""
    identity = str(uuid.uuid4())
    cipher = new_cipher(key, identity)
    os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))  # SQLite gives -wal and -shm the same mode
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
        create_tables(db, cipher)
        db.executemany("INSERT INTO notes VALUES (NULL, ?, ?, ?)", new_notes(identity, cipher))
        # What is left in the WAL would be missing under the other name, and closing says nothing of what it could not
        # bring over.
        (is_busy, left, _) = db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        if is_busy or left:
            raise sqlite3.OperationalError(f"{left} pages of the new database stay in its WAL")
    sync(path)


def create_tables(db: sqlite3.Connection, cipher: Cipher) -> None:
    """Make a new database a store without contents and without an identity."""
    db.execute("PRAGMA journal_mode = WAL")
    db.execute(f"PRAGMA application_id = {APPLICATION}")
    db.execute(f"PRAGMA user_version = {format_of(cipher, may_have_log=False)}")
    for statement in _SCHEMA:
        db.execute(statement)
    crc = crc_of(0, 0, "", 0, 0, key=cipher.digest_key)
    db.execute("INSERT INTO store VALUES (1, 0, 0, '', 0, 0, ?)", (crc,))


def connect(path: str) -> sqlite3.Connection:
    """Open one more connection to the database."""
    db = sqlite3.connect(
        f"{Path(path).as_uri()}?mode=rw",  # never create: see `create_database`
        uri=True,
        timeout=_BUSY_SECONDS,
        isolation_level=None,
        check_same_thread=False,
    )
    # A flipped bit may make a blob a text that is not UTF-8: leave it to the checksums.
    db.text_factory = text_of
    db.execute("PRAGMA wal_autocheckpoint = 0")  # It would sync the disk within an append: see `Store._checkpoint`.
    return db


def refuse_foreign(db: sqlite3.Connection, path: str, *, is_wal: bool = True) -> None:
    """Refuse a file that is not ours; not `is_wal`: the connection takes it for one that nobody writes.

    Raises:
        DamagedStore: saying what it is instead.
    """
    (application,) = db.execute("PRAGMA application_id").fetchone()
    (version,) = db.execute("PRAGMA user_version").fetchone()
    (mode,) = db.execute("PRAGMA journal_mode").fetchone()
    if application != APPLICATION or (is_wal and mode != "wal"):
        raise DamagedStore(path, None, None, "this is not a holdfast store")
    if version not in FORMATS:
        reason = f"its format is {version}, this holdfast reads {FORMATS[0]} to {FORMATS[-1]}"
        raise DamagedStore(path, None, None, reason)
    found = [sql for (sql,) in db.execute("SELECT sql FROM sqlite_master WHERE sql NOT NULL ORDER BY rowid")]
    if [sql for sql in found if "sqlite_sequence" not in sql] != _SCHEMA:
        raise DamagedStore(path, None, None, "its tables are not as they were created")


def refuse_broken(db: sqlite3.Connection, path: str) -> None:
    """Refuse a broken file before the first write to it."""
    (verdict,) = db.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise DamagedStore(path, None, None, str(verdict))


def text_of(data: bytes) -> str:
    """A text as SQLite has it, also where it is none: the checksums judge it."""
    return data.decode(errors="surrogateescape")
