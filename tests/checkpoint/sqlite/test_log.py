"""The log in front of the database: what it takes is as safe as what the database has."""

from __future__ import annotations

import errno
import os
import random
import shutil
import sqlite3
import stat
import struct
import uuid
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from holdfast.checkpoint.journal import DamagedStore, StaleEpoch, StoreFailed
from holdfast.checkpoint.sqlite import SqliteJournal, append_log
from holdfast.checkpoint.sqlite.append_log import FrontLog
from holdfast.checkpoint.store_tools import verify_store
from tests.checkpoint.sqlite.stores import A, B, disown, edit, inputs, made, numbers, reopened


def rows(path: Path) -> int:
    """How many entries the database itself has."""
    with closing(sqlite3.connect(path)) as db:
        return int(db.execute("SELECT count(*) FROM entries").fetchone()[0])


def version(path: Path) -> int:
    with closing(sqlite3.connect(path)) as db:
        return int(db.execute("PRAGMA user_version").fetchone()[0])


def logs(path: Path) -> list[Path]:
    return made(f"{path}-log")


def left(journal: SqliteJournal, name: str = "left") -> Path:
    """The files as a kill would leave them now, elsewhere."""
    journal._store._wal.join()  # A kill leaves one instant: nothing may move from file to file while they are copied.
    folder = Path(journal.path).parent
    copy = folder.parent / f"{folder.name}-{name}"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    disown(copy / "app.db")
    return copy / "app.db"


@pytest.fixture
def killed(path: Path) -> Path:
    """Ten entries, seven of them in the log only: one by one, and two at a time."""
    with closing(SqliteJournal(path)) as journal:
        journal.append([*inputs(2), *inputs(1, B)])
        for start in range(2, 5):
            journal.append(inputs(1, start=start))
        journal.append([*inputs(1, start=5), *inputs(1, B, 1)])
        journal.append([*inputs(1, start=6), *inputs(1, B, 2)])
        assert rows(path) == 3
        return left(journal)


def both(path: Path) -> tuple[list[Any], list[Any]]:
    with closing(SqliteJournal(path)) as journal:
        return numbers(journal.load(A)), numbers(journal.load(B))


def test_few_entries_go_to_the_log_and_then_in_order_to_the_database(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1))
        for start in range(1, 11):
            journal.append(inputs(1, start=start))
        assert rows(path) == 1
        journal.append(inputs(400, start=11))
        assert rows(path) == 411
        journal.append(inputs(3, start=411))
        assert rows(path) == 411
        journal.append(inputs(1, B))  # Its address needs a row.
        journal.append([(A, ("in", 414, b"x" * 100_000))])
        assert rows(path) == 416
        for start in range(415, 415 + 2 * append_log.MOST_ROWS):
            journal.append(inputs(1, start=start))
        assert rows(path) >= 416 + append_log.MOST_ROWS
        (file,) = logs(path)
        assert file.stat().st_size < 100 * append_log.MOST_ROWS  # It is written over.
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
        assert numbers(journal.load(A)) == list(range(415 + 2 * append_log.MOST_ROWS))
        assert numbers(reopened(left(journal))) == list(range(415 + 2 * append_log.MOST_ROWS))
    assert logs(path) == []
    assert numbers(reopened(path)) == list(range(415 + 2 * append_log.MOST_ROWS))


def test_what_a_killed_owner_had_in_the_log_is_there(killed: Path) -> None:
    (before,) = logs(killed)
    with closing(SqliteJournal(killed)) as journal:
        assert rows(killed) == 10
        assert before not in logs(killed)
        assert numbers(journal.load(A)) == list(range(7))
        assert journal.append(inputs(1, start=7)) == [11]
    assert both(killed) == (list(range(8)), [0, 1, 2])


def test_an_owner_that_dies_while_it_takes_over_leaves_all_to_the_next(
    killed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also when the rows are in the database already, and the old log was not removed."""
    for broken in ("read", "remove"):
        with monkeypatch.context() as patch:
            patch.setattr(FrontLog, broken, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                SqliteJournal(killed)
    assert len(logs(killed)) == 2
    assert both(killed) == (list(range(7)), [0, 1, 2])


def damages(data: bytes) -> Iterator[bytes]:
    """A bit flipped in each byte behind the seal; cut off at each length."""
    for place in range(8, len(data)):
        yield data[:place] + bytes([data[place] ^ 1 << place % 8]) + data[place + 1 :]
    for length in range(len(data)):
        yield data[:length]


def test_each_byte_of_the_log_counts(killed: Path) -> None:
    (file,) = logs(killed)
    data = file.read_bytes()
    front = FrontLog(str(killed), is_used=True)
    front.identity = uuid.UUID(verify_store(killed).identity).bytes
    whole = list(front.read([str(file)]))
    assert [len(batch) for batch in whole] == [1, 1, 1, 2, 2]
    lengths = set()
    for damaged in damages(data):
        file.write_bytes(damaged)
        found = list(front.read([str(file)]))
        assert found == whole[: len(found)]
        lengths.add(len(found))
    assert lengths == {0, 1, 2, 3, 4}


def test_a_damaged_log_is_refused_and_without_the_mark_its_beginning_comes_back(killed: Path, tmp_path: Path) -> None:
    (file,) = logs(killed)
    found = set()
    for damaged in [*damages(file.read_bytes())][::31]:
        marked = left_again(killed, tmp_path, damaged)
        with pytest.raises(DamagedStore, match="were acknowledged"):
            SqliteJournal(marked)
        Path(f"{marked}-mark").unlink()
        a, b = both(marked)
        assert (a, b) == (list(range(len(a))), list(range(len(b))))
        assert (len(a), len(b)) in [(2, 1), (3, 1), (4, 1), (5, 1), (6, 2)], "half of an append is there"
        found.add(len(a))
    assert len(found) > 2


def left_again(killed: Path, tmp_path: Path, data: bytes) -> Path:
    copy = tmp_path / "again"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(killed.parent, copy)
    (file,) = logs(copy / "app.db")
    file.write_bytes(data)
    return copy / "app.db"


def test_a_log_that_is_gone_is_missed(killed: Path) -> None:
    (file,) = logs(killed)
    file.unlink()
    with pytest.raises(DamagedStore, match="were acknowledged"):
        SqliteJournal(killed)
    shutil.rmtree(file.parent)
    Path(f"{killed}-mark").unlink()  # Only the database and its WAL were copied.
    for _ in range(2):
        with pytest.raises(DamagedStore, match="its log is missing"):
            SqliteJournal(killed)
    file.parent.mkdir()
    assert both(killed) == ([0, 1], [0])


def test_logs_of_a_later_life_than_the_database_do_no_harm(path: Path) -> None:
    """Somebody has brought back an older copy of the database alone."""
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1))
        old = left(journal, "old")
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(300, start=1))
        journal.append(inputs(1, start=301))
        late = left(journal, "late")
    shutil.copy(logs(late)[0], f"{old}-log")
    with closing(SqliteJournal(old)) as journal:
        journal.append(inputs(1, start=1))
        assert len(logs(old)) == 1
        assert numbers(reopened(left(journal))) == [0, 1]


def test_after_a_power_loss_what_lies_behind_a_gap_is_cut(path: Path) -> None:
    """The database has lost what it had got from the log; the log has gone on since."""
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(2))
        journal.append(inputs(1, start=2))
        early = left(journal, "early")
        journal.note("key", b"value")  # What was in the log is in the database, and it begins again.
        journal.append(inputs(1, start=3))
        late = left(journal, "late")
    shutil.copy(logs(late)[0], logs(early)[0])
    copied = early.parent.with_name("copied") / "app.db"
    shutil.copytree(early.parent, copied.parent)
    shutil.copy(f"{late}-mark", f"{copied}-mark")
    with pytest.raises(DamagedStore, match="were acknowledged"):  # There was no power loss.
        SqliteJournal(copied)
    Path(f"{early}-mark").unlink()
    assert numbers(reopened(early)) == [0, 1]
    with closing(SqliteJournal(early)) as journal:
        for start in range(2, 6):
            journal.append(inputs(1, start=start))
        assert numbers(journal.load(A)) == list(range(6))


def test_what_was_promised_stays_in_the_log_until_the_database_is_synced(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1))
        early = left(journal, "early")
        journal.append(inputs(1, start=1))
        journal.sync()
        for round_ in range(2, 5):
            journal.note("key", b"value")  # It goes to the database, which is not synced.
            journal.append(inputs(1, start=round_))
        assert len(logs(path)) == 2
        # The power fails: of the database nothing is left since `early`.
        shutil.rmtree(f"{early}-log")
        shutil.copytree(f"{path}-log", f"{early}-log")
        Path(f"{early}-mark").unlink()
        assert numbers(reopened(early)) == [0, 1]
        for number in range(5, 30):
            journal.append(inputs(1, start=number))
            journal.sync()
            journal.note("key", b"%d" % number)
        assert len(logs(path)) <= 3  # They are used again.
        assert numbers(reopened(left(journal))) == list(range(30))


def test_a_store_that_may_have_a_log_is_none_for_those_who_know_of_no_log(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1))
        journal.append(inputs(1, start=1))
        assert version(path) == 2
        file = logs(path)[0]
        stale = file.read_bytes()
    assert version(path) == 1
    file.write_bytes(stale)  # It was killed before it had removed it.
    assert numbers(reopened(path)) == [0, 1]
    assert logs(path) == []


def test_a_log_of_another_store_is_not_taken_for_its_own(killed: Path, tmp_path: Path) -> None:
    """It has the same name, and goes on where the database ends."""
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / "app.db"
    with closing(SqliteJournal(other)) as journal:
        journal.append([*inputs(2), *inputs(1, B)])
        for _ in range(7):
            journal.append([(A, ("in", "another's"))])
        copy = shutil.copytree(other.parent, tmp_path / "left") / "app.db"
    (log,), (foreign,) = logs(killed), logs(copy)
    own = log.read_bytes()
    log.write_bytes(foreign.read_bytes())
    with pytest.raises(DamagedStore, match="were acknowledged"):
        SqliteJournal(killed)
    log.write_bytes(own)
    assert "another's" not in str(both(killed))


def test_a_log_of_before_that_is_bound_to_no_store_is_read(killed: Path) -> None:
    """As an older holdfast has left it, when it was killed."""
    (log,) = logs(killed)
    data = log.read_bytes()
    head = b"HFLOG\x01\0\0" + data[16:32]
    crc = zlib.crc32(head)
    parts, at = [data[:8], head, struct.pack("<I", crc)], 36
    while at + 8 <= len(data):
        _, length = struct.unpack_from("<II", data, at)
        body = data[at + 8 : at + 8 + length]
        if not length:
            break
        crc = zlib.crc32(body, crc)
        parts += [struct.pack("<II", crc, length), body]
        at += 8 + length
    log.write_bytes(b"".join(parts))
    assert both(killed) == ([0, 1, 2, 3, 4, 5, 6], [0, 1, 2])


def test_a_log_of_a_closed_store_is_not_read(killed: Path) -> None:
    """Whoever knows of no log may have written since."""
    edit(killed, "PRAGMA user_version = 1")
    Path(f"{killed}-mark").unlink()
    assert both(killed) == ([0, 1], [0])
    assert logs(killed) == []


def test_what_a_stale_owner_writes_is_refused_and_never_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The store has another owner, and that one dies before it has brought the log into the database."""
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(2))
        journal.append(inputs(1, start=2))
        disown(path)
        seal = FrontLog.read

        def die(front: FrontLog, names: list[str]) -> Any:
            list(seal(front, names))
            raise KeyboardInterrupt

        monkeypatch.setattr(FrontLog, "read", die)
        with pytest.raises(KeyboardInterrupt):
            SqliteJournal(path)
        monkeypatch.undo()
        for start in (10, 11):
            with pytest.raises(StaleEpoch) as caught:
                journal.append(inputs(1, start=start))
            assert (caught.value.path, caught.value.epoch, caught.value.current) == (str(path), 1, 2)
    assert numbers(reopened(path)) == [0, 1, 2]


def test_what_is_written_before_the_new_owner_looks_is_there(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(2))
        disown(path)
        read = FrontLog.read

        def late(front: FrontLog, names: list[str]) -> Any:
            journal.append(inputs(1, start=2))
            return read(front, names)

        monkeypatch.setattr(FrontLog, "read", late)
        assert numbers(reopened(path)) == [0, 1, 2]
        with pytest.raises(StaleEpoch):
            journal.append(inputs(1, start=3))
    monkeypatch.undo()
    assert numbers(reopened(path)) == [0, 1, 2]


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_without_room_in_the_log_nothing_is_acknowledged(
    store: SqliteJournal, path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    store.append(inputs(2))
    store.append(inputs(1, start=2))
    pwrite = os.pwrite

    def full(fd: int, data: bytes, at: int) -> int:
        if share == 1.0 or not share:
            raise OSError(errno.ENOSPC if not share else errno.EDQUOT, "no space left")
        return pwrite(fd, data[: int(len(data) * share)], at)

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(StoreFailed, match="make room"):
        store.append(inputs(1, start=3))
    monkeypatch.undo()
    assert not store.has_failed()
    assert numbers(reopened(left(store))) == [0, 1, 2]
    for start in (3, 4):
        assert store.append(inputs(1, start=start)) == [start + 1]
    assert numbers(reopened(left(store))) == [0, 1, 2, 3, 4]


def test_an_error_of_the_disk_ends_the_store(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(2))

        def broken(*_: object) -> int:
            raise OSError(errno.EIO, "the disk is gone")

        with monkeypatch.context() as patch:
            patch.setattr(os, "pwrite", broken)
            with pytest.raises(StoreFailed, match="the disk is gone"):
                journal.append(inputs(1, start=2))
        assert journal.has_failed()
        for refused in (lambda: journal.append(inputs(1)), journal.sync, lambda: journal.load(A)):
            with pytest.raises(StoreFailed, match="the disk is gone"):
                refused()
    assert numbers(reopened(path)) == [0, 1]


def test_the_log_goes_on_while_the_database_is_locked(store: SqliteJournal, path: Path) -> None:
    store.append(inputs(1))
    count = 1
    with closing(sqlite3.connect(path, isolation_level=None)) as rival:
        rival.execute("BEGIN IMMEDIATE")
        for count in range(1, append_log.MOST_ROWS + 1):
            store.append(inputs(1, start=count))
        count += 1
        for refused in (lambda: store.append(inputs(1, start=count)), lambda: store.load(A)) * 2:
            with pytest.raises(StoreFailed, match="try again"):
                refused()
        rival.execute("ROLLBACK")
    assert numbers(reopened(left(store))) == list(range(count))
    assert store.append(inputs(1, start=count)) == [count + 1]
    assert numbers(store.load(A)) == list(range(count + 1))


def test_a_transaction_that_is_broken_off_after_its_end_moves_nothing_twice(
    store: SqliteJournal, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.append(inputs(2))
    store.append(inputs(1, start=2))
    with monkeypatch.context() as patch:
        patch.setattr(FrontLog, "restart", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            store.note("key", b"value")
    assert store.noted("key") == b"value"
    store.sync()
    for start in (3, 4):
        store.append(inputs(1, start=start))
    assert numbers(store.load(A)) == [0, 1, 2, 3, 4]
    assert numbers(reopened(left(store))) == [0, 1, 2, 3, 4]


def test_an_append_that_is_broken_off_after_its_write_is_not_there_twice(
    store: SqliteJournal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log has it, and memory has not."""
    store.append(inputs(2))
    store.append(inputs(1, start=2))
    write = FrontLog.write

    def interrupted(front: FrontLog, rows: list[append_log.Row]) -> None:
        write(front, rows)
        del front.rows[-len(rows) :]
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(FrontLog, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            store.append(inputs(1, start=99))
    assert store.noted("key") is None
    for start in (3, 4):
        store.append(inputs(1, start=start))
    assert numbers(reopened(left(store))) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("seed", range(3))
def test_any_mixture_comes_back_in_order(path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(append_log, "MOST_ROWS", 9)
    draw = random.Random(seed)
    journal = SqliteJournal(path)
    count = 0
    for step in range(120):
        size = draw.choice([1, 1, 1, 2, 5, 50])
        journal.append(inputs(size, start=count))
        count += size
        match draw.randrange(12):
            case 0:
                journal.sync()
            case 1:
                journal.note("key", b"%d" % step)
            case 2:
                assert len(journal.load(A).entries) == count
            case 3 if step % 2:
                copy = left(journal, f"life{step}")
                journal.close()
                journal = SqliteJournal(copy)
    assert numbers(journal.load(A)) == list(range(count))
    journal.close()
