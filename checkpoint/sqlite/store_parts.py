"""The parts of a store and their common identity: nothing else is opened, written to or removed.

The database and each folder beside it carry the identity of the store, made with it. The database has it as a note, a
folder in the file `store-id`. While the note says "pending" (a new store, or one of before that gets an identity), a
folder without one is given it; afterwards one without is somebody else's, unless it is empty.

No link is followed, and what others than the owner of this process may write to is refused. One process at a time
holds a lock on the identity in the folder of snapshots: also one that has the same files under another name, or
another view of the process ids, is seen.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import sqlite3
import stat
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple, TypeVar
from urllib.parse import quote

from ..journal import DamagedStore, ForeignStore, StoreInUse, WrongStoreKey
from .row_codec import crc_of
from .sealing import Cipher, NoCipher, StoreCipher, is_sealed
from .snapshot_files import write_durably

T = TypeVar("T")
APPLICATION: Final = 0x486F6C64
"""Stands in the header of each database that is a store: "Hold", in letters."""
NOTE: Final = "\0store"
"""The note with the identity. No user's note has such a name, and nobody is shown it."""
COPY_NOTE: Final = "\0copy"
"""The note of a copy: of which store it is, and of when. Nobody is shown it either."""
KEY_NOTE: Final = "\0key"
"""The note of a store that is encrypted: what only its key opens. Nobody is shown it either."""
_KEY_PLACE: Final = b"key"
NAME: Final = "store-id"
_PENDING, _FINAL = b"~", b"="
_HALF_MADE: Final = re.compile(r"new-\d+-\d+(-wal|-shm|-journal)?")
"""Names of databases that were never put in place."""
_WORD: Final = "holdfast-store "


class StoreIdentity(NamedTuple):
    """Which store it is; `is_pending` while not all folders are known to carry it."""

    id: str
    is_pending: bool


def is_hidden(note: object) -> bool:
    """Whether a note is the store's own."""
    return note in (NOTE, COPY_NOTE, KEY_NOTE)


def new_cipher(key: bytes | None, identity: str) -> Cipher:
    """What encrypts a store that is being made.

    Raises:
        SpecError: the library for it is not installed.
    """
    return NoCipher() if key is None else StoreCipher(key, uuid.UUID(identity).bytes)


def new_notes(identity: str, cipher: Cipher) -> list[tuple[str, bytes, int]]:
    """The notes that a new database begins with: name, value, checksum."""
    return _own_notes({NOTE: _PENDING + uuid.UUID(identity).bytes}, cipher)


def copy_notes(identity: str, origin: str, when: float, cipher: Cipher) -> list[tuple[str, bytes, int]]:
    """The store's own notes in a copy that has an identity of its own; `when` is Unix time."""
    values = {NOTE: _FINAL + uuid.UUID(identity).bytes, COPY_NOTE: f"{origin} {when:.3f}".encode()}
    return _own_notes(values, cipher)


def _own_notes(values: dict[str, bytes], cipher: Cipher) -> list[tuple[str, bytes, int]]:
    if cipher.digest_key:
        values[KEY_NOTE] = bytes(cipher.seal(_KEY_PLACE, b""))
    return [(name, value, crc_of(name, value)) for name, value in values.items()]


def origin_of(db: sqlite3.Connection) -> tuple[str, float] | None:
    """Of which store a copy was made, and when; None if this is no copy."""
    try:
        note = _note_of(db, "", COPY_NOTE)
    except DamagedStore:
        return None
    if note is None:
        return None
    origin, _, when = note.decode().partition(" ")
    return origin, float(when)


def mark_of(identity: str) -> bytes:
    """What a folder of the store has in its file `store-id`."""
    return f"{_WORD}{identity}\n".encode()


def part_names(path: str) -> list[str]:
    """Whatever may lie beside a database, and the database itself."""
    suffixes = ("", "-wal", "-shm", "-journal", "-mark", "-hands", "-snapshots", "-packs", "-log")
    return [path + suffix for suffix in suffixes]


class Parts:
    """The parts of the store at `path`.

    Args:
        path: the database.
        key: of the store, if it is encrypted.

    Attributes:
        folders: those that lie beside it; the first one is locked.
        cipher: what all payloads go through; not the store's before it has been `unlock`ed.
    """

    def __init__(self, path: str, key: bytes | None = None) -> None:
        self.path = path
        self.key = key
        self.cipher: Cipher = NoCipher()
        self.folders = tuple(path + suffix for suffix in ("-snapshots", "-log", "-packs"))
        self.id = ""
        self._lock = -1
        self._marking = threading.Lock()
        self._seen: dict[str, tuple[int, int]] = {}  # what was opened

    # ---- before anything is opened

    def inspect(self) -> bool:
        """Look at all that is there, without changing any of it. Returns whether there is a database.

        Raises:
            ForeignStore: it does not belong together, or others may write to it. WrongStoreKey: the key is not its own.
        """
        found = self._look(self.path)
        for suffix in ("-wal", "-shm", "-mark", "-hands"):
            self._look(self.path + suffix)
        for folder in self.folders:
            if self._look(folder, is_folder=True) is not None:
                self._look(os.path.join(folder, NAME))
        if found is None:
            left = self._left()
            if left and os.path.exists(self.path):
                return self.inspect()  # Somebody has made it meanwhile.
            if left:
                raise self.refused(
                    self.path,
                    f"the database is gone, but {', '.join(map(os.path.basename, left))} of its store are still there",
                    "put the database back; or, to begin a new store, move them away",
                )
            return False
        if found.st_nlink - self._half_made(found) != 1:
            raise self.refused(
                self.path,
                f"it has {found.st_nlink} names (hard links), under which it could be opened at the same time",
                "remove all but one of them",
            )
        if found.st_size:
            self._refuse_stranger()
            try:
                self._compare_read()
            except ForeignStore:
                self._compare_read()  # Its owner may have given it an identity just between two looks.
        return True

    def _refuse_stranger(self) -> None:
        """Refuse a file that is no store, unless folders of one lie beside it: then it is a store that is damaged.

        Raises:
            ForeignStore: it is another program's database, or none at all.
        """
        if not all(map(_is_unused, self.folders)):
            return
        what = "another program's SQLite database"
        try:
            (application,) = self.peek(lambda db: db.execute("PRAGMA application_id").fetchone(), with_wal=False)
        except sqlite3.DatabaseError as error:
            if result_code(error) != sqlite3.SQLITE_NOTADB:
                return  # The opening says what is wrong.
            application, what = 0, "no SQLite database"
        if application != APPLICATION:
            raise self.refused(
                self.path,
                f"this is not a holdfast store, but {what}",
                "give the store another path; or, if one was here, put all of its files back",
            )

    def _look(self, part: str, *, is_folder: bool = False) -> os.stat_result | None:
        """Refuse a part that is no file (or folder) of this process's user alone; None if it is not there."""
        try:
            info = os.lstat(part)
        except FileNotFoundError:
            return None
        problem, remedy = "", "put the store's own in its place, or give the store another path"
        if not (stat.S_ISDIR if is_folder else stat.S_ISREG)(info.st_mode):
            problem = f"it is not a {'folder' if is_folder else 'regular file'}, and links are not followed"
        elif info.st_uid != os.geteuid():
            problem = f"it belongs to the user {info.st_uid}, and this process is of {os.geteuid()}"
            remedy = "open it as its owner, or give it to this user"
        elif info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            problem, remedy = "others than its owner may write to it", f"chmod go-w {part}"
        elif not is_folder and part != self.path and info.st_nlink != 1:
            problem, remedy = f"it has {info.st_nlink} names (hard links)", "remove all but one of them"
        if problem:
            raise self.refused(part, problem, remedy)
        return info

    def _half_made(self, database: os.stat_result) -> int:
        """How many names the database has from when it was made: its maker was killed."""
        same = 0
        for folder in self.folders:
            for name in _names(folder):
                if _HALF_MADE.fullmatch(name):
                    info = os.lstat(os.path.join(folder, name))
                    same += (info.st_dev, info.st_ino) == (database.st_dev, database.st_ino)
        return same

    def refuse_link(self, link: str) -> None:
        """A link to the database is followed; parts of a store that lie beside the link would be passed over.

        Raises:
            ForeignStore: there are some.
        """
        beside = Parts(link)
        left = beside._left()
        if left:
            raise beside.refused(
                link,
                f"it is a link to {self.path}, but {', '.join(map(os.path.basename, left))} of a store lie beside it",
                "put the database itself there; or, if the store is where the link leads, move them away",
            )

    def _left(self) -> list[str]:
        """What a store has left here, when its database is gone."""
        left = [self.path + suffix for suffix in ("-wal", "-mark") if os.path.lexists(self.path + suffix)]
        return left + [folder for folder in self.folders if not _is_unused(folder)]

    def _compare_read(self) -> None:
        """Compare the identity in the database with the folders', without changing anything.

        Raises:
            ForeignStore: they differ, or its WAL is of another store.
        """
        try:
            main = self.peek(self._identity_in, with_wal=False)
            both = self.peek(self._identity_in)
        except (sqlite3.Error, UnicodeDecodeError, DamagedStore):
            return  # It is damaged, or kept by somebody: the opening says so, and then compares.
        if main is not None and both is not None and main.id != both.id:
            raise self.refused(
                f"{self.path}-wal",
                f"it is of the store {both.id}, the database is {main.id}",
                "put back what belongs together",
            )
        self.compare(both)

    def peek(self, work: Callable[[sqlite3.Connection], T], *, with_wal: bool = True) -> T:
        """Read something of the database, without changing anything."""
        has_wal = os.path.exists(f"{self.path}-wal") and os.path.getsize(f"{self.path}-wal") > 0
        options = "?mode=ro" if with_wal and has_wal else "?mode=ro&immutable=1"
        with contextlib.closing(sqlite3.connect(f"file:{quote(self.path)}{options}", uri=True, timeout=1.0)) as db:
            return work(db)

    def _identity_in(self, db: sqlite3.Connection) -> StoreIdentity | None:
        self.unlock(db)
        return identity_of(db, self.path)

    # ---- opening

    def unlock(self, db: sqlite3.Connection) -> None:
        """Have the cipher be the one of the store that this connection reads.

        Raises:
            WrongStoreKey: the key is another one, is missing, or there should be none. DamagedStore: nobody can tell.
        """
        identity = identity_of(db, self.path)
        proof = _note_of(db, self.path, KEY_NOTE)
        (version,) = db.execute("PRAGMA user_version").fetchone()
        if (proof is not None) != is_sealed(version) or (proof is not None and identity is None):
            raise DamagedStore(self.path, None, None, "its format does not say whether it is encrypted")
        if proof is None or identity is None:
            if self.key is not None:
                remedy = "leave the key out; or have `holdfast store rekey` make an encrypted copy"
                raise WrongStoreKey(self.path, "it is not encrypted, and there is a key for it", remedy)
            return
        if self.key is None:
            remedy = "give its key: store_key=..., or --key-file"
            raise WrongStoreKey(self.path, "it is encrypted, and there is no key for it", remedy)
        cipher = new_cipher(self.key, identity.id)
        try:
            cipher.unseal(_KEY_PLACE, proof)
        except ValueError:
            remedy = "give the one that it was made with; without that nobody can read it"
            raise WrongStoreKey(self.path, "the key is not the one that it is encrypted with", remedy) from None
        self.cipher = cipher

    def compare(self, identity: StoreIdentity | None) -> None:
        """Refuse folders that are not of the database's store.

        Raises:
            ForeignStore: naming the first one.
        """
        for folder in self.folders:
            own = self._id_of(folder)
            if own is None and (identity is None or identity.is_pending or _is_unused(folder)):
                continue
            if identity is not None and own == identity.id:
                continue
            known = "no identity" if own is None else f"the identity {own!r}"
            wanted = "none" if identity is None else identity.id
            raise self.refused(
                folder,
                f"it has {known}, the database {wanted}: they are not of one store",
                "put back what belongs together",
            )

    def _id_of(self, folder: str) -> str | None:
        try:
            fd = os.open(os.path.join(folder, NAME), os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        with open(fd, encoding="ascii", errors="replace") as file:
            return file.read(200).removeprefix(_WORD).strip()

    def lock(self) -> None:
        """Hold the lock, if there is an identity to lock, until `close`.

        Raises:
            StoreInUse: another process holds it.
        """
        name = os.path.join(self.folders[0], NAME)
        if self._lock >= 0:
            return
        try:
            fd = os.open(name, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            return
        try:
            fcntl.lockf(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # That one is given back when this process closes the file anywhere, as after each look at it; this is not.
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = holder_of({_of_locks(os.fstat(fd))}) or 0
            if holder != os.getpid():  # Else it is an owner of before in this process, which the row has struck out.
                os.close(fd)
                raise StoreInUse(self.path, holder) from error
        except BaseException:
            os.close(fd)
            raise
        self._lock = fd

    def adopt(self, db: sqlite3.Connection) -> None:
        """As the owner, within no transaction: have the database and all folders that there are carry the identity."""
        identity = identity_of(db, self.path)
        if identity is None:
            ((_, value, crc),) = new_notes(str(uuid.uuid4()), NoCipher())
            _write(db, value, crc)
            identity = identity_of(db, self.path)
            assert identity is not None
        for folder in self.folders:
            self.mark(folder, identity.id)
        if identity.is_pending:
            value = _FINAL + uuid.UUID(identity.id).bytes
            _write(db, value, crc_of(NOTE, value))
        self.id = identity.id
        self.lock()

    def mark(self, folder: str, identity: str | None = None) -> None:
        """Have a folder carry the identity, if it is there. Large states are written in threads, several at a time."""
        name = os.path.join(folder, NAME)
        with self._marking:
            if os.path.isdir(folder) and not os.path.exists(name):
                write_durably(name, [mark_of(identity or self.id)])

    # ---- while it is open

    def opened(self) -> None:
        """Remember which files these are."""
        names = (self.path, f"{self.path}-wal", f"{self.path}-mark", *self.folders)
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                info = os.stat(name)
                self._seen[name] = info.st_dev, info.st_ino

    def lost(self) -> str:
        """What of the opened store is not in its place any more, in words; "" if all is."""
        for name, seen in self._seen.items():
            try:
                info = os.stat(name)
            except FileNotFoundError:
                return f"{name} was deleted or moved while the store was open"
            if (info.st_dev, info.st_ino) != seen:
                return f"{name} was replaced while the store was open"
        return ""

    def close(self) -> None:
        """Give the lock on the store back."""
        if self._lock >= 0:
            fd, self._lock = self._lock, -1
            os.close(fd)

    def refused(self, part: str, problem: str, remedy: str) -> ForeignStore:
        """The error about one part."""
        return ForeignStore(self.path, part, problem, remedy)


def identity_of(db: sqlite3.Connection, path: str) -> StoreIdentity | None:
    """The identity that the database has; None if it is of before there were any.

    Raises:
        DamagedStore: it cannot be read.
    """
    value = _note_of(db, path, NOTE)
    if value is None:
        return None
    if len(value) != 17:
        raise DamagedStore(path, None, None, "the identity of the store is damaged")
    return StoreIdentity(str(uuid.UUID(bytes=value[1:])), value[:1] == _PENDING)


def _note_of(db: sqlite3.Connection, path: str, name: str) -> bytes | None:
    """One of the store's own notes.

    Raises:
        DamagedStore: it cannot be read.
    """
    row = db.execute("SELECT value, crc FROM notes WHERE name = ?", (name,)).fetchone()
    if row is None:
        return None
    if not isinstance(row[0], bytes) or row[1] != crc_of(name, row[0]):
        kind = "identity" if name == NOTE else "key" if name == KEY_NOTE else "origin"
        raise DamagedStore(path, None, None, f"the {kind} of the store is damaged")
    return row[0]


def _write(db: sqlite3.Connection, value: bytes, crc: int) -> None:
    db.execute("BEGIN IMMEDIATE")
    db.execute("DELETE FROM notes WHERE name = ?", (NOTE,))
    db.execute("INSERT INTO notes VALUES (NULL, ?, ?, ?)", (NOTE, value, crc))
    db.execute("COMMIT")


def _names(folder: str) -> Iterator[str]:
    with contextlib.suppress(FileNotFoundError):
        yield from os.listdir(folder)


def _is_unused(folder: str) -> bool:
    """Whether there is nothing in it but what a store that was never finished has left."""
    return all(_HALF_MADE.fullmatch(name) or name == f"{NAME}.tmp" for name in _names(folder))


def _of_locks(info: os.stat_result) -> str:
    return f"{os.major(info.st_dev):02x}:{os.minor(info.st_dev):02x}:{info.st_ino}"


def lock_holder(path: str) -> int | None:
    """Pid of the process that has an exclusive SQLite lock on the store, from /proc/locks.

    Asking the kernel through `fcntl` would need a descriptor of our own, and closing it would drop the locks of any
    connection this process has.
    """
    files: set[str] = set()
    for name in (path, f"{path}-shm"):
        with contextlib.suppress(OSError):
            files.add(_of_locks(os.stat(name)))
    return holder_of(files)


def holder_of(files: set[str]) -> int | None:
    """Pid of a process that has one of these files locked, from /proc/locks; None if there is none to be seen."""
    for line in Path("/proc/locks").read_text().splitlines():
        words = line.split()
        if "WRITE" in words and words[-3] in files and int(words[-4]) > 0:
            return int(words[-4])
    return None


def result_code(error: Exception) -> int:
    """Primary SQLite result code; 0 if SQLite itself did not object."""
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF
