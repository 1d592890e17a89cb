"""Verification finds each damage that an opening or a recovery would meet, and changes nothing."""

from __future__ import annotations

import json
import os
import random
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from holdfast.checkpoint.encoding import compression
from holdfast.checkpoint.journal import DamagedStore, ForeignStore, StoreFailed
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.store_tools import Damage, export_store, verify_store
from holdfast.checkpoint.store_tools.store_view import StoreView, look, open_view
from holdfast.checkpoint.store_tools.verification import StoreCheck
from holdfast.errors import SpecError
from tests.checkpoint.sqlite.stores import A, B, edit, end, flip, inputs, made
from tests.checkpoint.store_tools.writing import (
    acknowledged,
    begin_writing,
    contents,
    everything,
    filled,
    left_by_a_kill,
    meta,
    run,
)

SEED = int(os.environ.get("HOLDFAST_SEED", "1"))
FLIPS = 40


def damages(path: Path) -> list[Damage]:
    return verify_store(path).damages


def test_a_good_store_is_good_and_is_not_touched(tmp_path: Path) -> None:
    for make in (filled, left_by_a_kill):
        folder = tmp_path / make.__name__
        path = make(folder / "app.db")
        before, names = everything(folder), sorted(os.listdir(folder))
        found = verify_store(path)
        assert found.is_good, found.damages
        assert (found.pid, found.untold) == (0, 0)
        assert everything(folder) == before
        assert sorted(os.listdir(folder)) == names
    assert (found.entries, found.last) == (2, 2)  # One is in the log alone.
    found = verify_store(tmp_path / "filled" / "app.db")
    assert (found.entries, found.snapshots, found.packs) == (11, 3, 1)


def test_an_open_store_is_verified_and_its_owner_named(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1, start=7))
        found = verify_store(path)
        assert (found.is_good, found.pid, found.entries) == (True, os.getpid(), 12)
        journal.append(inputs(1, start=8))
        assert verify_store(path).last == found.last + 1


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM entries WHERE position = 5",
        "DELETE FROM entries WHERE position = (SELECT max(position) FROM entries)",
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
        "UPDATE addresses SET kept = '' WHERE id = 2",
        "DELETE FROM addresses WHERE id = 2",
        "UPDATE snapshots SET turn = 3 WHERE turn = 2",
        "UPDATE snapshots SET drops = x'00' WHERE turn = 2",
        "UPDATE snapshots SET data = CAST('rob' AS BLOB) WHERE turn = 2",
        "UPDATE snapshots SET file = '../victim' WHERE turn = 4",
        "DELETE FROM snapshots WHERE turn = 1",
        "UPDATE notes SET value = CAST('values' AS BLOB)",
        "UPDATE store SET live = live + 1",
        "DELETE FROM store",
        "PRAGMA user_version = 3",
        "PRAGMA application_id = 2",
        "ALTER TABLE entries ADD COLUMN more",
    ],
)
def test_damaged_rows_are_told(tmp_path: Path, statement: str) -> None:
    path = filled(tmp_path / "app.db")
    edit(path, statement)
    assert damages(path)
    assert all(damage.remedy and damage.file.startswith(str(path)) for damage in damages(path))


def test_all_damages_are_told_each_with_its_place_and_what_to_do(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    edit(
        path, "UPDATE entries SET crc = 0 WHERE position IN (6, 10)", "UPDATE snapshots SET digest = x'' WHERE turn = 2"
    )
    (file,) = made(f"{path}-snapshots")
    flip(file, 8_000_001)
    (pack,) = Path(f"{path}-packs").rglob("*.pack")
    flip(pack, 8_001)
    found = {(damage.address, damage.position, damage.file) for damage in damages(path)}
    assert found == {
        (B, 6, str(path)),
        (A, 10, str(path)),
        (A, None, str(path)),
        (A, None, str(file)),
        (B, None, str(pack)),
    }
    remedies = {damage.file: damage.remedy for damage in damages(path)}
    assert "fresh=True" in remedies[str(path)] or "older snapshot" in remedies[str(path)]
    assert "older snapshot" in remedies[str(file)]  # There is one.
    assert "older snapshot" not in remedies[str(pack)]  # It was the only one.


@pytest.mark.parametrize("part", ["app.db", "app.db-snapshots", "app.db-packs"])
@pytest.mark.parametrize("seed", range(SEED, SEED + 2))
@pytest.mark.some(3)
def test_whatever_a_recovery_would_miss_is_found(tmp_path: Path, part: str, seed: int) -> None:
    """Flip random bits: what is said to be good is read as before."""
    draw = random.Random(f"{seed} {part}")
    path = filled(tmp_path / "whole" / "app.db")
    before, found = contents(path), 0
    copy = tmp_path / "copy"
    for _ in range(FLIPS):
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(path.parent, copy)
        files = [copy / part] if (copy / part).is_file() else [
            one for one in (copy / part).rglob("*") if one.is_file() and one.name != "store-id"
        ]  # fmt: skip
        file = draw.choice(files)
        bit = draw.randrange(8 * file.stat().st_size)
        flip(file, bit)
        where = f"seed {seed}, bit {bit} of {file.name}"
        is_good = verify_store(copy / "app.db").is_good
        found += not is_good
        try:
            after = contents(copy / "app.db")
        except (DamagedStore, ForeignStore, StoreFailed):
            assert not is_good, where
            continue
        assert after == before or not is_good, where
    assert found > 0


@pytest.mark.parametrize("seed", range(SEED, SEED + 2))
def test_a_log_or_wal_that_lost_what_was_acknowledged_is_told(tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    path = left_by_a_kill(tmp_path / "whole" / "app.db")
    copy = tmp_path / "copy"
    for _ in range(FLIPS // 2):
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(path.parent, copy)
        file = draw.choice([Path(f"{copy}/app.db-wal"), *made(f"{copy}/app.db-log")])
        bit = draw.randrange(8 * file.stat().st_size)
        flip(file, bit)
        is_good = verify_store(copy / "app.db").is_good
        try:
            with closing(SqliteJournal(copy / "app.db")) as journal:
                is_read = [entry for _, entry in journal.load(A).entries] == [("in", 0), ("in", 1)]
        except (DamagedStore, ForeignStore, StoreFailed):
            is_read = False
        assert is_read or not is_good, f"seed {seed}, bit {bit} of {file.name}"
    os.unlink(made(f"{path}-log")[0])
    (damage,) = damages(path)
    assert "were acknowledged" in damage.problem


@pytest.mark.parametrize("size", [0, 50, 1000, 4096, 8192, 16384])
def test_a_truncated_database_is_told(tmp_path: Path, size: int) -> None:
    path = filled(tmp_path / "app.db")
    os.truncate(path, size)
    assert damages(path)


def test_a_running_system_is_no_damage(tmp_path: Path) -> None:
    """Snapshots, packs and logs come and go while they are read."""
    for seed in range(SEED, SEED + 3):
        writer = begin_writing(tmp_path / f"{seed}.db", seed)
        try:
            acknowledged(writer, 50)
            for _ in range(6):
                found = verify_store(tmp_path / f"{seed}.db")
                assert found.is_good, f"seed {seed}: {found.damages}"
                assert found.pid == writer.pid
        finally:
            end(writer)
        found = verify_store(tmp_path / f"{seed}.db")
        assert found.is_good, f"seed {seed}, after the kill: {found.damages}"


def test_files_that_a_running_system_needs_no_more_are_no_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = filled(tmp_path / "app.db")
    with closing(SqliteJournal(path)) as journal:
        check_pages = StoreCheck._check_pages

        def overtaken(check: StoreCheck) -> None:
            check_pages(check)
            for turn in (5, 6):
                journal.cut(A, meta(b"newest", turn), [], turn=turn)
                journal.cut(B, meta(b"newest", turn), [], turn=turn)
            journal.forget_blocks(B, [7])

        monkeypatch.setattr(StoreCheck, "_check_pages", overtaken)
        assert verify_store(path).is_good
        assert made(f"{path}-snapshots") == []
        assert journal.packs(B) == set()
        assert verify_store(path).is_good


def test_a_closed_store_that_is_opened_under_a_look_is_looked_at_again(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    seen: list[int] = []

    def work(view: StoreView) -> int:
        if not seen:
            with closing(SqliteJournal(path)) as journal:
                journal.append(inputs(1, start=7))
        seen.append(view.last)
        return view.last

    assert look(path, work) == seen[1]
    assert len(seen) == 2
    assert seen[1] > seen[0]


def test_what_cannot_be_decompressed_here_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zstandard", reason="nothing can be compressed")
    path, state = tmp_path / "app.db", b"state" * 1000
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1))
        journal.keep_blocks(A, 7, [(0, memoryview(state))], True)
        journal.cut(A, meta(b"", 1, [(7, 0, len(state))]), [], turn=1)
    assert verify_store(path).is_good

    def missing(where: str) -> None:
        raise SpecError(where, "needs the library zstandard")

    monkeypatch.setattr(compression, "_library", missing)
    with pytest.raises(StoreFailed, match="library zstandard"):
        verify_store(path)
    with pytest.raises(StoreFailed, match="library zstandard"):
        list(export_store(path))


def test_a_store_that_is_closed_under_a_look_is_complete(tmp_path: Path) -> None:
    """Its WAL is left where it is: SQLite removes it only with the last who has the database open."""
    path = left_by_a_kill(tmp_path / "app.db")
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(1, start=2))
        with open_view(os.path.realpath(path)) as view:
            journal.append(inputs(1, start=3))
            journal.close()
            assert view.last == 3
    assert Path(f"{path}-wal").exists()
    found = verify_store(path)
    assert (found.is_good, found.entries, found.pid) == (True, 4, 0)
    with closing(SqliteJournal(path)) as journal:
        assert len(journal.load(A).entries) == 4


def test_a_lock_of_the_owner_outlives_a_look_from_its_own_process(tmp_path: Path) -> None:
    """To close a file gives back the locks of another kind that its process has on it."""
    path = filled(tmp_path / "app.db")
    with closing(SqliteJournal(path)) as journal:
        verify_store(path)
        with closing(sqlite3.connect(path)) as db:
            ((pid,),) = db.execute("SELECT pid FROM store")
        assert pid == os.getpid()
        locks = [words.split() for words in Path("/proc/locks").read_text().splitlines()]
        inode = str(Path(f"{path}-snapshots/store-id").stat().st_ino)
        assert [words[1] for words in locks if words[-3].endswith(f":{inode}")] == ["FLOCK"]
        journal.append(inputs(1, start=7))


def test_the_command(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    status, said, _ = run("verify", path)
    assert (status, said.count("\n")) == (0, 1)
    assert "good: 11 entries, 3 snapshots, 1 packs" in said
    edit(path, "UPDATE entries SET crc = 0 WHERE position = 6")
    status, said, _ = run("verify", path)
    assert (status, f"DAMAGED {path}, address {B}, position 6" in said) == (1, True)
    status, said, _ = run("verify", path, "--json")
    data = json.loads(said)
    assert (status, data["is_good"], data["damages"][0]["position"]) == (1, False, 6)
    os.chmod(path, 0o666)
    status, said, complaint = run("verify", path)
    assert (status, said, "chmod go-w" in complaint) == (2, "", True)
    os.unlink(path)
    status, said, complaint = run("verify", path)
    assert (status, said, "the database is gone" in complaint) == (2, "", True)
    status, said, complaint = run("verify", tmp_path / "nothing.db")
    assert (status, said, "there is no database" in complaint) == (2, "", True)
