"""The power goes off at each operation on the files; a sync fails, at each of them (T13)."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from holdfast.checkpoint.journal import DamagedStore
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.sqlite.disk import Disk, operations
from tests.checkpoint.sqlite.stores import KEY

SOURCE = Path(__file__).with_name("disk.c")
CUTS = int(os.environ.get("HOLDFAST_CUTS", "80"))
"""Power losses for each seed; more in a campaign."""

WRITER = """
import os, random, sys
from holdfast.checkpoint.sqlite import SqliteJournal, append_log, wal
from holdfast.checkpoint.journal import StoreFailed
wal.LEAST_BYTES, wal.MOST_BYTES, append_log.MOST_ROWS = 1 << 16, 32 * 4096, 12
folder, seed, syncs, key = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "fsync", bytes.fromhex(sys.argv[4]) or None
draw = random.Random(seed)
journal = SqliteJournal(folder + "/app.db", takeover=True, key=key)
acks = os.open(folder + "/acks", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
number, live, packs, refused = 0, {0: [], 1: []}, {0: [], 1: []}, False
for step in range(120):
    try:
        numbers = range(number, number + draw.choice([1, 1, 1, 2, 7]))
        batch = [(f"/{n % 2}", ("in", n, "x" * draw.randrange(300))) for n in numbers]
        for (address, _), position in zip(batch, journal.append(batch)):
            live[int(address[1])].append(position)
        number += len(batch)
        if draw.random() < 0.08:
            owner = draw.randrange(2)
            pack = b"%d " % number * 1000
            journal.keep_blocks(f"/{owner}", step, [(0, memoryview(pack)), (1 << 18, memoryview(pack))], False)
            rest = b"%d %d " % (number, step) + b"x" * draw.choice([10, 2 << 20])
            journal.cut(f"/{owner}", rest, live[owner], turn=number)
            live[owner] = []
            journal.forget_blocks(f"/{owner}", packs[owner][:-1])
            packs[owner] = [*packs[owner][-1:], step]
        if syncs and draw.random() < 0.6:  # Some of what the log has was promised, some not.
            journal.sync()
            assert not refused, "it went on after a failed sync"
            os.write(acks, b"%d\\n" % number)
    except StoreFailed:
        if not refused and journal.has_failed() is False:
            continue  # A snapshot file could not be synced: nothing has happened.
        refused = True
if refused:
    os.write(1, b"refused")
os._exit(0)  # as a kill does
"""


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What notes the operations."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    library = tmp_path_factory.mktemp("shim") / "disk.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(SOURCE), "-ldl"], check=True)
    return library


def write(shim: Path, folder: Path, log: Path, seed: int, what: str, fail: int = 0, key: bytes = b"") -> str:
    paths = os.pathsep.join(filter(None, sys.path))
    env = {**os.environ, "PYTHONPATH": paths, "LD_PRELOAD": str(shim)}
    env |= {"DISK_ROOT": str(folder), "DISK_LOG": str(log), "DISK_FAIL": str(fail)}
    command = [sys.executable, "-c", WRITER, str(folder), str(seed), what, key.hex()]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers_in(folder: Path, key: bytes = b"") -> tuple[int, list[str]]:
    """How many numbers are there (or in a snapshot), and what is wrong with them."""
    wrong: list[str] = []
    highest = 0
    with closing(SqliteJournal(folder / "app.db", takeover=True, key=key or None)) as journal:
        for owner in (0, 1):
            saved = journal.load(f"/{owner}")
            known = 0
            for older in (0, 1):  # Both snapshots that are kept have their blocks.
                snapshot = journal.load(f"/{owner}", older=older).snapshot
                if snapshot is not None:
                    size = 1000 * (snapshot.index(b" ") + 1)
                    segment = journal.read_blocks(f"/{owner}", int(snapshot.split()[1]), [(0, size), (1 << 18, size)])
                    if bytes(segment.block(0, size)) != snapshot[: size // 1000] * 1000:
                        wrong.append(f"/{owner} has other blocks")
                    segment.close()
                    known = max(known, int(snapshot.split()[0]))
            found = [entry[1] for _, entry in saved.entries]
            expected = [n for n in range(known, known + 2 * len(found) + 2) if n % 2 == owner][: len(found)]
            if found != expected:
                wrong.append(f"/{owner} has {found[:5]}... behind {known}")
            highest = max([highest, known, *(n + 1 for n in found if isinstance(n, int))])
    return highest, wrong


@pytest.mark.parametrize("what", ["os", "fsync"])
@pytest.mark.parametrize(("seed", "key"), [(1, b""), (2, b""), (3, KEY)], ids=["1", "2", "encrypted"])
def test_a_power_loss_leaves_the_store_sound_and_with_fsync_complete(
    shim: Path, tmp_path: Path, what: str, seed: int, key: bytes
) -> None:
    folder, log = tmp_path / "disk", tmp_path / "log"
    folder.mkdir()
    SqliteJournal(folder / "app.db", key=key or None).close()
    before = Disk(folder)
    write(shim, folder, log, seed, what, key=key)
    ops = list(operations(log, folder))
    draw = random.Random(seed)
    moments = sorted(draw.sample(range(1, len(ops)), min(CUTS, len(ops) - 1)))
    acknowledged = cut = 0
    for index, op in enumerate(ops):
        if moments and index == moments[0]:
            moments.pop(0)
            after = tmp_path / "after"
            shutil.rmtree(after, ignore_errors=True)
            before.cut_off(after, draw)
            where = f"seed {seed}, power lost before operation {index} of {len(ops)} ({op.kind} {op.path})"
            try:
                highest, wrong = numbers_in(after, key)
            except DamagedStore as error:
                pytest.fail(f"{where}: {error}")
            assert not wrong, f"{where}: {wrong}"
            assert highest >= acknowledged, f"{where}: {acknowledged} were acknowledged, {highest} are there"
            cut += 1
        if op.path == "acks":
            acknowledged = int(op.data)
        else:
            before.do(op, folder)
    assert cut > 50
    assert (acknowledged > 0) == (what == "fsync")


@pytest.mark.parametrize("seed", [1, 2])
def test_after_a_failed_sync_nothing_is_acknowledged_any_more(shim: Path, tmp_path: Path, seed: int) -> None:
    draw = random.Random(seed)
    for fail in sorted(draw.sample(range(4, 110), 8)):
        folder, log = tmp_path / f"disk{fail}", tmp_path / f"log{fail}"
        folder.mkdir()
        SqliteJournal(folder / "app.db").close()
        before = Disk(folder)
        assert write(shim, folder, log, seed, "fsync", fail) == "refused", f"sync {fail}"
        acknowledged = 0
        for op in operations(log, folder):
            if op.path == "acks":
                acknowledged = int(op.data)
            else:
                before.do(op, folder)
        for _ in range(5):  # What the failed sync has left on the disk is unknown.
            after = tmp_path / "after"
            shutil.rmtree(after, ignore_errors=True)
            before.cut_off(after, draw)
            highest, wrong = numbers_in(after)
            assert not wrong, f"seed {seed}, sync {fail}: {wrong}"
            assert highest >= acknowledged
