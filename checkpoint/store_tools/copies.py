"""Copies of stores: online, of one instant, with an identity of their own, and never seen half made.

The files of the view are opened before anything is copied, so that those which the running system removes meanwhile are
still read. The copy's database lies in its folder of snapshots and is linked into place last: a copy that was broken
off has no database, and is refused as a store.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import sqlite3
import threading
import time
import uuid
from collections.abc import Callable, Generator, Iterator
from functools import partial
from typing import IO, Final, NamedTuple

import msgspec

from ..journal import NotCopied
from ..snapshot.snapshot_record import Meta
from ..sqlite.block_packs import Packs
from ..sqlite.entry_chains import CHAINS, Chain
from ..sqlite.open_store import INSERT
from ..sqlite.ownership import StoreRow, write_store_row
from ..sqlite.sealing import Bytes, format_of, snapshot_place
from ..sqlite.snapshot_files import SnapshotFiles, for_us, no_link, sync, write_durably
from ..sqlite.store_parts import COPY_NOTE, NAME, NOTE, Parts, copy_notes, mark_of, new_cipher, part_names, result_code
from ..store_key import StoreKey, read_store_key
from .resealing import Resealing
from .store_view import Overtaken, StoreView, look
from .verification import verify_store

_PIECE: Final = 1 << 20


@dataclasses.dataclass(frozen=True, slots=True)
class StoreCopy:
    """The account of a copy that was made.

    Attributes:
        path: of the copy.
        identity: of the copy.
        origin: the identity of the store that was copied; "" if it has none.
        last: the newest position in it.
        files: how many files of snapshots lie beside the database.
        size: in bytes, of all of it.
    """

    path: str
    identity: str
    origin: str
    last: int
    files: int
    size: int


def back_up_store(
    path: str | os.PathLike[str], dest: str | os.PathLike[str], *, key: StoreKey | None = None
) -> StoreCopy:
    """Copy a store as it is at one instant; a running system may have it open, and goes on meanwhile.

    All that was acknowledged before the call is in the copy, and of each append all or nothing. The copy is a store of
    its own, closed in good order, with an identity of its own: its parts and those of the origin are not mixed up.
    It is on the disk when this returns. It is not verified: `verify_store` does that.

    Args:
        path: the database of the store.
        dest: the database of the copy. Neither it nor anything of a store may be there; its folder must be.
        key: of the store, if it is encrypted: the copy is so, too, with the same key.

    Raises:
        NotCopied: there is something at `dest`, or no room. DamagedStore, ForeignStore, StoreFailed: the store cannot
            be copied as a whole. WrongStoreKey: the key is not its own.
    """
    secret = read_store_key(key)
    return _CopyUnderWay(path, dest, secret, secret).make()


def restore_store(
    backup: str | os.PathLike[str], dest: str | os.PathLike[str], *, key: StoreKey | None = None
) -> StoreCopy:
    """Verify a backup, then copy it to where a system will open it; the backup stays as it is.

    Args:
        backup: the database of the backup.
        dest: the database to be made. Neither it nor anything of a store may be there; its folder must be.
        key: of the backup, if it is encrypted: what is made is so, too, with the same key.

    Raises:
        NotCopied: the backup is damaged, or as `back_up_store`. StoreFailed: there is no backup, or it cannot be read.
            WrongStoreKey: the key is not its own.
    """
    secret = read_store_key(key)
    copy = _CopyUnderWay(backup, dest, secret, secret)
    copy.refuse_dest()
    copy.refuse_damaged("the backup", "take another backup; `holdfast store verify` tells all of it")
    return copy.make()


def rekey_store(
    path: str | os.PathLike[str],
    dest: str | os.PathLike[str],
    *,
    key: StoreKey | None = None,
    new_key: StoreKey | None = None,
) -> StoreCopy:
    """Verify a store, and make a copy of it with another key; the store stays as it is.

    Args:
        path: the database of the store, which no system may have open: what it goes on to write would be missing.
        dest: the database of the copy. Neither it nor anything of a store may be there; its folder must be.
        key: of the store, if it is encrypted.
        new_key: of the copy; without one it is in plain text.

    Raises:
        NotCopied: the store is open or damaged, or as `back_up_store`. StoreFailed: there is no store, or it cannot be
            read. WrongStoreKey: the key is not its own.
    """
    copy = _CopyUnderWay(path, dest, read_store_key(key), read_store_key(new_key))
    copy.refuse_dest()
    copy.refuse_damaged("the store", "restore a backup; `holdfast store verify` tells all of it", may_be_open=False)
    return copy.make()


class _Need(NamedTuple):
    """A file of a snapshot: where it is, where it belongs in the copy, and its bytes there under another cipher."""

    source: str
    target: str
    reseal: Callable[[IO[bytes]], Iterator[Bytes]]


class _CopyUnderWay:
    def __init__(
        self,
        path: str | os.PathLike[str],
        dest: str | os.PathLike[str],
        key: bytes | None,
        new_key: bytes | None,
    ) -> None:
        self._path, self._key = os.path.realpath(path), key
        self._dest = dest = os.path.abspath(dest)
        self._is_sealed = key is not None or new_key is not None  # then nothing is copied as it is
        self._snapshots, self._packs = f"{dest}-snapshots", f"{dest}-packs"
        self._new = os.path.join(self._snapshots, f"new-{os.getpid()}-{threading.get_ident()}")
        self._identity = str(uuid.uuid4())
        self._parts = Parts(dest, new_key)
        self._parts.cipher = new_cipher(new_key, self._identity)
        self._files = SnapshotFiles(dest, self._parts)
        self._made: list[str] = []  # folders
        self._account = StoreCopy(dest, self._identity, "", 0, 0, 0)

    def make(self) -> StoreCopy:
        """Make the copy, and return an account of it."""
        self.refuse_dest()
        try:
            look(self._path, self._write, self._key)
            return self._put_in_place()
        except BaseException:
            self._undo()
            raise

    def refuse_damaged(self, what: str, remedy: str, *, may_be_open: bool = True) -> None:
        """Raise NotCopied if anything in the store is damaged, or (not `may_be_open`) a system has it open."""
        found = verify_store(self._path, key=self._key)
        if found.pid and not may_be_open:
            raise self._refused(f"process {found.pid} has it open, and goes on writing", "stop that first")
        if not found.is_good:
            more = len(found.damages) + found.untold - 1
            problem = f"{what} is damaged: {found.damages[0]}" + (f" (and {more} more)" if more else "")
            raise self._refused(problem, remedy)

    def refuse_dest(self) -> None:
        """Raise NotCopied if there is anything in the way."""
        there = [name for name in part_names(self._dest) if os.path.lexists(name)]
        if there:
            names = ", ".join(map(os.path.basename, there))
            raise self._refused(
                f"{names} is there already, and nothing is overwritten",
                "name another one; or, if a copy was ended in its middle and there is no database, remove what it left",
            )
        folder = os.path.dirname(self._dest)
        if not os.path.isdir(folder):
            raise self._refused(f"the folder {folder} is not there", "make it first")
        inside = os.path.realpath(folder)
        for part in part_names(self._path)[1:]:
            if inside == part or inside.startswith(f"{part}{os.sep}"):
                raise self._refused(f"{folder} is a folder of the store itself", "name a place outside of it")

    def _write(self, view: StoreView) -> None:
        """Copy all of a view, but do not put the database in place.

        Raises:
            Overtaken: the store has gone on before the files of its snapshots were opened.
        """
        self._undo()
        view.refuse_missing()
        with contextlib.ExitStack() as stack, self._writing():
            files = self._open_files(view, stack)
            self._make_folder(self._snapshots)
            if any(need.target.startswith(self._packs) for need, _ in files):
                self._make_folder(self._packs)
            for need, source in files:
                folder = os.path.dirname(need.target)
                if folder not in self._made:
                    self._make_folder(folder, is_marked=False)
                with open(need.target, "xb", opener=for_us) as out:
                    if self._is_sealed:
                        out.writelines(need.reseal(source))
                    else:
                        shutil.copyfileobj(source, out, _PIECE)
                    out.flush()
                    os.fsync(out.fileno())
            self._copy_database(view)
            for folder in self._made:
                sync(folder)
            size = os.path.getsize(self._new) + sum(os.path.getsize(need.target) for need, _ in files)
        origin = "" if view.identity is None else view.identity.id
        self._account = StoreCopy(self._dest, self._identity, origin, view.last, len(files), size)

    def _make_folder(self, folder: str, *, is_marked: bool = True) -> None:
        os.mkdir(folder, mode=0o700)
        self._made.append(folder)
        if is_marked:
            write_durably(os.path.join(folder, NAME), [mark_of(self._identity)])

    def _open_files(self, view: StoreView, stack: contextlib.ExitStack) -> list[tuple[_Need, IO[bytes]]]:
        """Open all files that the snapshots of the view consist of, and say where each belongs.

        One that is missing although the store still needs it is damaged in the copy as it is in the store.
        """
        found: dict[str, tuple[_Need, IO[bytes]]] = {}
        chains = {}
        for row in view.db.execute(CHAINS):
            with contextlib.suppress(ValueError):  # Then it is damaged in the copy, too.
                chains[row[0]] = Chain.read(row, view.parts.cipher)
        for number, address in view.db.execute("SELECT id, address FROM snapshots").fetchall():
            for need in self._needs(view, number, chains.get(address)):
                if need.source in found:
                    continue
                try:
                    with contextlib.ExitStack() as one:
                        found[need.source] = need, one.enter_context(open(need.source, "rb", opener=no_link))
                        stack.push(one.pop_all())
                except FileNotFoundError:
                    if not view.is_kept(number):
                        raise Overtaken from None
        return list(found.values())

    def _needs(self, view: StoreView, number: int, chain: Chain | None) -> list[_Need]:
        """The files of a snapshot."""
        file, data = view.db.execute("SELECT file, data FROM snapshots WHERE id = ?", (number,)).fetchone()
        needs: list[_Need] = []
        if file is not None:
            name = os.path.basename(str(file))
            reseal = partial(self._files.copied, view.files, name)
            needs.append(_Need(os.path.join(view.files.folder, name), os.path.join(self._snapshots, name), reseal))
        if chain is None or chain.path is None or not view.packs.names(chain.path):
            return needs
        try:
            data = (
                view.files.read(str(file))
                if file is not None
                else view.parts.cipher.unseal(snapshot_place(number), data)
            )
            meta = msgspec.msgpack.decode(data, type=Meta)
        except FileNotFoundError:
            if not view.is_kept(number):
                raise Overtaken from None
            return needs
        except (msgspec.MsgspecError, OSError, ValueError, TypeError):
            return needs  # It is damaged, and will be in the copy.
        for pack in dict.fromkeys(pack for pack, _, _ in meta.blocks):
            packs = Packs(self._dest, self._parts)
            reseal = partial(packs.copied, view.packs, chain.path, pack)
            needs.append(_Need(view.packs.file(chain.path, pack), packs.file(chain.path, pack), reseal))
        return needs

    def _copy_database(self, view: StoreView) -> None:
        """Copy the database and what is only in the log, and have it say that it was closed in good order."""
        os.close(os.open(self._new, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
        row, cipher = view.row, self._parts.cipher
        origin = "" if view.identity is None else view.identity.id
        with contextlib.closing(sqlite3.connect(self._new, isolation_level=None)) as db:
            db.execute("PRAGMA synchronous = OFF")  # It is synced as a whole.
            if self._is_sealed:
                Resealing(view, cipher, self._files).write(db)
                db.execute("BEGIN IMMEDIATE")
            else:
                view.db.backup(db)
                db.execute("BEGIN IMMEDIATE")
                db.executemany(INSERT, view.rows)
                db.execute("DELETE FROM notes WHERE name IN (?, ?)", (NOTE, COPY_NOTE))
            # What there should be, not what there is: whoever opens it misses what is missing here.
            closed = StoreRow(row.epoch, 0, "", view.last, row.live + view.last - row.floor)
            write_store_row(db, closed, cipher.digest_key)
            notes = copy_notes(self._identity, origin, time.time(), cipher)
            db.executemany("INSERT INTO notes VALUES (NULL, ?, ?, ?)", notes)
            db.execute(f"PRAGMA user_version = {format_of(cipher, may_have_log=False)}")
            db.execute("COMMIT")
            (is_busy, left, _) = db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
            if is_busy or left:
                raise sqlite3.OperationalError(f"{left} pages of the copy stay in its WAL")
        sync(self._new)

    def _put_in_place(self) -> StoreCopy:
        """Let the copy be a store."""
        with self._writing():
            os.link(self._new, self._dest)
            sync(os.path.dirname(self._dest))
            os.unlink(self._new)
            sync(self._snapshots)
        return self._account

    def _undo(self) -> None:
        """Remove what was made, unless it is a whole store by now."""
        if not os.path.lexists(self._dest):
            for folder in self._made:
                shutil.rmtree(folder, ignore_errors=True)
        self._made.clear()

    @contextlib.contextmanager
    def _writing(self) -> Generator[None, None, None]:
        try:
            yield
        except FileExistsError as error:
            problem = f"{error.filename2 or error.filename} was made by somebody else"
            raise self._refused(problem, "name another one") from error
        except OSError as error:
            raise self._refused(str(error), "make room, or raise the limit, and try again") from error
        except sqlite3.Error as error:
            if result_code(error) in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
                raise  # That is the origin.
            raise self._refused(str(error), "make room, and try again") from error

    def _refused(self, problem: str, remedy: str) -> NotCopied:
        return NotCopied(self._path, self._dest, problem, remedy)
