"""The durable journal: one SQLite file (WAL), large snapshots in files beside it.

Beside `app.db` live SQLite's `-wal` and `-shm`, the directory `app.db-snapshots` and, while the store is open or after
a crash, `app.db-mark`: the last acknowledged position.

Exclusion  The `store` row names the owning process (pid and start time) and an epoch that rises at each opening; every
           write checks the epoch inside its transaction. SQLite's locks are held for one short transaction only, so
           a stopped owner keeps nobody out for longer than it takes to kill it.
Integrity  Each row carries a CRC-32 over its place and content, and its number in the chain of its address (1, 2, ...).
           The row of the address has count and sum of the chain numbers removed by cuts. With n rows left and r
           removed, the numbers must be exactly 1..n+r: the sums agree only then, or when rows are missing at the very
           end. Those the `store` row (how many rows there were up to `floor`) and the mark notice.
Layout     Entries are clustered by position and have no index by address: it would cost a third of the speed, more
           when a batch spans many addresses. The positions of each address are held in memory (8 bytes each) instead
           and found again by one scan at the opening.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sqlite3
import struct
import threading
import time
import zlib
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from itertools import count
from pathlib import Path
from typing import Final, Literal, cast

import msgpack

from ..actors.errors import HoldfastError
from .journal import DamagedStore, Entry, Primitive, Saved, StaleEpoch, StoreFailed, StoreInUse

__all__ = ["SqliteJournal"]

_APPLICATION: Final = 0x486F6C64  # "Hold", in the file header
_VERSION: Final = 1
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
_KILL_SECONDS: Final = 10.0
_INLINE_BYTES: Final = 1 << 20  # SQLite reads and writes larger blobs at less than half a file's speed.
_CHECKPOINT_BYTES: Final = 4 << 20
_WAL_FRAMES: Final = 16384  # 64 MiB; beyond it a checkpoint may hold up the writers
_CHUNK: Final = 500  # Rows removed in one transaction: about 1 ms, which a caller of `append` may have to wait.
_MODULUS: Final = 1 << 62  # SQLite integers end at 2**63
_PLAIN: Final = frozenset({int, float, str, bytes, bool, type(None)})
_BIG_INT: Final = 1  # msgpack extension type
_PLACE: Final = struct.Struct("<QQQ")  # position, address id, chain number
_MARK: Final = struct.Struct("<Q?36s")  # last acknowledged position, synced at each commit?, boot


# ------------------------------------------------------------------------------------------------- encoding


def _check(entry: Entry) -> None:
    """Refuse what would not come back as it is: a list (as a tuple), an Enum (as its value), a dict, ..."""
    if type(entry) is not tuple or not entry or type(entry[0]) is not str:
        raise TypeError(f"an entry is a tuple that opens with its kind, a str, not {entry!r:.100}")
    _check_items(entry)


def _check_items(items: tuple[Primitive, ...]) -> None:
    if _PLAIN.issuperset(map(type, items)):
        return
    for item in items:
        if type(item) is tuple:
            _check_items(item)
        elif type(item) not in _PLAIN:
            raise TypeError(f"a journal entry holds primitives and tuples of them, not {type(item).__name__}")


def _big_int(value: object) -> msgpack.ExtType:
    """Called by msgpack for what it cannot encode, which after `_check` is only an int of more than 64 bits."""
    assert isinstance(value, int)
    return msgpack.ExtType(_BIG_INT, value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True))


def _from_ext(code: int, data: bytes) -> int:
    if code != _BIG_INT:
        raise ValueError(f"unknown extension type {code}")
    return int.from_bytes(data, "little", signed=True)


def _decode(data: bytes) -> Entry:
    return cast("Entry", msgpack.unpackb(data, use_list=False, ext_hook=_from_ext, unicode_errors="surrogatepass"))


def _text(data: bytes) -> str:
    return data.decode(errors="surrogateescape")


def _row_crc(position: int, address: int, chain: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(_PLACE.pack(position, address, chain)))


def _crc(*fields: object) -> int:
    """Checksum of the fields of a small row."""
    return zlib.crc32(repr(fields).encode("utf-8", "surrogatepass"))


def _digest(address: str, turn: int, epoch: int, data: bytes) -> bytes:
    digest = blake2b(repr((address, turn, epoch, len(data))).encode(), digest_size=16)
    digest.update(data)  # releases the GIL, so the loop goes on while a worker thread is here
    return digest.digest()


def _pack_positions(positions: Sequence[int]) -> bytes:
    """Sorted positions as one blob; zlib adds the checksum (Adler-32)."""
    return zlib.compress(array("q", sorted(set(positions))).tobytes(), 1)


def _unpack_positions(blob: bytes) -> array[int]:
    positions = array("q")
    if blob:
        positions.frombytes(zlib.decompress(blob))
    return positions


# ------------------------------------------------------------------------------------------------- processes and files


def _boot() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _start_of(pid: int) -> str | None:
    """Identify one life of a pid: boot and start time in clock ticks; `None` if that cannot be read."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return f"{_boot()}:{fields[19]}"


@contextlib.contextmanager
def _living(pid: int, start: str | None) -> Generator[int | None, None, None]:
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
        same = start is None or _start_of(pid) in (start, None)
        yield pidfd if same and not _has_ended(pidfd, 0.0) else None
    finally:
        os.close(pidfd)


def _has_ended(pidfd: int, seconds: float) -> bool:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(seconds * 1000))


def _write_durably(path: str, data: bytes) -> None:
    """Create the file so that it exists after a power loss completely or not at all."""
    temporary = f"{path}.tmp"
    try:
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.rename(temporary, path)
        _sync(os.path.dirname(path))
    except BaseException:
        for name in (temporary, path):
            with contextlib.suppress(OSError):
                os.unlink(name)
        raise


def _sync(path: str) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _lock_holder(path: str) -> int | None:
    """Pid of the process that has an exclusive SQLite lock on the store, from /proc/locks.

    Asking the kernel through `fcntl` would need a descriptor of our own, and closing it would drop the locks of any
    connection this process has.
    """
    files: set[str] = set()
    for name in (path, f"{path}-shm"):
        with contextlib.suppress(OSError):
            info = os.stat(name)
            files.add(f"{os.major(info.st_dev):02x}:{os.minor(info.st_dev):02x}:{info.st_ino}")
    for line in Path("/proc/locks").read_text().splitlines():
        words = line.split()
        if "WRITE" in words and words[-3] in files and int(words[-4]) > 0:
            return int(words[-4])
    return None


def _code(error: Exception) -> int:
    """Primary SQLite result code; 0 if SQLite itself did not object."""
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF


# ------------------------------------------------------------------------------------------------- the engine


@dataclass(slots=True)
class _Chain:
    """What is known of one address. `path` is `None` while an erase is under way."""

    id: int
    path: str | None
    removed: int = 0  # rows removed by cuts, and the sum of their chain numbers
    removed_sum: int = 0
    floor: int = 0  # the chain is at least this long
    kept: list[int] = field(default_factory=list[int])  # ids of its snapshots, oldest first
    last: int = 0  # newest chain number
    total: int = 0  # sum of the chain numbers of `positions`
    positions: array[int] = field(default_factory=lambda: array("q"))
    damage: DamagedStore | None = None

    def stored(self) -> tuple[int, str | None, int, int, int, str]:
        return self.id, self.path, self.removed, self.removed_sum, self.floor, ",".join(map(str, self.kept))


class SqliteJournal:
    """A `Journal` in a SQLite file; one process at a time.

    Args:
        path: the database; created if missing, with mode 0600.
        takeover: kill the process that has the store open, through its pidfd, and wait until it is dead.
        synchronous: `"os"` survives the death of the process at any instant; a power loss may take the newest
            appends, but leaves the store sound. `"fsync"` survives power loss too; each append then waits for the
            disk, so call it in a worker thread, with as many entries as have gathered.

    Raises:
        StoreInUse: a live process, this one included, has it open.
        DamagedStore: the file is damaged, or entries that were acknowledged are gone. Damage that concerns one address
            only is raised when that address is used; the others work.
        StoreFailed: the operating system refused.

    All methods may be called from any thread. After an I/O error the journal refuses everything (T13: what a failed
    fsync has left on the disk is unknown): open it again, which verifies it.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, takeover: bool = False, synchronous: Literal["os", "fsync"] = "os"
    ) -> None:
        if synchronous not in ("os", "fsync"):
            raise ValueError(f"synchronous is 'os' or 'fsync', not {synchronous!r}")
        if not hasattr(os, "pidfd_open"):
            raise RuntimeError("the SQLite store needs Linux: it tells and ends other owners by pidfd")
        self.durable = True
        self.epoch = 0
        self.path = os.path.realpath(path)
        self._fsync = synchronous == "fsync"
        self._folder = f"{self.path}-snapshots"
        self._file_numbers = count(1)
        self._pack = cast(
            "Callable[[Entry], bytes]", msgpack.Packer(default=_big_int, unicode_errors="surrogatepass").pack
        )
        self._lock = threading.RLock()  # guards the writing connection and all that follows
        self._read_lock = threading.Lock()
        self._chains: dict[str, _Chain] = {}
        self._notes: dict[str, bytes] = {}
        self._erased: list[_Chain] = []
        self._last = 0  # newest position handed out
        self._live = 0  # rows in `entries`
        self._in_doubt = False  # Is what we hold in memory behind or ahead of the file?
        self._failure: HoldfastError | None = None
        self._mark = -1
        self._unsaved_bytes = 0  # written to the WAL since the last checkpoint, roughly
        self._checkpointer: threading.Thread | None = None
        try:
            self._open(takeover)
        except (sqlite3.Error, OSError) as error:
            raise self._translate(error) from error
        except UnicodeDecodeError as error:  # SQLite quotes a damaged schema, and Python cannot read the quotation.
            raise DamagedStore(self.path, None, None, "its tables are not as they were created") from error

    # ---- opening and closing

    def _open(self, takeover: bool) -> None:
        with contextlib.suppress(FileExistsError):
            os.mkdir(self._folder, mode=0o700)  # not its parents: a mistyped path should not be made true
        if not os.path.exists(self.path):
            self._create()
        if os.path.getsize(self.path) == 0:  # SQLite would take it for a new database
            raise DamagedStore(self.path, None, None, "the file is empty")
        self._db, self._reader = self._connect(), self._connect()
        try:
            self._claim(takeover)
            try:
                self._recover()
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    self._release()
                raise
        except BaseException:
            self._disconnect()
            raise

    def _create(self) -> None:
        """Make the database elsewhere and link it into place: half a database is then never seen under its name."""
        if os.path.exists(f"{self.path}-wal"):
            raise DamagedStore(self.path, None, None, "the file is gone, but its -wal file is still there")
        new = os.path.join(self._folder, f"new-{os.getpid()}-{threading.get_ident()}")
        with contextlib.suppress(FileNotFoundError):
            os.unlink(new)  # left by an earlier process with our pid
        os.close(os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))  # SQLite gives -wal and -shm the same mode
        with contextlib.closing(sqlite3.connect(new, isolation_level=None)) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute(f"PRAGMA application_id = {_APPLICATION}")
            db.execute(f"PRAGMA user_version = {_VERSION}")
            for statement in _SCHEMA:
                db.execute(statement)
            db.execute("INSERT INTO store VALUES (1, 0, 0, '', 0, 0, ?)", (_crc(0, 0, "", 0, 0),))
        _sync(new)
        try:
            os.link(new, self.path)
            _sync(os.path.dirname(self.path))
        except (FileExistsError, FileNotFoundError):
            pass  # Another opener was quicker, and as the owner it may have swept ours away.
        with contextlib.suppress(FileNotFoundError):
            os.unlink(new)

    def _connect(self) -> sqlite3.Connection:
        db = sqlite3.connect(
            f"{Path(self.path).as_uri()}?mode=rw",  # never create: see `_create`
            uri=True,
            timeout=_BUSY_SECONDS,
            isolation_level=None,
            check_same_thread=False,
        )
        # A flipped bit may make a blob a text that is not UTF-8: leave it to the checksums.
        db.text_factory = _text
        db.execute("PRAGMA wal_autocheckpoint = 0")  # It would sync the disk within an append: see `_checkpoint`.
        return db

    def _claim(self, takeover: bool) -> None:
        """Become the owner, unless a living process is."""
        deadline = time.monotonic() + _KILL_SECONDS
        while True:
            try:
                self._identify_file()
                seen = self._read_store()
                self._refuse_living(seen[1], seen[2], takeover)
                self._verify_structure()
                if self._take(seen):
                    return
            except sqlite3.OperationalError as error:
                if _code(error) != sqlite3.SQLITE_BUSY or time.monotonic() > deadline:
                    raise
                # A process that was stopped inside a transaction, or while it opened or closed the store.
                holder = _lock_holder(self.path)
                if holder is not None and holder != os.getpid():
                    self._refuse_living(holder, None, takeover)
                time.sleep(0.01)

    def _read_store(self) -> tuple[int, int, str, int, int]:
        """The row of the store: epoch, pid and start of its owner, floor, live."""
        row = self._db.execute("SELECT epoch, pid, start, floor, live, crc FROM store").fetchone()
        if row is None or row[5] != _crc(*row[:5]):
            raise DamagedStore(self.path, None, None, "the checksum of the store row is wrong")
        epoch, pid, start, floor, live, _ = row
        return epoch, pid, start, floor, live

    def _refuse_living(self, pid: int, start: str | None, takeover: bool) -> None:
        """Raise `StoreInUse` if that process lives, or see it dead first if we may."""
        with _living(pid, start) as pidfd:
            if pidfd is None:
                return
            if not takeover or pid == os.getpid():
                raise StoreInUse(self.path, pid)
            try:
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            except PermissionError as error:
                raise StoreInUse(self.path, pid) from error
            except ProcessLookupError:
                pass
            if not _has_ended(pidfd, _KILL_SECONDS):  # It hangs in the kernel, and may still write when it wakes.
                raise StoreInUse(self.path, pid)

    def _identify_file(self) -> None:
        """Refuse a file that is not ours."""
        (application,) = self._db.execute("PRAGMA application_id").fetchone()
        (version,) = self._db.execute("PRAGMA user_version").fetchone()
        (mode,) = self._db.execute("PRAGMA journal_mode").fetchone()
        if application != _APPLICATION or mode != "wal":
            raise DamagedStore(self.path, None, None, "this is not a holdfast store")
        if version != _VERSION:
            raise DamagedStore(self.path, None, None, f"its format is {version}, this holdfast reads {_VERSION}")
        found = [sql for (sql,) in self._db.execute("SELECT sql FROM sqlite_master WHERE sql NOT NULL ORDER BY rowid")]
        if [sql for sql in found if "sqlite_sequence" not in sql] != _SCHEMA:
            raise DamagedStore(self.path, None, None, "its tables are not as they were created")

    def _verify_structure(self) -> None:
        """Refuse a broken file before the first write to it."""
        (verdict,) = self._db.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise DamagedStore(self.path, None, None, str(verdict))

    def _take(self, seen: tuple[int, int, str, int, int]) -> bool:
        """Write ourselves in as the owner, if nobody was quicker."""
        db = self._db
        # Synced even under "os": an epoch that was seen outside must not come again after a power loss.
        db.execute("PRAGMA synchronous = FULL")
        db.execute("BEGIN IMMEDIATE")
        try:
            if self._read_store() != seen:
                return False
            self.epoch = seen[0] + 1
            self._owner = os.getpid(), _start_of(os.getpid()) or ""
            self._write_store(*seen[3:])
            db.execute("COMMIT")
        finally:
            if db.in_transaction:
                db.execute("ROLLBACK")
        db.execute(f"PRAGMA synchronous = {'FULL' if self._fsync else 'NORMAL'}")
        db.execute(f"PRAGMA journal_size_limit = {_WAL_FRAMES * 4096}")
        return True

    def _recover(self) -> None:
        """Verify what an earlier owner left, and finish what it began."""
        self._scan()
        boot = _boot().encode()
        self._mark = os.open(f"{self.path}-mark", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        mark = os.pread(self._mark, _MARK.size, 0)
        if len(mark) == _MARK.size:
            position, synced, marked_boot = _MARK.unpack(mark)
            # After a power loss entries may be gone that were not synced. After anything else they may not.
            if position > self._last and (synced or marked_boot == boot):
                reason = (
                    f"positions up to {position} were acknowledged, but they end at {self._last} "
                    f"(remove {self.path}-mark to go on without them)"
                )
                raise DamagedStore(self.path, None, self._last + 1, reason)
        os.pwrite(self._mark, _MARK.pack(self._last, self._fsync, boot), 0)
        while self._erased:
            self._finish_erase(self._erased.pop())
        known = {name for (name,) in self._db.execute("SELECT file FROM snapshots WHERE file NOT NULL")}
        self._remove_files([name for name in os.listdir(self._folder) if name not in known])

    def _write_store(self, floor: int, live: int) -> None:
        fields = (self.epoch, *self._owner, floor, live)
        self._db.execute(
            "UPDATE store SET epoch = ?, pid = ?, start = ?, floor = ?, live = ?, crc = ?", (*fields, _crc(*fields))
        )

    def _release(self) -> None:
        """Strike ourselves out as the owner, leaving everything else as it is."""
        db = self._db
        db.execute("BEGIN IMMEDIATE")
        epoch, floor, live = db.execute("SELECT epoch, floor, live FROM store").fetchone()
        if epoch == self.epoch:
            self._owner = 0, ""
            self._write_store(floor, live)
        db.execute("COMMIT")

    def close(self) -> None:
        """Release the store and sync it; a second call does nothing."""
        with self._lock:
            if self._mark < 0:
                return
            clean = self._failure is None and not self._in_doubt
            self._failure = self._failure or StoreFailed(self.path, "it is closed")
            mark, self._mark = self._mark, -1
            checkpointer = self._checkpointer
        os.close(mark)
        if checkpointer is not None:
            checkpointer.join()  # not under the lock, which it may need
        with self._lock, self._read_lock:
            try:
                with contextlib.suppress(sqlite3.Error):
                    self._retire(clean)
            finally:
                self._disconnect()

    def _retire(self, clean: bool) -> None:
        """Leave the last word on how much there is, so that the mark is not needed, and strike ourselves out."""
        db = self._db
        if clean and db.execute("SELECT epoch FROM store").fetchone() == (self.epoch,):
            db.execute("PRAGMA synchronous = FULL")
            db.execute("BEGIN IMMEDIATE")
            self._write_store(self._last, self._live)
            db.execute("COMMIT")
            os.unlink(f"{self.path}-mark")
        self._release()

    def _disconnect(self) -> None:
        if self._mark >= 0:
            os.close(self._mark)
            self._mark = -1
        for db in (self._reader, self._db):
            with contextlib.suppress(sqlite3.Error):
                db.close()

    # ---- what is in the file

    def _scan(self) -> None:
        """Read into memory where each address has its entries, and verify that none is missing."""
        floor, live = self._db.execute("SELECT floor, live FROM store").fetchone()
        chains = self._scan_addresses()
        last, total = self._scan_entries(chains)
        for chain in chains.values():
            self._verify_chain(chain)
        last = max(last, floor)
        if total != live + last - floor and not any(chain.damage for chain in chains.values()):
            reason = f"there should be {live + last - floor} entries, there are {total}"
            raise DamagedStore(self.path, None, None, reason)
        self._chains = {chain.path: chain for chain in chains.values() if chain.path is not None}
        self._erased = [chain for chain in chains.values() if chain.path is None]
        self._notes = self._scan_notes()
        self._last, self._live, self._in_doubt = last, total, False

    def _scan_addresses(self) -> dict[int, _Chain]:
        chains: dict[int, _Chain] = {}
        for *fields, crc in self._db.execute("SELECT id, path, removed, removed_sum, floor, kept, crc FROM addresses"):
            if _crc(*fields) != crc:
                raise DamagedStore(self.path, str(fields[1]), None, "the checksum of the row of the address is wrong")
            number, path, removed, removed_sum, floor, kept = fields
            ids = [int(snapshot) for snapshot in kept.split(",") if snapshot]
            chains[number] = _Chain(number, path, removed, removed_sum, floor, ids)
        for number, address in self._db.execute("SELECT id, address FROM snapshots"):
            if address not in chains:
                raise DamagedStore(self.path, None, None, f"snapshot {number} belongs to no address")
        return chains

    def _scan_entries(self, chains: dict[int, _Chain]) -> tuple[int, int]:
        """Give each chain its positions; return the newest position and the number of entries."""
        position = total = 0
        for position, address, number in self._db.execute(
            "SELECT position, address, chain FROM entries ORDER BY position"
        ):
            chain = chains.get(address)
            if chain is None or type(number) is not int:
                raise DamagedStore(self.path, None, position, "the entry belongs to no address")
            if number <= chain.last and chain.damage is None:
                chain.damage = DamagedStore(self.path, chain.path, position, "the entry is out of order")
            chain.last = number
            chain.total += number
            chain.positions.append(position)
            total += 1
        return position, total

    def _scan_notes(self) -> dict[str, bytes]:
        notes: dict[str, bytes] = {}
        for name, value, crc in self._db.execute("SELECT name, value, crc FROM notes"):
            if crc != _crc(name, value):
                raise DamagedStore(self.path, None, None, f"the checksum of note {name!r} is wrong")
            notes[name] = value
        return notes

    def _verify_chain(self, chain: _Chain) -> None:
        """Note the damage if entries are missing anywhere but at the end."""
        length = len(chain.positions) + chain.removed
        missing = (length * (length + 1) // 2 - chain.total - chain.removed_sum) % _MODULUS
        if chain.damage is None and (missing or length < max(chain.floor, chain.last)):
            chain.damage = DamagedStore(self.path, chain.path, self._hole(chain), "entries are missing")
        chain.last = length

    def _hole(self, chain: _Chain) -> int | None:
        """The position before which the missing entry was, if it is certain which one it is."""
        length = len(chain.positions) + chain.removed + 1  # if it is only one, and it is not the last
        absent = (length * (length + 1) // 2 - chain.total - chain.removed_sum) % _MODULUS
        for position, number in self._db.execute(
            "SELECT position, chain FROM entries WHERE address = ? ORDER BY position", (chain.id,)
        ):
            if number >= absent:
                return int(position) if number > absent else None
        return None

    def _chain(self, address: str) -> _Chain:
        """The chain of an address, made within the running transaction if there is none."""
        chain = self._chains.get(address)
        if chain is None:
            new = self._db.execute("INSERT INTO addresses(path) VALUES (?)", (address,)).lastrowid
            assert new is not None
            chain = self._chains[address] = _Chain(new, address)
            self._write_chain(chain)
        elif chain.damage is not None:
            raise DamagedStore(*chain.damage.args)
        return chain

    def _write_chain(self, chain: _Chain) -> None:
        fields = chain.stored()
        self._db.execute(
            "UPDATE addresses SET path = ?, removed = ?, removed_sum = ?, floor = ?, kept = ?, crc = ? WHERE id = ?",
            (*fields[1:], _crc(*fields), chain.id),
        )

    # ---- transactions

    @contextlib.contextmanager
    def _transaction(self, size: int = 0, *, note: bool = False) -> Generator[sqlite3.Connection, None, None]:
        """Run a write of about `size` bytes as the owner, or not at all.

        With `note` the transaction takes a position of its own, so that the mark shows if it is lost, and the store
        row is brought up to date.
        """
        with self._lock:
            self._refresh()
            db = self._db
            try:
                db.execute("BEGIN IMMEDIATE")
                (current,) = db.execute("SELECT epoch FROM store").fetchone()
                if current != self.epoch:
                    raise StaleEpoch(self.path, self.epoch, current)
                self._in_doubt = True
                yield db
                if note:
                    self._last += 1
                    self._write_store(self._last, self._live)
                db.execute("COMMIT")
                self._in_doubt = False
                os.pwrite(self._mark, self._last.to_bytes(8, "little"), 0)
            except BaseException as error:
                if db.in_transaction:
                    with contextlib.suppress(sqlite3.Error):
                        db.execute("ROLLBACK")
                if isinstance(error, sqlite3.Error | OSError):
                    raise self._translate(error) from error
                raise
            self._unsaved_bytes += size + 8192
            if self._unsaved_bytes > _CHECKPOINT_BYTES:
                self._start_checkpoint()

    def _refuse_failed(self) -> None:
        if self._failure is not None:
            raise type(self._failure)(*self._failure.args)  # a new one: tracebacks would grow on a shared one

    def _refresh(self) -> None:
        """Make sure that memory and file agree, after a transaction that was broken off."""
        self._refuse_failed()
        if self._in_doubt:
            try:
                self._scan()
            except sqlite3.Error as error:
                raise self._translate(error) from error

    def _translate(self, error: sqlite3.Error | OSError) -> HoldfastError:
        """Our error for theirs; after damage or an I/O error the journal stops for good."""
        code = _code(error)
        # Our statements are fixed: if SQLite finds one in error, the file is no longer what they are for.
        damaged = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
        translated: HoldfastError
        if isinstance(error, OSError) or code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN):
            translated = StoreFailed(self.path, f"{error}; open it again, which verifies it")
        elif code in damaged:
            translated = DamagedStore(self.path, None, None, str(error))
        else:
            hint = {sqlite3.SQLITE_BUSY: "try again", sqlite3.SQLITE_FULL: "make room and try again"}
            return StoreFailed(self.path, f"{error}; nothing was written, {hint.get(code, 'it cannot be')}")
        self._failure = self._failure or translated
        return translated

    def _start_checkpoint(self) -> None:
        if self._checkpointer is None or not self._checkpointer.is_alive():
            self._unsaved_bytes = 0
            self._checkpointer = threading.Thread(target=self._checkpoint, name="holdfast-store", daemon=True)
            self._checkpointer.start()

    def _checkpoint(self) -> None:
        """Bring the WAL into the database: in a thread, for it syncs twice, which takes milliseconds.

        Writers go on meanwhile, so it seldom finds an end; only a WAL grown too long makes them wait for one.
        """
        try:
            with contextlib.closing(self._connect()) as db:
                _, frames, _ = db.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
                if frames > _WAL_FRAMES:
                    with self._lock:
                        db.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        except sqlite3.Error as error:
            self._translate(error)  # A failed sync stops the journal; a lock in the way does not.

    # ---- the protocol

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Append (address, entry) pairs in one transaction; see `Journal`.

        Raises:
            TypeError: an entry holds something else than primitives and tuples of them; nothing was written.
            StaleEpoch, DamagedStore, StoreFailed: nothing was written.
        """
        if not entries:
            return []
        with self._lock:
            packed: list[tuple[str, Primitive, bytes]] = []
            size = 0
            for address, entry in entries:
                _check(entry)
                data = self._pack(entry)
                packed.append((address, entry[0], data))
                size += len(data)
            with self._transaction(size) as db:
                first = self._last + 1
                db.executemany("INSERT INTO entries VALUES (?, ?, ?, ?, ?, ?)", self._rows(packed))
                return list(range(first, self._last + 1))

    def _rows(self, packed: list[tuple[str, Primitive, bytes]]) -> list[tuple[int, int, int, Primitive, bytes, int]]:
        """Give each entry its position and its place in its chain."""
        rows: list[tuple[int, int, int, Primitive, bytes, int]] = []
        position = self._last
        for address, kind, data in packed:
            chain = self._chain(address)
            position += 1
            chain.last += 1
            chain.positions.append(position)
            rows.append((position, chain.id, chain.last, kind, data, _row_crc(position, chain.id, chain.last, data)))
        self._last = position
        self._live += len(rows)
        return rows

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int) -> None:
        """Keep the snapshot, then forget what it contains; see `Journal`.

        A snapshot of more than 1 MiB becomes a file, synced before the row that names it is written. Takes as long as
        the disk does and removes rows in small transactions: call it in a worker thread.
        """
        self._refuse_failed()
        digest = _digest(address, turn, self.epoch, snapshot)
        file = self._write_file(snapshot) if len(snapshot) > _INLINE_BYTES else None
        data = snapshot if file is None else None
        try:
            with self._transaction(len(data or b""), note=True) as db:
                chain = self._chain(address)
                row = (chain.id, turn, self.epoch, _pack_positions(drop), file, digest, data)
                number = db.execute("INSERT INTO snapshots VALUES (NULL, ?, ?, ?, ?, ?, ?, ?)", row).lastrowid
                chain.kept.append(number or 0)
                chain.floor = chain.last
                self._write_chain(chain)
        except (StaleEpoch, StoreFailed):
            if file is not None and self._failure is None:  # After a failed sync nobody knows if the row exists.
                os.unlink(os.path.join(self._folder, file))
            raise
        try:
            self._clean(chain)
        except StoreFailed:
            if self._failure is not None:
                raise
            # The snapshot is kept, which is what we promised; the next cut cleans up.

    def _write_file(self, snapshot: bytes) -> str:
        name = f"{self.epoch}-{next(self._file_numbers)}.snapshot"
        try:
            _write_durably(os.path.join(self._folder, name), snapshot)
        except OSError as error:
            # The journal goes on: nothing is synced twice here, the next attempt writes a new file.
            raise StoreFailed(self.path, f"snapshot not written: {error}; older one and journal stay") from error
        return name

    def _clean(self, chain: _Chain) -> None:
        """Remove what only snapshots before the two newest need. A crash in between is made good by the next cut."""
        for number in chain.kept[:-1]:
            self._remove_dropped(chain, number)
        outdated = chain.kept[:-2]
        if not outdated:
            return
        with self._transaction(note=True) as db:
            files = self._delete_snapshots(db, outdated)
            del chain.kept[: len(outdated)]
            self._write_chain(chain)
        self._remove_files(files)

    def _remove_dropped(self, chain: _Chain, number: int) -> None:
        """Physically remove the entries that a snapshot made superfluous, then forget which they were."""
        with self._transaction() as db:
            row = db.execute("SELECT drops FROM snapshots WHERE id = ?", (number,)).fetchone()
        try:
            positions = _unpack_positions(row[0])
        except (TypeError, ValueError, zlib.error) as error:
            raise DamagedStore(self.path, chain.path, None, f"the drop list of snapshot {number} is damaged") from error
        if row[0]:
            for start in range(0, len(positions), _CHUNK):
                self._remove(chain, positions[start : start + _CHUNK])
            with self._transaction() as db:
                db.execute("UPDATE snapshots SET drops = x'' WHERE id = ?", (number,))

    def _remove(self, chain: _Chain, positions: array[int]) -> None:
        """Remove those of the sorted positions that the chain has, in one transaction."""
        with self._transaction(note=True) as db:
            low, high = bisect_left(chain.positions, positions[0]), bisect_right(chain.positions, positions[-1])
            doomed = set(positions)
            window = chain.positions[low:high]
            gone = [position for position in window if position in doomed]
            marks = ",".join("?" * len(gone))
            number, total = db.execute(
                f"SELECT count(*), sum(chain) FROM entries WHERE position IN ({marks})", gone
            ).fetchone()
            if number != len(gone):
                raise DamagedStore(self.path, chain.path, gone[0], "entries have vanished")
            db.execute(f"DELETE FROM entries WHERE position IN ({marks})", gone)
            chain.positions[low:high] = array("q", (position for position in window if position not in doomed))
            chain.removed += number
            chain.removed_sum = (chain.removed_sum + (total or 0)) % _MODULUS
            self._live -= number
            self._write_chain(chain)

    def _delete_snapshots(self, db: sqlite3.Connection, numbers: Sequence[int]) -> list[str]:
        """Delete the rows; return the files to be removed once that is committed."""
        files: list[str] = []
        for number in numbers:
            row = db.execute("SELECT file FROM snapshots WHERE id = ?", (number,)).fetchone()
            files += [row[0]] if row and row[0] else []
            db.execute("DELETE FROM snapshots WHERE id = ?", (number,))
        return files

    def _remove_files(self, names: list[str]) -> None:
        """Remove snapshot files that no row names.

        First the WAL is synced: otherwise a power loss could bring back the rows, but not the files. (It has no locks,
        so that closing it drops none.)
        """
        if names and os.path.exists(f"{self.path}-wal"):
            _sync(f"{self.path}-wal")
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(os.path.join(self._folder, name))

    def load(self, address: str, *, older: bool = False) -> Saved:
        """Read back one address; see `Journal`. Appends go on meanwhile."""
        with self._read_lock:
            try:
                with self._view(address) as view:
                    return Saved(None, 0, []) if view is None else self._load(*view, older)
            except sqlite3.Error as error:
                translated = self._translate(error)
                if isinstance(translated, DamagedStore):
                    raise DamagedStore(self.path, address, None, translated.reason) from error
                raise translated from error

    @contextlib.contextmanager
    def _view(self, address: str) -> Generator[tuple[_Chain, array[int], list[int]] | None, None, None]:
        """Freeze the file, for the reading connection, at the very state that the memory describes now."""
        db = self._reader
        with self._lock:
            self._refresh()
            db.execute("BEGIN")
            (current,) = db.execute("SELECT epoch FROM store").fetchone()
            chain = self._chains.get(address)
            view = None if chain is None else (chain, chain.positions[:], chain.kept[:])
        try:
            if current != self.epoch:
                raise StaleEpoch(self.path, self.epoch, current)
            if chain is not None and chain.damage is not None:
                raise DamagedStore(*chain.damage.args)
            yield view
        finally:
            db.execute("ROLLBACK")

    def _load(self, chain: _Chain, positions: array[int], kept: list[int], older: bool) -> Saved:
        reason = ""
        snapshot, turn = None, 0
        dropped: set[int] = set()
        candidates = kept[:-1] if older and len(kept) > 1 else kept
        # During a clean-up there are more than two, but the entries of the oldest may already be gone.
        for number in reversed(candidates[-1:] if older else kept[-2:]):
            try:
                snapshot, turn = self._read_snapshot(chain, number)
                dropped = self._read_drops(chain, kept[: kept.index(number) + 1])
                break
            except DamagedStore as error:
                reason = reason or error.reason
        if kept and snapshot is None:
            raise DamagedStore(self.path, chain.path, None, f"no snapshot is left: {reason}")
        entries = self._read_entries(chain, positions)
        return Saved(snapshot, turn, [pair for pair in entries if pair[0] not in dropped], reason)

    def _read_snapshot(self, chain: _Chain, number: int) -> tuple[bytes, int]:
        row = self._reader.execute(
            "SELECT turn, epoch, file, digest, data FROM snapshots WHERE id = ?", (number,)
        ).fetchone()
        if row is None:
            raise DamagedStore(self.path, chain.path, None, f"snapshot {number} is missing")
        turn, epoch, file, digest, data = row
        where = f"snapshot {number}"
        if file is not None:
            where = f"snapshot file {self._folder}/{file}"
            try:
                data = Path(self._folder, str(file)).read_bytes()
            except (OSError, ValueError) as error:
                raise DamagedStore(self.path, chain.path, None, f"{where} cannot be read: {error}") from error
        if not isinstance(data, bytes) or digest != _digest(chain.path or "", turn, epoch, data):
            raise DamagedStore(self.path, chain.path, None, f"the checksum of {where} is wrong")
        return data, turn

    def _read_drops(self, chain: _Chain, numbers: list[int]) -> set[int]:
        """The positions that the newest of these snapshots contains, as far as they are not yet removed."""
        dropped: set[int] = set()
        for number in numbers:
            row = self._reader.execute("SELECT drops FROM snapshots WHERE id = ?", (number,)).fetchone()
            try:
                dropped.update(_unpack_positions(row[0]))
            except (TypeError, ValueError, zlib.error) as error:
                reason = f"the drop list of snapshot {number} is damaged"
                raise DamagedStore(self.path, chain.path, None, reason) from error
        return dropped

    def _read_entries(self, chain: _Chain, positions: array[int]) -> list[tuple[int, Entry]]:
        """Read and verify all rows of the chain, in order."""
        entries: list[tuple[int, Entry]] = []
        for start in range(0, len(positions), _CHUNK):
            chunk = positions[start : start + _CHUNK].tolist()
            rows = self._reader.execute(
                "SELECT position, address, chain, kind, data, crc FROM entries"
                f" WHERE position IN ({','.join('?' * len(chunk))}) ORDER BY position",
                chunk,
            ).fetchall()
            if len(rows) != len(chunk):
                lost = min(set(chunk) - {row[0] for row in rows})
                raise DamagedStore(self.path, chain.path, lost, "the entry is missing")
            entries += [(row[0], self._read_entry(chain, *row)) for row in rows]
        return entries

    def _read_entry(
        self, chain: _Chain, position: int, address: int, number: int, kind: object, data: bytes, crc: int
    ) -> Entry:
        try:
            if address == chain.id and crc == _row_crc(position, address, number, data):
                entry = _decode(data)
                if entry[0] == kind:
                    return entry
        except (TypeError, ValueError, struct.error):
            pass  # A flipped bit may also change the type of a column.
        raise DamagedStore(self.path, chain.path, position, "the checksum of the entry is wrong")

    def erase(self, address: str) -> None:
        """Forget everything about the address; see `Journal`."""
        with self._lock:
            self._refresh()
            if address not in self._chains:
                return
            with self._transaction(note=True):
                # From here on it is gone; if we die before the rest is done, the next opening does it.
                chain = self._chains.pop(address)
                chain.path = None
                self._write_chain(chain)
        self._finish_erase(chain)

    def _finish_erase(self, chain: _Chain) -> None:
        while chain.positions:
            self._remove(chain, chain.positions[:_CHUNK])
        with self._transaction(note=True) as db:
            owned = db.execute("SELECT id FROM snapshots WHERE address = ?", (chain.id,)).fetchall()
            files = self._delete_snapshots(db, [number for (number,) in owned])
            db.execute("DELETE FROM addresses WHERE id = ?", (chain.id,))
        self._remove_files(files)

    def addresses(self) -> list[str]:
        """Every address that has something stored, sorted."""
        with self._lock:
            self._refresh()
            return sorted(self._chains)

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small named fact; see `Journal`."""
        with self._transaction(len(value or b""), note=True) as db:
            db.execute("DELETE FROM notes WHERE name = ?", (key,))
            self._notes.pop(key, None)
            if value is not None:
                db.execute("INSERT INTO notes VALUES (NULL, ?, ?, ?)", (key, value, _crc(key, value)))
                self._notes[key] = value

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or `None`."""
        with self._lock:
            self._refresh()
            return self._notes.get(key)
