"""Copies of stores: of one instant, complete, apart from their origin; a kill at any step leaves no half one."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import DamagedStore, ForeignStore, StoreFailed
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.sqlite.store_parts import part_names
from holdfast.checkpoint.store_tools import NotCopied, StoreCopy, back_up_store, restore_store, verify_store
from holdfast.checkpoint.store_tools.store_view import StoreView
from tests.checkpoint.players import Doer, Note, Seen
from tests.checkpoint.sqlite.disk import operations
from tests.checkpoint.sqlite.stores import A, B, edit, end, flip, inputs, numbers, reopened
from tests.checkpoint.store_tools.writing import (
    acknowledged,
    begin_writing,
    count_numbers,
    disk_shim,
    environment,
    everything,
    filled,
    killed_at_each_step,
    left_by_a_kill,
    run,
    written,
)

pytestmark = pytest.mark.usefixtures("warm_programs")

SEED = int(os.environ.get("HOLDFAST_SEED", "1"))


def remove_store(path: Path) -> None:
    for name in map(Path, part_names(str(path))):
        if name.is_dir():
            shutil.rmtree(name)
        else:
            name.unlink(missing_ok=True)


def left_at(path: Path) -> list[str]:
    return [name for name in part_names(str(path)) if os.path.lexists(name)]


@pytest.mark.parametrize("seed", range(SEED, SEED + 3))
def test_a_copy_of_a_store_that_is_written_to_is_of_one_instant(tmp_path: Path, seed: int) -> None:
    path, copies = tmp_path / "app.db", tmp_path / "copies"
    copies.mkdir()
    writer = begin_writing(path, seed)
    least = {}
    try:
        for number in range(6):
            before = acknowledged(writer, 40 * number)
            dest = copies / f"{number}.db"
            back_up_store(path, dest)
            least[dest] = before
    finally:
        said = end(writer)
    least[copies / "crashed.db"] = int((said.split() or [b"0"])[-1])
    back_up_store(path, copies / "crashed.db")
    counts = []
    for dest, before in least.items():
        found = verify_store(dest)
        assert found.is_good, f"seed {seed}: {found.damages}"
        counts.append(count_numbers(dest))
        assert counts[-1] >= before, f"seed {seed}: {before} were acknowledged, {counts[-1]} are in {dest.name}"
    assert counts == sorted(counts)
    assert counts[-1] == count_numbers(path), f"seed {seed}: the copy of the crashed store is another one"


def test_a_copy_is_a_store_of_its_own(tmp_path: Path) -> None:
    path, dest = filled(tmp_path / "app.db"), tmp_path / "copy.db"
    before = everything(tmp_path)
    copy = back_up_store(path, dest)
    assert {name: value for name, value in everything(tmp_path).items() if not name.startswith("copy")} == before
    origin, found = verify_store(path), verify_store(dest)
    assert (copy.identity, copy.origin) == (found.identity, origin.identity)
    assert found.identity != origin.identity
    assert (found.entries, found.snapshots, found.packs) == (origin.entries, origin.snapshots, origin.packs)
    assert (
        copy.size
        == sum(one.stat().st_size for one in tmp_path.rglob("copy*/**/*.*") if one.is_file()) + dest.stat().st_size
    )
    assert {one.stat().st_mode & 0o777 for one in tmp_path.rglob("copy*") if one.is_file()} == {0o600}
    with closing(SqliteJournal(path)) as one, closing(SqliteJournal(dest)) as other:  # Both at once.
        for journal in (one, other):
            journal.append(inputs(1, start=7))
            assert journal.notes("") == {"key": b"value"}
    shutil.rmtree(f"{dest}-snapshots")
    shutil.copytree(f"{path}-snapshots", f"{dest}-snapshots")
    with pytest.raises(ForeignStore, match="not of one store"):
        SqliteJournal(dest)


def test_what_is_only_in_the_log_of_a_crashed_store_is_in_the_copy(tmp_path: Path) -> None:
    path = left_by_a_kill(tmp_path / "app.db")
    assert back_up_store(path, tmp_path / "copy.db").last == 2
    assert numbers(reopened(tmp_path / "copy.db")) == [0, 1]
    assert numbers(reopened(path)) == [0, 1]


def test_a_copy_of_a_store_that_misses_something_is_refused_or_misses_it_too(tmp_path: Path) -> None:
    path = left_by_a_kill(tmp_path / "killed" / "app.db")
    shutil.copytree(tmp_path / "killed", tmp_path / "lost")
    for log in Path(tmp_path / "lost" / "app.db-log").glob("*.log"):
        log.unlink()
    with pytest.raises(DamagedStore, match="were acknowledged"):
        back_up_store(tmp_path / "lost" / "app.db", tmp_path / "copy.db")
    assert left_at(tmp_path / "copy.db") == []
    path = filled(tmp_path / "whole" / "app.db")
    edit(path, "DELETE FROM entries WHERE position = (SELECT max(position) FROM entries)")
    back_up_store(path, tmp_path / "copy.db")  # Whoever opens it hears of it.
    with closing(SqliteJournal(tmp_path / "copy.db")) as journal, pytest.raises(DamagedStore, match="are missing"):
        journal.load(B)
    (Path(f"{path}-snapshots") / "1-1.snapshot").unlink()
    back_up_store(path, tmp_path / "other.db")
    assert len(verify_store(tmp_path / "other.db").damages) == 2


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    for name in map(Path, part_names(str(tmp_path / "dest.db"))):
        name.touch()
        with pytest.raises(NotCopied, match="nothing is overwritten") as caught:
            back_up_store(path, tmp_path / "dest.db")
        assert name.name in str(caught.value)
        with pytest.raises(NotCopied, match="nothing is overwritten"):
            restore_store(path, tmp_path / "dest.db")
        assert name.read_bytes() == b""
        name.unlink()
    with pytest.raises(NotCopied, match="is not there; make it first"):
        back_up_store(path, tmp_path / "missing" / "dest.db")
    with pytest.raises(NotCopied, match="a folder of the store itself"):
        back_up_store(path, Path(f"{path}-snapshots") / "dest.db")
    with pytest.raises(StoreFailed, match="there is no database"):
        back_up_store(tmp_path / "nothing.db", tmp_path / "dest.db")
    assert left_at(tmp_path / "dest.db") == []


def test_of_two_copies_to_one_place_one_is_made(tmp_path: Path) -> None:
    path, dest = written(tmp_path / "app.db", SEED, 60), tmp_path / "copy.db"
    made: list[StoreCopy] = []

    def copy() -> None:
        with contextlib.suppress(NotCopied):
            made.append(back_up_store(path, dest))

    threads = [threading.Thread(target=copy) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(made) == 1
    assert verify_store(dest).identity == made[0].identity
    assert verify_store(dest).is_good


def test_a_snapshot_that_goes_before_it_is_opened_has_another_look_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = filled(tmp_path / "app.db")
    with closing(SqliteJournal(path)) as journal:
        looks = 0
        before = StoreView.refuse_missing

        def overtaken(view: StoreView) -> None:
            nonlocal looks
            looks += 1
            before(view)
            if looks < 3:  # The view names a file that is removed now.
                state = b"x" * (2 << 20)
                positions = journal.append(inputs(1, start=7))
                for turn in (5, 6):
                    journal.cut(A, b"\x90" + state, positions, turn=turn)

        monkeypatch.setattr(StoreView, "refuse_missing", overtaken)
        back_up_store(path, tmp_path / "copy.db")
        assert looks == 3
    with closing(SqliteJournal(tmp_path / "copy.db")) as journal:
        assert journal.load(A).turn == 6
        assert not journal.load(A).passed_over


def test_no_room_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    path = written(tmp_path / "app.db", SEED, 200)
    script = """
import resource, signal, sys
from holdfast.checkpoint.store_tools import NotCopied, back_up_store
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), -1))
try:
    back_up_store(sys.argv[1], sys.argv[2])
except NotCopied as error:
    print(error.remedy)
"""
    for limit in (100, 20_000):
        command = [sys.executable, "-c", script, str(path), str(tmp_path / "copy.db"), str(limit)]
        done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60, check=True)
        assert "make room" in done.stdout, done.stderr
        assert left_at(tmp_path / "copy.db") == []
    assert verify_store(path).is_good


def test_restore_refuses_a_damaged_backup_and_leaves_it_as_it_is(tmp_path: Path) -> None:
    backup, dest = tmp_path / "backup" / "app.db", tmp_path / "dest.db"
    filled(backup)
    assert restore_store(backup, dest).origin == verify_store(backup).identity
    remove_store(dest)
    flip(backup, 8 * backup.stat().st_size // 2)
    edit(backup, "UPDATE entries SET crc = 0 WHERE position = 6")
    before = everything(backup.parent)
    with pytest.raises(NotCopied, match="the backup is damaged"):
        restore_store(backup, dest)
    assert left_at(dest) == []
    assert everything(backup.parent) == before


def test_a_kill_at_each_step_leaves_no_half_copy(tmp_path: Path) -> None:
    folder = tmp_path / "dest"
    folder.mkdir()
    path, dest = filled(tmp_path / "origin" / "app.db"), folder / "copy.db"
    before = everything(path.parent)
    whole = half = code = 0
    for steps, code in killed_at_each_step(tmp_path, folder, f"back_up_store({str(path)!r}, {str(dest)!r})"):
        assert code in (0, -signal.SIGKILL), f"step {steps}"
        assert everything(path.parent) == before
        if dest.exists():
            whole += 1
            assert verify_store(dest).is_good, f"killed at step {steps}"
            assert verify_store(dest).entries == 11
            SqliteJournal(dest).close()
        elif left_at(dest):
            half += 1
            with pytest.raises(NotCopied, match="ended in its middle"):
                back_up_store(path, dest)
            with contextlib.suppress(ForeignStore):  # It is refused, unless there is nothing in it yet.
                assert reopened(dest).entries == []
        remove_store(dest)
    assert code == 0
    assert whole >= 1
    assert half > 5


def test_a_copy_is_on_the_disk_when_it_is_made(tmp_path: Path) -> None:
    """All that was written to a file is synced, and the folders that name the files are, too."""
    folder, log = tmp_path / "dest", tmp_path / "log"
    folder.mkdir()
    path, dest = filled(tmp_path / "origin" / "app.db"), folder / "copy.db"
    env = {**environment(), "LD_PRELOAD": str(disk_shim(tmp_path)), "DISK_ROOT": str(folder), "DISK_LOG": str(log)}
    script = "import sys; from holdfast.checkpoint.store_tools import back_up_store; back_up_store(*sys.argv[1:])"
    command = [sys.executable, "-c", script, str(path), str(dest)]
    subprocess.run(command, env={**env, "DISK_FAIL": "0"}, timeout=60, check=True)
    unsynced: dict[str, int] = {}
    names: dict[str, int] = {}  # when a name was last made or removed in a folder
    synced: dict[str, int] = {}
    for number, op in enumerate(operations(log, folder)):
        if op.kind in "wt":
            unsynced[op.path] = number
        elif op.kind == "s":
            unsynced.pop(op.path, None)
            synced[op.path.removeprefix(str(folder))] = number
        elif op.kind == "u":
            unsynced.pop(op.path, None)
            names[os.path.dirname(op.path)] = number
        else:
            names[os.path.dirname(op.path)] = number
    assert not unsynced
    parts = {str(one.relative_to(folder)) for one in folder.rglob("*") if one.is_dir()}
    assert len(parts) == 3  # of snapshots, of packs, and of the packs of one address
    assert parts | {""} <= synced.keys()
    assert all(synced[part] >= names.get(part, 0) for part in parts)


ROOT = """
import asyncio, os, sys
import holdfast as hf
from tests.checkpoint.players import Doer, Note


async def main():
    async with hf.ActorSystem("app", store="sqlite:" + sys.argv[1], log=False) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(every=25)))
        for number in range(1_000_000):
            await doer.ask(Note(str(number)), timeout=20.0)
            os.write(1, b"%d\\n" % number)

asyncio.run(main())
"""


async def restored_numbers(path: Path) -> list[str]:
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(every=25)))
        return [str(one) for one in await doer.ask(Seen(), timeout=20.0)]


async def test_a_root_that_is_killed_during_backups_is_restored_from_each(tmp_path: Path) -> None:
    draw = random.Random(SEED)
    print(f"seed {SEED}")
    for life in range(2):
        path = tmp_path / f"{life}.db"
        root = subprocess.Popen([sys.executable, "-c", ROOT, str(path)], env=environment(), stdout=subprocess.PIPE)
        copies: list[tuple[int, Path]] = []
        try:
            for number in range(2):
                before = acknowledged(root, draw.randrange(20, 80))
                dest = tmp_path / f"{life}-{number}.db"
                copier = threading.Thread(target=back_up_store, args=(path, dest))
                copier.start()
                if number == 1:
                    root.send_signal(signal.SIGKILL)
                copier.join(60)
                copies.append((before, dest))
        finally:
            last = int((end(root).split() or [b"0"])[-1] or 0)
        copies.append((max(last, copies[-1][0]), tmp_path / f"{life}-crashed.db"))
        back_up_store(path, copies[-1][1])
        for number, (before, dest) in enumerate(copies):
            assert verify_store(dest).is_good, f"seed {SEED}"
            place = tmp_path / f"restored-{life}-{number}.db"
            restore_store(dest, place)
            seen = await restored_numbers(place)
            assert seen == [str(one) for one in range(len(seen))], f"seed {SEED}"
            assert len(seen) > before, f"seed {SEED}: {before} was acknowledged"


async def test_a_system_backs_its_own_store_up(tmp_path: Path) -> None:
    path, dest = tmp_path / "app.db", tmp_path / "copy.db"
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid()))
        await doer.ask(Note("one"))
        copy = await system.backup(dest)
        assert copy.path == str(dest)
        await doer.ask(Note("two"))
        with pytest.raises(NotCopied, match="nothing is overwritten"):
            await system.backup(dest)
    assert await restored_numbers(dest) == ["one"]
    assert await restored_numbers(path) == ["one", "two"]
    async with hf.ActorSystem("app", log=False) as system:
        with pytest.raises(hf.errors.SpecError, match="sqlite:PATH"):
            await system.backup(tmp_path / "other.db")


def test_the_commands(tmp_path: Path) -> None:
    path, dest = filled(tmp_path / "app.db"), tmp_path / "copy.db"
    status, said, _ = run("backup", path, dest)
    assert (status, "a copy of" in said, "good: 11 entries" in said) == (0, True, True)
    status, said, complaint = run("backup", path, dest)
    assert (status, said, "nothing is overwritten" in complaint) == (2, "", True)
    status, said, _ = run("restore", dest, tmp_path / "again.db", "--json")
    data = json.loads(said)
    assert (status, data["path"], data["verified"]["is_good"]) == (0, str(tmp_path / "again.db"), True)
    status, said, _ = run("backup", path, tmp_path / "quick.db", "--no-verify", "--json")
    assert (status, json.loads(said)["verified"]) == (0, None)
    edit(path, "UPDATE entries SET crc = 0 WHERE position = 6")
    status, said, _ = run("backup", path, tmp_path / "damaged.db")
    assert (status, "DAMAGED" in said) == (1, True)
    assert verify_store(tmp_path / "damaged.db").damages
    status, said, complaint = run("restore", tmp_path / "damaged.db", tmp_path / "never.db")
    assert (status, "the backup is damaged" in complaint) == (2, True)
