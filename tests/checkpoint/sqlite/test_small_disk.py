"""A store that has filled its disk: the WAL stays short, its room comes back, or the error says how much is wanted."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from holdfast.checkpoint.sqlite import SqliteJournal, wal

WRITER = """
import os, re, subprocess, sys
from contextlib import closing
from holdfast.checkpoint.journal import StoreFailed
from holdfast.checkpoint.sqlite import SqliteJournal, wal
from holdfast.checkpoint.store_tools import back_up_store, compact_store

disk, elsewhere = sys.argv[1:]
path = disk + "/app.db"
ADDRESSES = [f"/app/{number}" for number in range(20)]
wal.LEAST_BYTES = 1 << 30  # It may fill the disk.
state = {}


def keep(journal, turn):
    "One more turn, and a snapshot of it, at each address."
    for address in ADDRESSES:
        [position] = journal.append([(address, ("in", turn))])
        journal.cut(address, b"%d" % turn * 500, [position], turn=turn)
        state[address] = turn


def fill(journal, turn, grow=0):
    "Until the disk is full; each turn adds so many bytes to what is live."
    while turn < 10_000:
        turn += 1
        try:
            keep(journal, turn)
            if grow:
                journal.note(f"note {turn}", bytes(grow))
        except StoreFailed as error:
            return turn, str(error)
    raise AssertionError("the disk is never full")


def is_kept(journal):
    for address in ADDRESSES:
        kept = journal.snapshots(address)[-1]
        assert kept in (b"%d" % state[address] * 500, b"%d" % (state[address] + 1) * 500), address


def child(work):
    "Have a process of its own write, which is gone without closing the store; returns what it kept."
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            work()
            os.write(writer, repr(state).encode())
        finally:
            os._exit(0)
    os.close(writer)
    os.waitpid(pid, 0)
    with open(reader, "rb") as said:
        state.update(eval(said.read()))


def left_full(grow=0):
    "A disk that a store has filled; without `grow` all pages of the database are there already."

    def work():
        journal = SqliteJournal(path)
        wal.Wal.make_room = lambda self: None
        fill(journal, 2, grow)

    with closing(SqliteJournal(path)) as journal:
        for turn in range(3):
            keep(journal, turn)
            journal.note("room for what comes", bytes(200_000) if turn < 2 else None)
    child(work)
    free = os.statvfs(disk)
    assert free.f_bavail * free.f_frsize < 100_000 and os.path.getsize(path + "-wal") > 1 << 20
"""

GOES_ON = """
with closing(SqliteJournal(path)) as journal:
    for turn in range(3):
        keep(journal, turn)
        journal.note("room for what comes", bytes(200_000) if turn < 2 else None)
with closing(SqliteJournal(path)) as journal:
    turn, _ = fill(journal, 2)
    journal._store._wal.join()
    keep(journal, turn + 1)
    assert os.path.getsize(path + "-wal") < 1 << 20
    is_kept(journal)
"""
OPENED = """
left_full()
with closing(SqliteJournal(path)) as journal:
    assert os.path.getsize(path + "-wal") < 1 << 20
    is_kept(journal)
    keep(journal, 10_001)
    is_kept(journal)
"""
COMPACTED = """
left_full()
done = compact_store(path)
assert done.after < 1 << 20 < done.before
with closing(SqliteJournal(path)) as journal:
    is_kept(journal)
"""
REFUSED = """
left_full(grow=30_000)
try:
    SqliteJournal(path)
    raise AssertionError("it was opened")
except StoreFailed as error:
    room = re.search("make room for ([0-9.]+) MB and open it again", str(error))
    assert room and "store backup" in str(error), error
back_up_store(path, elsewhere + "/app.db")
with closing(SqliteJournal(elsewhere + "/app.db")) as journal:
    is_kept(journal)
size = (8 << 20) + int(float(room[1]) * 1e6)
subprocess.run(["mount", "-o", f"remount,size={size}", disk], check=True)
with closing(SqliteJournal(path)) as journal:
    is_kept(journal)
    keep(journal, 10_001)
"""


def on_a_small_disk(folder: Path, script: str) -> None:
    """Run a script beside a disk of 8 MiB. Skips where nobody may mount one."""
    disk, elsewhere = folder / "disk", folder / "elsewhere"
    disk.mkdir()
    elsewhere.mkdir(mode=0o700)
    alone = ["unshare", "--map-root-user", "--mount"]
    if subprocess.run([*alone, "mount", "-t", "tmpfs", "-o", "size=8m", "none", str(disk)], check=False).returncode:
        pytest.skip("a user may not mount a file system in a namespace of their own here")
    mount = f'mount -t tmpfs -o size=8m,mode=700 none "{disk}" && exec "$@"'
    command = [*alone, "sh", "-c", mount, "sh", sys.executable, "-c", WRITER + script, str(disk), str(elsewhere)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "script",
    [
        pytest.param(GOES_ON, id="goes on"),
        pytest.param(OPENED, id="is opened"),
        pytest.param(COMPACTED, id="is compacted"),
        pytest.param(REFUSED, id="says what it needs"),
    ],
)
def test_a_store_that_has_filled_its_disk(tmp_path: Path, script: str) -> None:
    on_a_small_disk(tmp_path, script)


def test_the_wal_of_a_small_store_stays_small(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wal, "LEAST_BYTES", 1 << 20)
    longest = 0
    with closing(SqliteJournal(path)) as journal:
        for turn in range(60):
            for number in range(20):
                address = f"/app/{number}"
                [position] = journal.append([(address, ("in", turn))])
                journal.cut(address, b"state" * 100, [position], turn=turn)
            journal._store._wal.join()  # How far the writers are ahead is a matter of the machine.
            longest = max(longest, os.path.getsize(f"{path}-wal"))
        allowed = wal.longest(os.path.getsize(path))
        assert longest < 2 * allowed, f"{longest} bytes beside a database of {os.path.getsize(path)}"
