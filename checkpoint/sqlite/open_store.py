"""The open store: what it holds, as the memory has it, and writes that happen as the owner's or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import threading
import uuid
from array import array
from collections.abc import Generator, Sequence
from time import monotonic
from typing import Final, NamedTuple

from ...actors.errors import HoldfastError
from ..journal import DamagedStore, Entry, StaleEpoch, StoreFailed
from .append_log import FrontLog, LogSealed, NoRoom, Row, following
from .database import connect, create_database
from .entry_chains import Chain, StoreContents, StoreScan, create_chain
from .in_hand import InputsInHand
from .ownership import StoreClaim, refuse_copy
from .position_mark import PositionMark
from .sealing import format_of, may_have_log
from .snapshot_files import SnapshotFiles, sync
from .store_parts import Parts, result_code
from .wal import Wal, room_wanted

INSERT: Final = "INSERT INTO entries VALUES (?, ?, ?, ?, ?, ?)"
_REFUSALS: Final = frozenset((errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT))
_WRITABLE: Final = "have its folder there, and that and all files of the store writable to this user"
LOOK_SECONDS: Final = 0.05
"""How long writes may be acknowledged after the store was deleted or replaced, before anybody looks."""


class Joint(NamedTuple):
    """A transaction that others join, and the files to be removed behind it."""

    db: sqlite3.Connection
    doomed: list[str]


def is_full(error: BaseException | None) -> bool:
    """Whether this is the operating system's, or SQLite's, word for a disk that is full."""
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    return isinstance(error, sqlite3.Error) and result_code(error) == sqlite3.SQLITE_FULL


class Store:
    """One process's hold on a store, from `opening` to `close`.

    Attributes:
        lock: guards the writing connection and all that memory says of the file; it may be taken again by its holder.
        read_lock: guards the reading connection.
        contents: what the file holds, and the log in front of it.
        log: rows that are not in the database yet. Each transaction brings them there.
        in_doubt: whether memory may be behind or ahead of the file.
        failure: why everything is refused from now on.
    """

    def __init__(self, path: str, key: bytes | None, *, fsync: bool) -> None:
        self.path = path
        self.parts = Parts(path, key)
        self.files = SnapshotFiles(path, self.parts)
        self.lock = threading.RLock()
        self._joint: Joint | None = None
        self.read_lock = threading.Lock()
        self.contents = StoreContents({}, [], {}, 0, 0)
        self.failure: HoldfastError | None = None
        self.log = FrontLog(path, is_used=not fsync)
        self._fsync = fsync
        self._look_at = 0.0
        self._mark = PositionMark(path)
        self.hands = InputsInHand(path)
        self.in_doubt = False
        self._wal = Wal(path, self.lock, self.translate)

    # ---- opening and closing

    @contextlib.contextmanager
    def opening(self, *, takeover: bool) -> Generator[None, None, None]:
        """Open the store, then do what the caller has to do before it counts as open; if anything fails, let go of it.

        Raises:
            StoreInUse, DamagedStore, StoreFailed: see `SqliteJournal`.
        """
        try:
            self._connect()
            try:
                self.claim.take(takeover)
                self._configure()
                try:
                    self._scan()
                    self._begin_log()
                    self.hands.open(self.log.identity, self.parts.cipher.digest_key)
                    yield
                    self.parts.opened()
                except BaseException:
                    with contextlib.suppress(sqlite3.Error):
                        self.claim.release()
                    raise
            except BaseException as error:
                refusal = self._without_room(error)
                self._disconnect()
                if refusal is not None:
                    raise refusal from error
                raise
        except (sqlite3.Error, OSError) as error:
            raise self.translate(error) from error
        except UnicodeDecodeError as error:  # SQLite quotes a damaged schema, and Python cannot read the quotation.
            raise DamagedStore(self.path, None, None, "its tables are not as they were created") from error

    def _without_room(self, error: BaseException) -> StoreFailed | None:
        """What to say of an opening that has failed because the disk is full; None if that is not why."""
        full = next((one for one in (error, error.__cause__) if is_full(one)), None)
        if full is None:
            return None
        room = f"{room_wanted(self.db, self.path) / 1e6:.1f} MB"
        return StoreFailed(
            self.path,
            f"{full}; nothing was written, make room for {room} and open it again; or have `holdfast store backup` "
            "copy it to another disk",
        )

    def _connect(self) -> None:
        is_there = self.parts.inspect()
        if is_there and os.path.getsize(self.path) == 0:  # SQLite would take it for a new database
            raise DamagedStore(self.path, None, None, "the file is empty")
        if is_there:
            refuse_copy(self.parts)
        with contextlib.suppress(FileExistsError):
            os.mkdir(self.files.folder, mode=0o700)  # not its parents: a mistyped path should not be made true
        if not is_there:
            self.log.make_folder()
            create_database(self.path, self.files.folder, self.parts.key)
        self.db, self.reader = connect(self.path), connect(self.path)
        self.claim = StoreClaim(self.db, self.parts)

    def _configure(self) -> None:
        self.db.execute(f"PRAGMA synchronous = {'FULL' if self._fsync else 'NORMAL'}")

    def _scan(self) -> None:
        """Take into memory what is in the file."""
        self.contents, self.in_doubt = StoreScan(self.db, self.path, self.parts.cipher).contents(), False
        rows = self.log.rows
        if rows and rows[0][0] <= self.contents.last:  # It was only broken off when all was done.
            self.log.restart()
        elif rows:
            self.contents.take_in(rows, self.path)

    def _begin_log(self) -> None:
        """Bring into the database what earlier owners have left in their logs, and begin one of our own."""
        log = self.log
        log.epoch = self.claim.epoch
        (version,) = self.db.execute("PRAGMA user_version").fetchone()
        if log.make_folder():
            if may_have_log(version):
                os.rmdir(log.folder)
                reason = f"its log is missing (make an empty folder {log.folder} to go on without what was in it)"
                raise DamagedStore(self.path, None, None, reason)
            sync(os.path.dirname(self.path))
        self.parts.adopt(self.db)
        log.identity = uuid.UUID(self.parts.id).bytes
        # A store was closed, and its owner killed before it had removed these; or its WAL is missing: the mark knows.
        stale, left = ([], log.left()) if may_have_log(version) else (log.left(), [])
        rows = following(log.read(left), self.contents.last)
        self.contents.take_in(rows, self.path)
        self._mark.check(self.contents.last, synced=self._fsync)
        if stale:
            log.remove(stale)
        log.rows = rows
        if left:  # They are removed next.
            self.db.execute("PRAGMA synchronous = FULL")
        with self.transaction() as db:
            db.execute(f"PRAGMA user_version = {format_of(self.parts.cipher, may_have_log=True)}")
        if left:
            log.remove(left)
            self._configure()

    def close(self) -> None:
        """Release the store and sync it; a second call does nothing.

        Raises:
            StoreFailed: it is not where it was opened, which nobody was told before: what was acknowledged may be gone.
        """
        lost = ""
        with self.lock:
            if not self._mark.is_open:
                return
            if self.failure is None and self._is_ours():
                lost = self._lost()
            clean = self.failure is None and not self.in_doubt
            self.failure = self.failure or StoreFailed(self.path, "it is closed")
            self._mark.close()
        self._wal.join()
        with self.lock, self.read_lock:
            try:
                with contextlib.suppress(sqlite3.Error):
                    self._retire(clean)
            finally:
                self._disconnect()
        if lost:
            raise StoreFailed(self.path, lost)

    def _retire(self, clean: bool) -> None:
        """Leave the last word on how much there is, so that the mark is not needed, and strike ourselves out."""
        db = self.db
        if clean:
            db.execute("PRAGMA synchronous = FULL")
            db.execute("BEGIN IMMEDIATE")
            clean = db.execute("SELECT epoch FROM store").fetchone() == (self.claim.epoch,)
            if clean:
                db.executemany(INSERT, self.log.rows)
                db.execute(f"PRAGMA user_version = {format_of(self.parts.cipher, may_have_log=False)}")
                self.claim.write(self.contents.last, self.contents.live)
            db.execute("COMMIT")
        if clean:
            self._mark.remove()
        self.hands.close(remove=clean)
        self.log.close(remove=clean)
        self.claim.release()

    def _disconnect(self) -> None:
        self._mark.close()
        self.log.close(remove=False)
        self.hands.close(remove=False)
        self.parts.close()
        self._wal.join()
        self._wal.close()
        for db in (self.reader, self.db):
            with contextlib.suppress(sqlite3.Error):
                db.close()

    # ---- transactions

    @contextlib.contextmanager
    def transaction(self, size: int = 0, *, note: bool = False) -> Generator[sqlite3.Connection, None, None]:
        """Run a write of about `size` bytes as the owner, or not at all.

        What is in the log goes before it. With `note` the transaction takes a position of its own, so that the mark
        shows if it is lost, and the store row is brought up to date.
        """
        with self.lock:
            if self._joint is not None:  # Of the thread that has the lock.
                yield self._joint.db
                return
            self.refresh()
            db, log = self.db, self.log
            try:
                db.execute("BEGIN IMMEDIATE")
                (current,) = db.execute("SELECT epoch FROM store").fetchone()
                if current != self.claim.epoch:
                    raise StaleEpoch(self.path, epoch=self.claim.epoch, current=current)
                self.in_doubt = True
                if log.is_due:
                    log.prepare()
                    db.executemany(INSERT, log.rows)
                yield db
                if note:
                    self.contents.last += 1
                    self.claim.write(self.contents.last, self.contents.live)
                db.execute("COMMIT")
                self._wal.is_unsynced = True
                size += log.size + 8192
                if log.is_due:
                    log.restart()
                self.in_doubt = False
                self._mark.set(self.contents.last)
            except BaseException as error:
                if db.in_transaction:
                    with contextlib.suppress(sqlite3.Error):
                        db.execute("ROLLBACK")
                if isinstance(error, sqlite3.Error | OSError):
                    raise self._refused(error) from error
                raise
            self._wal.committed(db, size)

    @contextlib.contextmanager
    def together(self) -> Generator[None, None, None]:
        """Have all that this thread writes meanwhile be one transaction."""
        doomed: list[str] = []
        with self.lock:
            with self.transaction(note=True) as db:
                self._joint = Joint(db, doomed)
                try:
                    yield
                finally:
                    self._joint = None
            with contextlib.suppress(StoreFailed):  # What was to be kept is kept; the next opening removes the others.
                self.remove_files(doomed)

    def takes(self, entries: Sequence[tuple[str, Entry]], size: int) -> bool:
        """Whether the log takes these entries, encoded in so many bytes; else they need a transaction."""
        if self.in_doubt or self.failure is not None or not self.log.takes(len(entries), size):
            return False
        if monotonic() >= self._look_at:
            self._look()
        for address, _ in entries:
            chain = self.contents.chains.get(address)
            if chain is None or chain.damage is not None:
                return False
        return True

    def write_log(self, rows: list[Row]) -> None:
        """Acknowledge rows that memory has already (`in_doubt`), by writing them to the log.

        Raises:
            StaleEpoch, StoreFailed: they are not.
        """
        try:
            self.log.write(rows)
        except LogSealed as error:
            (current,) = self.db.execute("SELECT epoch FROM store").fetchone()
            raise StaleEpoch(self.path, epoch=self.claim.epoch, current=current) from error
        except OSError as error:
            raise self._refused(error) from error
        self.in_doubt = False
        self._mark.set(self.contents.last)

    def sync(self) -> None:
        """Bring what was appended and committed so far to the disk.

        Without the lock while the disk works: the WAL only grows, or begins again when all of it is in the synced
        database; and its file stays the same for as long as somebody has it open.
        """
        with self._wal.syncing:
            with self.lock:
                self.refuse_failed()
                last, is_unsynced = self.contents.last, self._wal.begin_sync()
                files, kept = self.log.promise(), self.log.kept()
            try:
                if is_unsynced:
                    self._wal.sync()
                self.log.sync(files)
            except OSError as error:
                with self.lock:
                    raise self.translate(error) from error
            with self.lock:
                self.refuse_failed()
                self.log.free(kept)
                self._mark.set_synced(last)

    def sync_rows(self) -> None:
        """Bring what was committed to the disk, before anything is removed that it does not name any more.

        Raises:
            StoreFailed: from now on everything is refused: the WAL is what the journal stands in.
        """
        try:
            self.files.sync_rows()
        except OSError as error:
            with self.lock:
                raise self.translate(error) from error

    def remove_files(self, names: Sequence[str]) -> None:
        """Remove snapshot files that no row names.

        Raises:
            StoreFailed: they could not be removed, which is done at the next opening; or as `sync_rows`.
        """
        if not names:
            return
        if self._joint is not None:  # Until that is committed, rows name them.
            self._joint.doomed.extend(names)
            return
        self.sync_rows()
        try:
            self.files.remove(names)
        except OSError as error:
            raise StoreFailed(self.path, f"{error}; snapshot files are left behind") from error

    def refuse_failed(self) -> None:
        """Raise the failure that ended the store, if there is one."""
        if self.failure is not None:
            raise type(self.failure)(*self.failure.args)  # a new one: tracebacks would grow on a shared one

    def refresh(self) -> None:
        """Make sure that memory and file agree, after a transaction that was broken off."""
        self.refuse_failed()
        if monotonic() >= self._look_at:
            self._look()
        if self.in_doubt:
            self.log.is_broken_off = True
            try:
                self._scan()
            except sqlite3.Error as error:
                raise self.translate(error) from error

    def _look(self) -> None:
        """See now and then that what is written to is still the store: files that were deleted take writes, too.

        Raises:
            StoreFailed: it is not; from now on everything is refused.
        """
        self._look_at = monotonic() + LOOK_SECONDS
        lost = self._lost()
        if lost and self._is_ours():  # Else its new owner has done that, and the write itself says so.
            self.failure = StoreFailed(self.path, lost)
            self.refuse_failed()

    def _is_ours(self) -> bool:
        with contextlib.suppress(sqlite3.Error):
            return bool(self.db.execute("SELECT epoch FROM store").fetchone() == (self.claim.epoch,))
        return True

    def _lost(self) -> str:
        problem = self.parts.lost() or self.log.lost()
        return problem and f"{problem}: nothing is acknowledged any more; put the store back, and start again"

    def _refused(self, error: sqlite3.Error | OSError) -> HoldfastError:
        """Our error for a write that failed; if the disk is full, the room that the WAL takes may be had."""
        if is_full(error):
            self._wal.make_room()
        return self.translate(error)

    def translate(self, error: sqlite3.Error | OSError) -> HoldfastError:
        """Our error for theirs; after damage or an I/O error the journal stops for good."""
        code = result_code(error)
        # Our statements are fixed: if SQLite finds one in error, the file is no longer what they are for.
        damaged = (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
        translated: HoldfastError
        if isinstance(error, NoRoom):
            return StoreFailed(self.path, f"{error}; nothing was written, make room and try again")
        if isinstance(error, OSError) or code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN):
            is_refused = code == sqlite3.SQLITE_CANTOPEN or (isinstance(error, OSError) and error.errno in _REFUSALS)
            remedy = f"{_WRITABLE}, and start again" if is_refused else "open it again, which verifies it"
            translated = StoreFailed(self.path, f"{error}; {remedy}")
        elif code in damaged:
            translated = DamagedStore(self.path, None, None, str(error))
        else:
            hint = {
                sqlite3.SQLITE_BUSY: "try again",
                sqlite3.SQLITE_FULL: "make room and try again",
                sqlite3.SQLITE_READONLY: f"{_WRITABLE}, and try again",
            }
            return StoreFailed(self.path, f"{error}; nothing was written, {hint.get(code, 'it cannot be')}")
        self.failure = self.failure or translated
        return translated

    def chain(self, address: str) -> Chain:
        """The chain of an address, made within the running transaction if there is none.

        Raises:
            DamagedStore: the chain is damaged.
        """
        chain = self.contents.chains.get(address)
        if chain is None:
            chain = self.contents.chains[address] = create_chain(self.db, address, self.parts.cipher)
        elif chain.damage is not None:
            raise DamagedStore(*chain.damage.args)
        return chain

    @contextlib.contextmanager
    def view(self, address: str) -> Generator[tuple[Chain, array[int], list[int]] | None, None, None]:
        """Freeze the file, for the reading connection, at the very state that the memory describes now."""
        db = self.reader
        with self.lock:
            if self.log.rows:
                with self.transaction():
                    pass
            self.refresh()
            db.execute("BEGIN")
            (current,) = db.execute("SELECT epoch FROM store").fetchone()
            chain = self.contents.chains.get(address)
            view = None if chain is None else (chain, chain.positions[:], chain.kept[:])
        try:
            if current != self.claim.epoch:
                raise StaleEpoch(self.path, epoch=self.claim.epoch, current=current)
            if chain is not None and chain.damage is not None:
                raise DamagedStore(*chain.damage.args)
            yield view
        finally:
            db.execute("ROLLBACK")
