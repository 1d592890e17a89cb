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
from collections.abc import Generator
from typing import IO, Final, NamedTuple

import msgspec

from ..journal import NotCopied
from ..snapshot.snapshot_record import Meta
from ..sqlite.database import VERSION, result_code
from ..sqlite.open_store import INSERT
from ..sqlite.ownership import StoreRow, write_store_row
from ..sqlite.snapshot_files import for_us, no_link, sync, write_durably
from ..sqlite.store_parts import COPY_NOTE, NAME, NOTE, copy_notes, mark_of, part_names
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


def back_up_store(path: str | os.PathLike[str], dest: str | os.PathLike[str]) -> StoreCopy:
    """Copy a store as it is at one instant; a running system may have it open, and goes on meanwhile.

    All that was acknowledged before the call is in the copy, and of each append all or nothing. The copy is a store of
    its own, closed in good order, with an identity of its own: its parts and those of the origin are not mixed up.
    It is on the disk when this returns. It is not verified: `verify_store` does that.

    Args:
        path: the database of the store.
        dest: the database of the copy. Neither it nor anything of a store may be there; its folder must be.

    Raises:
        NotCopied: there is something at `dest`, or no room. DamagedStore, ForeignStore, StoreFailed: the store cannot
            be copied as a whole.
    """
    copy = _CopyUnderWay(os.path.realpath(path), os.path.abspath(dest))
    copy.refuse_dest()
    try:
        look(path, copy.write)
        return copy.put_in_place()
    except BaseException:
        copy.undo()
        raise


def restore_store(backup: str | os.PathLike[str], dest: str | os.PathLike[str]) -> StoreCopy:
    """Verify a backup, then copy it to where a system will open it; the backup stays as it is.

    Args:
        backup: the database of the backup.
        dest: the database to be made. Neither it nor anything of a store may be there; its folder must be.

    Raises:
        NotCopied: the backup is damaged, or as `back_up_store`. StoreFailed: there is no backup, or it cannot be read.
    """
    path = os.path.realpath(backup)
    _CopyUnderWay(path, os.path.abspath(dest)).refuse_dest()
    found = verify_store(backup)
    if not found.is_good:
        more = len(found.damages) + found.untold - 1
        problem = f"the backup is damaged: {found.damages[0]}" + (f" (and {more} more)" if more else "")
        raise NotCopied(path, os.fspath(dest), problem, "take another backup; `holdfast store verify` tells all of it")
    return back_up_store(backup, dest)


class _OpenFile(NamedTuple):
    file: IO[bytes]
    target: str


class _CopyUnderWay:
    def __init__(self, path: str, dest: str) -> None:
        self._path, self._dest = path, dest
        self._snapshots, self._packs = f"{dest}-snapshots", f"{dest}-packs"
        self._new = os.path.join(self._snapshots, f"new-{os.getpid()}-{threading.get_ident()}")
        self._identity = str(uuid.uuid4())
        self._made: list[str] = []  # folders
        self._account = StoreCopy(dest, self._identity, "", 0, 0, 0)

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

    def write(self, view: StoreView) -> None:
        """Copy all of a view, but do not put the database in place.

        Raises:
            Overtaken: the store has gone on before the files of its snapshots were opened.
        """
        self.undo()
        view.refuse_missing()
        with contextlib.ExitStack() as stack, self._writing():
            files = self._open_files(view, stack)
            self._make_folder(self._snapshots)
            if any(one.target.startswith(self._packs) for one in files):
                self._make_folder(self._packs)
            for source, target in files:
                folder = os.path.dirname(target)
                if folder not in self._made:
                    self._make_folder(folder, is_marked=False)
                with open(target, "xb", opener=for_us) as out:
                    shutil.copyfileobj(source, out, _PIECE)
                    out.flush()
                    os.fsync(out.fileno())
            self._copy_database(view)
            for folder in self._made:
                sync(folder)
            size = os.path.getsize(self._new) + sum(os.path.getsize(target) for _, target in files)
        origin = "" if view.identity is None else view.identity.id
        self._account = StoreCopy(self._dest, self._identity, origin, view.last, len(files), size)

    def _make_folder(self, folder: str, *, is_marked: bool = True) -> None:
        os.mkdir(folder, mode=0o700)
        self._made.append(folder)
        if is_marked:
            write_durably(os.path.join(folder, NAME), [mark_of(self._identity)])

    def _open_files(self, view: StoreView, stack: contextlib.ExitStack) -> list[_OpenFile]:
        """Open all files that the snapshots of the view consist of, and say where each belongs.

        One that is missing although the store still needs it is damaged in the copy as it is in the store.
        """
        found: dict[str, _OpenFile] = {}
        addresses = dict(view.db.execute("SELECT id, path FROM addresses WHERE path NOT NULL"))
        for number, address in view.db.execute("SELECT id, address FROM snapshots").fetchall():
            for source, target in self._needs(view, number, addresses.get(address)):
                if source in found:
                    continue
                try:
                    with contextlib.ExitStack() as one:
                        found[source] = _OpenFile(one.enter_context(open(source, "rb", opener=no_link)), target)
                        stack.push(one.pop_all())
                except FileNotFoundError:
                    if not view.is_kept(number):
                        raise Overtaken from None
        return list(found.values())

    def _needs(self, view: StoreView, number: int, address: str | None) -> list[tuple[str, str]]:
        """The files of a snapshot, and where they belong in the copy."""
        file, data = view.db.execute("SELECT file, data FROM snapshots WHERE id = ?", (number,)).fetchone()
        needs: list[tuple[str, str]] = []
        if file is not None:
            name = os.path.basename(str(file))
            needs.append((os.path.join(view.files.folder, name), os.path.join(self._snapshots, name)))
        if address is None or not view.packs.names(address):
            return needs
        try:
            meta = msgspec.msgpack.decode(data if file is None else view.files.read(str(file)), type=Meta)
        except FileNotFoundError:
            if not view.is_kept(number):
                raise Overtaken from None
            return needs
        except (msgspec.MsgspecError, OSError, ValueError, TypeError):
            return needs  # It is damaged, and will be in the copy.
        for pack in dict.fromkeys(pack for pack, _, _ in meta.blocks):
            source = view.packs.file(address, pack)
            needs.append((source, self._packs + source.removeprefix(view.packs.folder)))
        return needs

    def _copy_database(self, view: StoreView) -> None:
        """Copy the database and what is only in the log, and have it say that it was closed in good order."""
        os.close(os.open(self._new, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
        row = view.row
        origin = "" if view.identity is None else view.identity.id
        with contextlib.closing(sqlite3.connect(self._new, isolation_level=None)) as db:
            db.execute("PRAGMA synchronous = OFF")  # It is synced as a whole.
            view.db.backup(db)
            db.execute("BEGIN IMMEDIATE")
            db.executemany(INSERT, view.rows)
            # What there should be, not what there is: whoever opens it misses what is missing here.
            write_store_row(db, StoreRow(row.epoch, 0, "", view.last, row.live + view.last - row.floor))
            db.execute("DELETE FROM notes WHERE name IN (?, ?)", (NOTE, COPY_NOTE))
            db.executemany("INSERT INTO notes VALUES (NULL, ?, ?, ?)", copy_notes(self._identity, origin, time.time()))
            db.execute(f"PRAGMA user_version = {VERSION}")
            db.execute("COMMIT")
            (is_busy, left, _) = db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
            if is_busy or left:
                raise sqlite3.OperationalError(f"{left} pages of the copy stay in its WAL")
        sync(self._new)

    def put_in_place(self) -> StoreCopy:
        """Let the copy be a store."""
        with self._writing():
            os.link(self._new, self._dest)
            sync(os.path.dirname(self._dest))
            os.unlink(self._new)
            sync(self._snapshots)
        return self._account

    def undo(self) -> None:
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
