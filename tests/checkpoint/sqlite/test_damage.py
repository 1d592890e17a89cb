"""Damage is found and named: nothing is made up, and the undamaged can be read."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import (
    DamagedStore,
    ForeignStore,
    Saved,
    StoreFailed,
)
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.store_tools.verification import verify_store
from tests.checkpoint.sqlite.stores import A, B, edit, end, flip, inputs, line, made, numbers, reopened, spawn


@pytest.fixture
def filled(path: Path) -> Path:
    """A closed store: two snapshots of A (one inline, one a file), three live entries; entries and a snapshot of B."""
    with closing(SqliteJournal(path)) as journal:
        positions = journal.append([*inputs(4), *inputs(4, B)])
        journal.cut(A, b"older", positions[:2], turn=2)
        positions += journal.append(inputs(2, start=4))
        journal.cut(A, b"newer" * 400_000, positions[:4], turn=4)
        journal.append([*inputs(1, start=6), *inputs(2, B, 4)])
        journal.cut(B, b"bob", [], turn=1)
        journal.note("key", b"value")
    return path


def contents(path: Path) -> tuple[Saved, Saved, bytes | None]:
    with closing(SqliteJournal(path)) as journal:
        return journal.load(A), journal.load(B), journal.noted("key")


def test_a_flipped_bit_in_an_entry_is_found(filled: Path) -> None:
    edit(filled, "UPDATE entries SET data = CAST(data || 'x' AS BLOB) WHERE position = 6")
    with closing(SqliteJournal(filled)) as journal:
        assert numbers(journal.load(A)) == [4, 5, 6]  # The others work.
        with pytest.raises(DamagedStore) as caught:
            journal.load(B)
        assert caught.value.args[:3] == (str(filled), B, 6)
        journal.erase(B)
    assert numbers(contents(filled)[1]) == []


def test_each_bit_of_an_entry_counts(filled: Path) -> None:
    """Also where another value would be read: 5 for 4."""
    with closing(sqlite3.connect(filled)) as db:
        ((data,),) = db.execute("SELECT data FROM entries WHERE position = 6")
    for bit in range(8 * len(data)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        edit(filled, f"UPDATE entries SET data = x'{changed.hex()}' WHERE position = 6")
        with closing(SqliteJournal(filled)) as journal, pytest.raises(DamagedStore):
            journal.load(B)


def test_no_entry_goes_unmissed_not_even_the_last(filled: Path) -> None:
    intact = filled.read_bytes()
    with closing(sqlite3.connect(filled)) as db:
        positions = [position for (position,) in db.execute("SELECT position FROM entries")]
    assert len(positions) == 11
    for position in positions:
        filled.write_bytes(intact)
        edit(filled, f"DELETE FROM entries WHERE position = {position}")
        with pytest.raises(DamagedStore):
            contents(filled)


def test_a_hole_in_the_middle_is_located_and_leaves_others_alone(filled: Path) -> None:
    edit(filled, "DELETE FROM entries WHERE position = 6")
    with closing(SqliteJournal(filled)) as journal:
        assert numbers(journal.load(A)) == [4, 5, 6]
        for attempt in (
            lambda: journal.load(B),
            lambda: journal.append(inputs(1, B)),
            lambda: journal.cut(B, b"", [], turn=9),
        ):
            with pytest.raises(DamagedStore) as caught:
                attempt()
            assert caught.value.args[:3] == (str(filled), B, 7)
        journal.erase(B)
        journal.append(inputs(1, B))
    assert numbers(contents(filled)[1]) == [0]


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM entries WHERE address = 2",
        "UPDATE entries SET chain = chain + 1 WHERE position = 6",
        "UPDATE entries SET chain = NULL WHERE position = 6",
        "UPDATE entries SET address = 1 WHERE position = 6",
        "UPDATE entries SET address = 77 WHERE position = 6",
        "UPDATE entries SET position = 600 WHERE position = 6",
        "UPDATE entries SET kind = 'out' WHERE position = 6",
        "UPDATE entries SET crc = crc + 1 WHERE position = 6",
        "UPDATE entries SET data = NULL WHERE position = 6",
        "UPDATE entries SET data = CAST(x'ff' AS TEXT) WHERE position = 6",
        "UPDATE addresses SET path = '/c' WHERE id = 2",
        "UPDATE addresses SET removed = removed + 1 WHERE id = 2",
        "UPDATE addresses SET kept = '' WHERE id = 2",
        "DELETE FROM addresses WHERE id = 2",
        "UPDATE snapshots SET turn = 2 WHERE data = CAST('bob' AS BLOB)",
        "UPDATE snapshots SET data = CAST('rob' AS BLOB) WHERE data = CAST('bob' AS BLOB)",
        "DELETE FROM snapshots WHERE data = CAST('bob' AS BLOB)",
        "UPDATE notes SET value = CAST('values' AS BLOB)",
        "UPDATE notes SET name = 'other' WHERE key = (SELECT max(key) FROM notes)",
        "UPDATE store SET epoch = 0",
        "UPDATE store SET live = live + 1",
        "DELETE FROM store",
        "PRAGMA user_version = 3",
        "PRAGMA application_id = 2",
        "ALTER TABLE entries ADD COLUMN more",
    ],
)
def test_damaged_rows_are_refused(filled: Path, statement: str) -> None:
    edit(filled, statement)
    with pytest.raises(DamagedStore):
        contents(filled)


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove", "row"])
def test_a_damaged_snapshot_gives_way_to_the_older_one_with_all_entries_since(filled: Path, damage: str) -> None:
    (file,) = made(f"{filled}-snapshots")
    if damage == "flip":
        flip(file, 8_000_001)
    elif damage == "truncate":
        os.truncate(file, 1000)
    elif damage == "remove":
        file.unlink()
    else:
        edit(filled, "DELETE FROM snapshots WHERE turn = 4")
    saved = contents(filled)[0]
    assert (saved.snapshot, saved.turn, numbers(saved)) == (b"older", 2, [2, 3, 4, 5, 6])
    assert "snapshot" in saved.passed_over


def test_a_snapshot_whose_list_of_contents_is_damaged_is_not_used(filled: Path) -> None:
    """Nor is the last one there is: what it contains would be handled again."""
    edit(filled, "UPDATE snapshots SET drops = x'00' WHERE turn = 4")
    assert contents(filled)[0].snapshot == b"older"
    edit(filled, "UPDATE snapshots SET drops = x'00'")
    with pytest.raises(DamagedStore, match="no snapshot is left: the drop list"):
        contents(filled)


def test_without_a_usable_snapshot_nothing_is_made_up(filled: Path) -> None:
    (file,) = made(f"{filled}-snapshots")
    file.unlink()
    edit(filled, "UPDATE snapshots SET data = CAST('oldest' AS BLOB) WHERE turn = 2")
    with closing(SqliteJournal(filled)) as journal:
        with pytest.raises(DamagedStore, match="no snapshot is left") as caught:
            journal.load(A)
        assert caught.value.address == A
        assert journal.load(B).snapshot == b"bob"


@pytest.mark.parametrize("size", [0, 50, 1000, 4096, 8192, 16384])
def test_a_truncated_file_is_refused(filled: Path, size: int) -> None:
    os.truncate(filled, size)
    with pytest.raises(DamagedStore):
        contents(filled)


def everything(folder: Path) -> dict[str, bytes]:
    """What lies in a folder."""
    return {file.name: file.read_bytes() for file in folder.iterdir()}


@pytest.mark.parametrize("what", ["database", "open database", "text", "short text"])
async def test_another_file_is_refused_and_left_alone(path: Path, what: str) -> None:
    with contextlib.ExitStack() as stack:
        if what == "open database":
            db = stack.enter_context(closing(sqlite3.connect(path)))
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("CREATE TABLE mine(x)")
            db.execute("BEGIN IMMEDIATE")
        elif what == "database":
            edit(path, "CREATE TABLE mine(x)")
        else:
            path.write_text("some text " * (1000 if what == "text" else 1))
        before = everything(path.parent)
        with pytest.raises(ForeignStore, match=r"this is not a holdfast store, but .*; give the store another path"):
            async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False):
                raise AssertionError("it has begun")
        with pytest.raises(ForeignStore, match="not a holdfast store"):
            verify_store(path)
        assert everything(path.parent) == before


def test_an_empty_file_is_refused_and_left_alone(path: Path) -> None:
    path.touch()
    with pytest.raises(DamagedStore, match="the file is empty"):
        SqliteJournal(path)
    assert everything(path.parent) == {path.name: b""}


def test_a_store_of_which_the_header_is_damaged_is_no_other_file(filled: Path) -> None:
    """Its folders lie beside it."""
    edit(filled, "PRAGMA application_id = 7")
    with pytest.raises(DamagedStore, match="not a holdfast store"):
        SqliteJournal(filled)


def killed(path: Path) -> bytes:
    """Let a child append one entry and kill it, so that the WAL stays; return the WAL."""
    child = spawn(path, "hold")
    assert (line(child), line(child)) == (b"open 1\n", b"held\n")
    end(child)
    return Path(f"{path}-wal").read_bytes()


def test_a_wal_that_lost_acknowledged_entries_is_refused(path: Path) -> None:
    """SQLite itself takes a flipped bit in the WAL for its end, and a missing WAL for an empty one."""
    wal = killed(path)
    flip(Path(f"{path}-wal"), 8 * len(wal) - 1000)
    with pytest.raises(DamagedStore, match="were acknowledged"):
        SqliteJournal(path)
    with pytest.raises(DamagedStore):  # It is refused again, until somebody decides.
        SqliteJournal(path)
    os.unlink(f"{path}-mark")
    assert numbers(reopened(path)) == []


def test_a_wal_without_its_database_is_refused(path: Path) -> None:
    killed(path)
    path.unlink()
    with pytest.raises(ForeignStore, match="-wal"):
        SqliteJournal(path)


def test_after_a_power_loss_a_torn_tail_is_cut(path: Path) -> None:
    wal = killed(path)
    flip(Path(f"{path}-wal"), 8 * len(wal) - 1000)
    mark = Path(f"{path}-mark")
    mark.write_bytes(mark.read_bytes()[:9] + b"another boot".ljust(36))
    assert numbers(reopened(path)) == []


@pytest.mark.parametrize("seed", range(4))
def test_no_flipped_bit_changes_what_is_read(filled: Path, tmp_path: Path, seed: int) -> None:
    """Flip random bits of the database: it is read as before, or refused, or an older snapshot says why."""
    choose = random.Random(seed)
    before = contents(filled)
    copy = tmp_path / "copy"
    for _ in range(25):
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir()
        shutil.copytree(f"{filled}-snapshots", copy / "app.db-snapshots")
        shutil.copy(filled, copy)
        bit = choose.randrange(8 * filled.stat().st_size)
        flip(copy / "app.db", bit)
        try:
            after = contents(copy / "app.db")
        except (DamagedStore, StoreFailed):
            continue
        if after != before:
            assert any(saved.passed_over for saved in after[:2]), f"seed {seed}, bit {bit}"
