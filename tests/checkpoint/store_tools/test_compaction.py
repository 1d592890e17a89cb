"""Compaction gives room back, takes nothing that a recovery reads, and survives a kill at any step."""

from __future__ import annotations

import json
import os
import shutil
import signal
from contextlib import closing
from pathlib import Path

import pytest

from holdfast.checkpoint.journal import DamagedStore, StoreFailed, StoreInUse
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.store_tools import compact_store, verify_store
from tests.checkpoint.sqlite.stores import B, edit, end, inputs, made
from tests.checkpoint.store_tools.writing import (
    begin_writing,
    contents,
    count_numbers,
    filled,
    killed_at_each_step,
    left_by_a_kill,
    run,
    written,
)

SEED = int(os.environ.get("HOLDFAST_SEED", "1"))


def with_garbage(path: Path) -> Path:
    """A store with free pages, files that no snapshot names, and a snapshot whose entries are still there."""
    filled(path)
    with closing(SqliteJournal(path)) as journal:
        positions = journal.append([("/app/large", ("in", number, "x" * 1000)) for number in range(500)])
        journal.keep_blocks(B, 99, [(0, memoryview(b"unneeded" * 1000))], False)
        journal.keep_blocks("/app/large", 3, [(0, memoryview(b"unneeded" * 1000))], False)
        journal.cut("/app/large", b"no snapshot of a home", positions[:-1], turn=1)
        journal.append([("/app/erased", ("in", number, "x" * 1000)) for number in range(500)])
        journal.erase("/app/erased")
    return path


def test_what_is_not_needed_gives_its_room_back(tmp_path: Path) -> None:
    path = with_garbage(tmp_path / "app.db")
    before = contents(path)
    done = compact_store(path)
    assert done.after < done.before - 900_000
    with closing(SqliteJournal(path)) as journal:
        assert journal.packs(B) == {7}
        assert journal.packs("/app/large") == {3}  # Nobody knows what its snapshot needs.
        assert len(journal.load("/app/large").entries) == 1
        assert verify_store(path).entries == 12
    assert contents(path) == before
    assert compact_store(path).before == compact_store(path).after


def test_it_is_refused_while_somebody_has_the_store_open(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    with closing(SqliteJournal(path)) as journal:
        with pytest.raises(StoreInUse):
            compact_store(path)
        journal.append(inputs(1, start=7))
    writer = begin_writing(tmp_path / "other.db", SEED)
    try:
        status, _, complaint = run("compact", tmp_path / "other.db")
        assert (status, f"open in process {writer.pid}" in complaint) == (1, True)
    finally:
        end(writer)


def test_no_store_is_made(tmp_path: Path) -> None:
    with pytest.raises(StoreFailed, match="there is no database"):
        compact_store(tmp_path / "nothing.db")
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_the_log_of_a_crashed_store_stays(tmp_path: Path) -> None:
    path = left_by_a_kill(tmp_path / "app.db")
    compact_store(path)
    found = verify_store(path)
    assert (found.is_good, found.entries) == (True, 2)
    assert made(f"{path}-log") == []


@pytest.mark.parametrize("seed", range(SEED, SEED + 2))
def test_a_store_of_many_snapshots_is_the_same_afterwards(tmp_path: Path, seed: int) -> None:
    path = written(tmp_path / "app.db", seed, 200)
    before = count_numbers(path)
    compact_store(path)
    assert verify_store(path).is_good, f"seed {seed}"
    assert count_numbers(path) == before, f"seed {seed}"


def test_a_kill_at_each_step_leaves_the_store_as_it_was_or_compact(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    path = with_garbage(folder / "app.db")
    shutil.copytree(folder, tmp_path / "before")
    before, killed, code = contents(path), 0, 0
    shutil.rmtree(folder)
    shutil.copytree(tmp_path / "before", folder)
    for steps, code in killed_at_each_step(tmp_path, folder, f"compact_store({str(path)!r})"):
        assert code in (0, -signal.SIGKILL), f"step {steps}"
        killed += code != 0
        found = verify_store(path)
        damaged = [damage for damage in found.damages if damage.address != "/app/large"]  # Its snapshot is none.
        assert not damaged, f"killed at step {steps}: {damaged}"
        assert contents(path) == before, f"killed at step {steps}"
        shutil.rmtree(folder)
        shutil.copytree(tmp_path / "before", folder)
    assert code == 0
    assert killed > 5


def test_the_command(tmp_path: Path) -> None:
    path = with_garbage(tmp_path / "app.db")
    status, said, _ = run("compact", path, "--json")
    data = json.loads(said)
    assert (status, data["after"] < data["before"]) == (0, True)
    assert "before" in run("compact", path)[1]
    assert run("compact", tmp_path / "nothing.db")[0] == 2
    edit(path, "UPDATE store SET live = live + 1")
    with pytest.raises(DamagedStore):
        compact_store(path)
    assert run("compact", path)[0] == 1
