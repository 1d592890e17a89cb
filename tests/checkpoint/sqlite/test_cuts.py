"""What the store holds agrees with what was appended, cut and erased, whoever else is at work."""

from __future__ import annotations

import errno
import os
import random
import shutil
import sqlite3
import stat
import struct
import threading
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast.checkpoint.journal import DamagedStore, Entry, StoreFailed
from holdfast.checkpoint.sqlite import SqliteJournal, wal
from holdfast.checkpoint.sqlite.entry_chains import Chain
from holdfast.checkpoint.sqlite.ownership import StoreClaim
from tests.checkpoint.sqlite.stores import A, B, disown, edit, inputs, made, numbers, reopened


@pytest.mark.parametrize("size", [0, 1 << 20, (1 << 20) + 1, 5 << 20])
def test_a_snapshot_and_what_it_does_not_contain_survive(path: Path, size: int) -> None:
    snapshot = random.Random(size).randbytes(size)
    with closing(SqliteJournal(path)) as journal:
        positions = journal.append(inputs(5))
        journal.cut(A, snapshot, [positions[3], positions[0]], turn=7)
        assert numbers(journal.load(A)) == [1, 2, 4]
    saved = reopened(path)
    assert (saved.snapshot, saved.turn, numbers(saved)) == (snapshot, 7, [1, 2, 4])


def test_dropped_entries_are_removed_by_the_next_cut(path: Path) -> None:
    big = b"x" * (2 << 20)
    with closing(SqliteJournal(path)) as journal:
        for turn in range(1, 6):
            positions = journal.append(inputs(2, start=10 * turn))
            journal.cut(A, big, range(positions[0], positions[1] + 1), turn=turn)
            rows = sqlite3.connect(path)
            assert rows.execute("SELECT count(*) FROM entries").fetchone() == (2,)
            assert rows.execute("SELECT count(*) FROM snapshots").fetchone() == (min(turn, 2),)
            rows.close()
            assert len(made(f"{path}-snapshots")) == min(turn, 2)
        assert numbers(journal.load(A)) == []
        older = journal.load(A, older=True)
        assert (older.turn, numbers(older)) == (4, [50, 51])
    assert reopened(path).turn == 5


@pytest.mark.parametrize("keep", [1, 2, 3])
def test_a_cut_with_little_to_remove_is_one_transaction(path: Path, keep: int) -> None:
    statements: list[str] = []
    with closing(SqliteJournal(path)) as journal:
        journal._store.db.set_trace_callback(statements.append)
        for turn in range(1, 8):
            positions = [journal.append(inputs(1, start=start))[0] for start in range(5 * turn, 5 * turn + 5)]
            statements.clear()
            journal.cut(A, b"%d" % turn, positions[:4], turn=turn, keep=keep)
            assert statements.count("COMMIT") == 1
            rows = sqlite3.connect(path)
            assert rows.execute("SELECT count(*) FROM snapshots").fetchone() == (min(turn, keep),)
            removed = 4 * max(0, turn - keep + 1)  # What the oldest of them contains is gone.
            assert rows.execute("SELECT count(*) FROM entries").fetchone() == (5 * turn - removed,)
            rows.close()
        assert numbers(journal.load(A)) == list(range(9, 40, 5))
    assert numbers(reopened(path)) == list(range(9, 40, 5))


@pytest.mark.parametrize(
    "damage", ["UPDATE snapshots SET drops = x'00' WHERE turn = 1", "DELETE FROM entries WHERE position = 1"]
)
def test_what_a_cut_finds_damaged_when_it_cleans_up_is_told_and_its_snapshot_kept(path: Path, damage: str) -> None:
    with closing(SqliteJournal(path)) as journal:
        first = journal.append(inputs(3))
        journal.cut(A, b"1", first[:2], turn=1, keep=3)
        edit(path, damage)
        with pytest.raises(DamagedStore):
            journal.cut(A, b"2", [], turn=2)
        with closing(sqlite3.connect(path)) as db:
            assert db.execute("SELECT max(turn) FROM snapshots").fetchone() == (2,)


def test_many_interleaved_entries_are_dropped(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        mine = journal.append([(A if n % 3 else B, ("in", n)) for n in range(5000)])
        mine = [position for position, n in zip(mine, range(5000), strict=True) if n % 3]
        journal.cut(A, b"1", mine[:-1], turn=1)
        journal.cut(A, b"2", [], turn=2)
        assert [position for position, _ in journal.load(A).entries] == mine[-1:]
        assert len(journal.load(B).entries) == 1667
        assert journal._store.contents.live == 1668
    assert numbers(reopened(path)) == [4999]


def test_positions_that_the_address_has_not_are_ignored(store: SqliteJournal) -> None:
    store.append([*inputs(1, B), *inputs(1)])
    store.cut(A, b"1", range(1000), turn=1)
    store.cut(A, b"2", range(1000), turn=2)
    assert numbers(store.load(A)) == []
    assert numbers(store.load(B)) == [0]


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=25)
def test_the_store_agrees_with_a_naive_model(path: Path, data: st.DataObject) -> None:
    """Any sequence of appends, cuts, erases and reopenings loads as a dictionary of lists does."""
    shutil.rmtree(path.parent)
    path.parent.mkdir()
    journal = SqliteJournal(path)
    model: dict[str, tuple[bytes | None, int, dict[int, Entry]]] = {}
    try:
        for step in range(data.draw(st.integers(1, 12))):
            address = data.draw(st.sampled_from([A, B]))
            action = data.draw(st.sampled_from(["append", "append", "cut", "cut", "erase", "reopen", "kill"]))
            snapshot, turn, entries = model.get(address, (None, 0, {}))
            if action == "append":
                batch = inputs(data.draw(st.integers(1, 4)), address, 10 * step)
                entries |= dict(zip(journal.append(batch), [entry for _, entry in batch], strict=True))
                model[address] = snapshot, turn, entries
            elif action == "cut":
                drop = [position for position in entries if data.draw(st.booleans())]
                journal.cut(address, b"%d" % step, drop, turn=step)
                left = {position: entry for position, entry in entries.items() if position not in drop}
                model[address] = b"%d" % step, step, left
            elif action == "erase":
                journal.erase(address)
                model.pop(address, None)
            else:
                journal = abandon(journal) if action == "kill" else closed(journal)
            assert journal.addresses() == sorted(model)
            for known, (snapshot, turn, entries) in model.items():
                assert journal.load(known) == (snapshot, turn, list(entries.items()), "")
    finally:  # Hypothesis may give up within.
        journal.close()


def closed(journal: SqliteJournal) -> SqliteJournal:
    journal.close()
    return SqliteJournal(journal.path)


def abandon(journal: SqliteJournal) -> SqliteJournal:
    """Open a copy of the files as they are: what a kill would leave."""
    folder = Path(journal.path).parent
    copy = folder.parent / f"{folder.name}-copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    journal.close()
    shutil.rmtree(folder)
    shutil.copytree(copy, folder)
    disown(journal.path)
    return SqliteJournal(journal.path)


def test_an_address_that_is_erased_starts_afresh(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        first = journal.append(inputs(3))
        journal.cut(A, b"x" * (2 << 20), first[:1], turn=1)
        journal.erase(A)
        assert made(f"{path}-snapshots") == []
        assert journal.append(inputs(1, start=7))[0] > first[-1]
        assert journal.load(A)[:2] == (None, 0)
    assert numbers(reopened(path)) == [7]


def test_positions_are_not_used_again_after_everything_was_removed(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        last = journal.append(inputs(3))[-1]
        journal.erase(A)
    with closing(SqliteJournal(path)) as journal:
        assert journal.append(inputs(1))[0] > last


def test_a_cut_whose_file_cannot_be_written_changes_nothing(store: SqliteJournal, path: Path) -> None:
    positions = store.append(inputs(2))
    store.cut(A, b"1", positions[:1], turn=1)
    Path(f"{path}-snapshots", "1-1.snapshot.tmp").mkdir()
    with pytest.raises(StoreFailed, match="snapshot not written"):
        store.cut(A, b"x" * (2 << 20), positions, turn=2)
    assert (store.load(A).snapshot, numbers(store.load(A))) == (b"1", [1])
    store.append(inputs(1, start=5))  # The journal goes on.
    assert numbers(store.load(A)) == [1, 5]


def test_orphan_files_are_removed_at_the_opening(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.cut(A, b"x" * (2 << 20), [], turn=1)
    folder = Path(f"{path}-snapshots")
    for name in ("1-99.snapshot", "1-98.snapshot.tmp", "new-1-1"):
        (folder / name).write_bytes(b"x")
    assert reopened(path).turn == 1
    assert made(folder) == [folder / "1-1.snapshot"]


def test_files_are_for_the_owner_only(store: SqliteJournal, path: Path) -> None:
    store.cut(A, b"x" * (2 << 20), [], turn=1)
    files = [*path.parent.glob("app.db*"), *Path(f"{path}-snapshots").iterdir()]
    assert {stat.S_IMODE(file.stat().st_mode) & 0o077 for file in files} == {0}


def test_a_missing_folder_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(StoreFailed):
        SqliteJournal(tmp_path / "no" / "app.db")
    assert os.listdir(tmp_path) == []


def test_appends_go_on_while_other_threads_cut_and_load(store: SqliteJournal) -> None:
    positions = store.append(inputs(3000, B))
    errors: list[BaseException] = []

    def cut_and_load() -> None:
        try:
            for turn in range(1, 4):
                store.cut(B, b"x" * (3 << 20), positions[: 1000 * turn], turn=turn)
                assert len(store.load(B).entries) == 3000 - 1000 * turn
        except BaseException as error:  # shown by the main thread
            errors.append(error)

    thread = threading.Thread(target=cut_and_load)
    thread.start()
    count = 0
    while thread.is_alive():
        store.append(inputs(1, start=count))
        count += 1
    thread.join()
    assert errors == []
    assert numbers(store.load(A)) == list(range(count))


def test_the_wal_is_brought_into_the_database_meanwhile(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wal, "LEAST_BYTES", 1 << 16)
    monkeypatch.setattr(wal, "MOST_BYTES", 64 * 4096)
    with closing(SqliteJournal(path)) as journal:
        sizes, count = [-1, 0], 0
        while sizes[-1] != sizes[-2]:  # The file does not shrink, but once it is written over it does not grow either.
            assert count < 40_000, f"the WAL only grows: {sizes}"
            for number in range(count, count + 500):
                journal.append(inputs(1, start=number))
            count += 500
            journal._store._wal.join()  # On a slow disk each round would end on another size.
            sizes.append(os.path.getsize(f"{path}-wal"))
    assert numbers(reopened(path)) == list(range(count))


def wal_number(path: Path) -> int:
    """How often the WAL was begun anew, which its header counts."""
    with open(f"{path}-wal", "rb") as wal:
        return int.from_bytes(wal.read(16)[12:], "big")


def test_a_wal_that_has_grown_long_begins_anew_although_writers_never_rest(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wal, "LEAST_BYTES", 1 << 16)
    monkeypatch.setattr(wal, "MOST_BYTES", 64 * 4096)

    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1))
        first, count = wal_number(path), 1
        while wal_number(path) < first + 3:
            assert count < 40_000, "the WAL only grows"
            for number in range(count, count + 100):
                journal.append(inputs(1, start=number))
            count += 100
    assert numbers(reopened(path)) == list(range(count))


def test_a_checkpoint_that_leaves_a_long_wal_is_done_again_while_no_writer_goes_on(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody reads an old state during the first attempt, and has gone when the writers are held up."""
    monkeypatch.setattr(wal, "LEAST_BYTES", 1 << 19)
    monkeypatch.setattr(wal, "MOST_BYTES", 64 * 4096)
    with (
        closing(SqliteJournal(path)) as journal,
        closing(sqlite3.connect(path, isolation_level=None, check_same_thread=False)) as reader,
    ):
        lock, checkpoints = journal._store.lock, list[str]()

        class Held:
            def __enter__(self) -> None:
                lock.acquire()
                if threading.current_thread().name == "holdfast-store":
                    reader.execute("ROLLBACK")
                    checkpoints.append("again")

            def __exit__(self, *_: object) -> None:
                lock.release()

        journal.append(inputs(1))
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM sqlite_master").fetchall()
        monkeypatch.setattr(journal._store._wal, "_writers", Held())
        count = 1
        while os.path.getsize(f"{path}-wal") <= 1 << 19:
            journal.append(inputs(100, start=count))
            count += 100
        journal._store._wal.join()
        assert checkpoints == ["again"]
        with open(f"{path}-shm", "rb") as index:
            words = struct.unpack("=25I", index.read(100))
        assert words[24] == words[4] > 64, "all frames are in the database: the WAL begins anew with the next one"
    assert numbers(reopened(path)) == list(range(count))


def test_a_broken_off_transaction_leaves_no_trace(store: SqliteJournal, monkeypatch: pytest.MonkeyPatch) -> None:
    positions = store.append(inputs(2))
    for interrupted in (Chain, StoreClaim):
        with monkeypatch.context() as patch:
            patch.setattr(interrupted, "write", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                store.cut(A, b"1", positions, turn=1)
            if interrupted is Chain:
                with pytest.raises(KeyboardInterrupt):
                    store.append([*inputs(1), *inputs(1, "/new")])
        assert store.load(A) == (None, 0, list(zip(positions, [("in", 0), ("in", 1)], strict=True)), "")
    assert store.append(inputs(1, "/new"))[0] == positions[-1] + 1
    assert store.addresses() == [A, "/new"]


def test_a_foreign_lock_is_named_and_passes(store: SqliteJournal, path: Path) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as rival:
        rival.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreFailed, match="try again"):
            store.append(inputs(1))
        rival.execute("ROLLBACK")
    assert store.append(inputs(1)) == [1]


@pytest.mark.parametrize("what", ["cut", "forget_blocks", "erase"])
def test_a_failed_sync_of_the_rows_before_files_are_removed_stops_the_store(
    path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the WAL has on the disk is unknown then, and so is what was appended before (T13)."""
    large = b"x" * (2 << 20)
    with closing(SqliteJournal(path)) as journal:
        journal.cut("/a", large, [], turn=1, keep=1)
        journal.keep_blocks("/a", 1, [(0, memoryview(b"block"))], False)
        fsync = os.fsync

        def fail(fd: int) -> None:
            if os.readlink(f"/proc/self/fd/{fd}").endswith("-wal"):
                raise OSError(errno.EIO, "the disk is gone")
            fsync(fd)

        monkeypatch.setattr(os, "fsync", fail)
        calls = {
            "cut": lambda: journal.cut("/a", large, [], turn=2, keep=1),
            "erase": lambda: journal.erase("/a"),
            "forget_blocks": lambda: journal.forget_blocks("/a", [1]),
        }
        with pytest.raises(StoreFailed, match="the disk is gone"):
            calls[what]()
        assert journal.has_failed()
        for refused in (lambda: journal.append([("/a", ("in", 1))]), journal.sync):
            with pytest.raises(StoreFailed, match="the disk is gone"):
                refused()
        monkeypatch.undo()
    if what != "erase":
        with closing(SqliteJournal(path)) as journal:
            assert journal.load("/a").snapshot == large
            journal.read_blocks("/a", 1, [(0, 5)]).close()


def test_what_was_erased_is_on_the_disk_before_its_blocks_are_gone(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.cut("/a", b"names the blocks", [], turn=1)
        journal.keep_blocks("/a", 1, [(0, memoryview(b"block"))], False)
        there: list[bool] = []
        fsync = os.fsync

        def note(fd: int) -> None:
            if os.readlink(f"/proc/self/fd/{fd}").endswith("-wal"):
                there.append(any(Path(f"{path}-packs").rglob("*.pack")))
            fsync(fd)

        monkeypatch.setattr(os, "fsync", note)
        journal.erase("/a")
        assert there == [True]
        assert not any(Path(f"{path}-packs").rglob("*.pack"))
