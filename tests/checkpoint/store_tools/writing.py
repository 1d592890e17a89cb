"""Stores to be verified and copied, a process that writes to one as homes do, and what can be said of it afterwards."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

from holdfast.checkpoint.snapshot.snapshot_record import IMAGES, Meta
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.console.commands import commands
from tests.checkpoint.sqlite.stores import A, B, inputs

SHIM = Path(__file__).parents[1] / "sqlite" / "disk.c"
EVERY = 1 if "HOLDFAST_CUTS" in os.environ else 5
"""Each step in a campaign, else each fifth."""

WRITER = """
import os, random, sys
import msgspec
from holdfast.checkpoint.snapshot.snapshot_record import IMAGES, ClassRecord, Meta
from holdfast.checkpoint.sqlite import SqliteJournal, append_log, wal
path, seed, steps, key = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), bytes.fromhex(sys.argv[4]) or None
append_log.MOST_ROWS, wal.LEAST_BYTES = 12, 1 << 20
draw = random.Random(seed)
journal = SqliteJournal(path, synchronous="fsync" if seed % 3 == 2 else "os", key=key)
number, live, packs = 0, {0: [], 1: []}, {0: [], 1: []}
os.write(1, b"open\\n")
for step in range(1, steps + 1):
    size = draw.choice([1, 1, 1, 2, 7])
    numbers = range(number, number + size)
    batch = [(f"/app/{n % 2}", ("in", n, size, n - number, "x" * draw.randrange(200))) for n in numbers]
    for (address, _), position in zip(batch, journal.append(batch)):
        live[int(address[-1])].append(position)
    number += size
    if draw.random() < 0.05:
        journal.sync()
    if draw.random() < 0.1:
        owner = draw.randrange(2)
        address, blocks, state = f"/app/{owner}", [], b"x" * draw.choice([10, 2 << 20])
        if draw.random() < 0.5:
            pack, state = b"%d " % number * 1000, b""
            journal.keep_blocks(address, step, [(0, memoryview(pack))], False)
            blocks = [(step, 0, len(pack))]
            packs[owner].append(step)
        earlier = packs[owner][-2:]
        made = ClassRecord("app:Writer")
        meta = Meta(IMAGES, number, number, [], {}, [], 1, state, number, blocks, earlier, time=1.0, made=made)
        journal.cut(address, msgspec.msgpack.encode(meta), live[owner], turn=number)
        live[owner] = []
        journal.forget_blocks(address, packs[owner][:-2])
    os.write(1, b"%d\\n" % number)  # acknowledged
journal.close()
"""


KILLED = """
import os, sys
from holdfast.checkpoint.sqlite import SqliteJournal
journal = SqliteJournal(sys.argv[1])
for number in (0, 1):
    journal.append([("/app/bank/alice", ("in", number))])
os._exit(0)  # as a kill does
"""


def meta(state: bytes, turn: int, blocks: list[tuple[int, int, int]] | None = None) -> bytes:
    return msgspec.msgpack.encode(Meta(IMAGES, turn, turn, [], {}, [], 1, state, turn, blocks or []))


def filled(path: Path, key: bytes | None = None) -> Path:
    """A closed store: of A a small and a large snapshot and entries, of B one with a pack, and a note."""
    path.parent.mkdir(exist_ok=True)
    with closing(SqliteJournal(path, key=key)) as journal:
        positions = journal.append([*inputs(4), *inputs(4, B)])
        journal.cut(A, meta(b"older", 2), positions[:2], turn=2)
        positions += journal.append(inputs(2, start=4))
        journal.cut(A, meta(b"newer" * 400_000, 4), positions[:4], turn=4)
        journal.append([*inputs(1, start=6), *inputs(2, B, 4)])
        journal.keep_blocks(B, 7, [(0, memoryview(b"block" * 2000))], False)
        journal.cut(B, meta(b"", 1, [(7, 0, 10_000)]), [], turn=1)
        journal.note("key", b"value")
    return path


def left_by_a_kill(path: Path) -> Path:
    """A store with one entry in the WAL, and one in the log alone."""
    path.parent.mkdir(exist_ok=True)
    subprocess.run([sys.executable, "-c", KILLED, str(path)], env=environment(), check=True, timeout=60)
    return path


def contents(path: Path, key: bytes | None = None) -> Any:
    """All that a recovery reads."""
    with closing(SqliteJournal(path, key=key)) as journal:
        segment = journal.read_blocks(B, 7, [(0, 10_000)])
        blocks = bytes(segment.block(0, 10_000))
        segment.close()
        return journal.load(A), journal.load(A, older=1), journal.load(B), journal.noted("key"), blocks


def everything(folder: Path) -> dict[str, tuple[bytes, int, int]]:
    """All files of a folder; SQLite's index of the WAL is no data."""
    return {
        str(one.relative_to(folder)): (one.read_bytes(), one.stat().st_mode, one.stat().st_mtime_ns)
        for one in folder.rglob("*")
        if one.is_file() and not one.name.endswith("-shm")
    }


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(commands, ["store", *map(str, arguments)])
    return result.exit_code, result.stdout, result.stderr


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def begin_writing(path: Path, seed: int, steps: int = 1_000_000, key: bytes | None = None) -> subprocess.Popen[bytes]:
    """Start a writer; it is at work when this returns."""
    command = [sys.executable, "-c", WRITER, str(path), str(seed), str(steps), (key or b"").hex()]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment())
    assert writer.stdout is not None
    assert writer.stdout.readline() == b"open\n"
    return writer


def written(path: Path, seed: int, steps: int) -> Path:
    """A store that was closed in good order."""
    writer = begin_writing(path, seed, steps)
    writer.communicate(timeout=60)
    assert writer.returncode == 0
    return path


def acknowledged(writer: subprocess.Popen[bytes], least: int = 0) -> int:
    """How many numbers are acknowledged by now, after having waited for so many."""
    assert writer.stdout is not None
    number = 0
    while number <= least or os.get_blocking(writer.stdout.fileno()) is False:
        said = writer.stdout.readline()
        if not said:
            break
        number = int(said)
    return number


def count_numbers(path: Path, key: bytes | None = None) -> int:
    """How many numbers there are: all up to there, and each batch as a whole.

    Packs are compared byte by byte, with both snapshots that are kept.
    """
    found: set[int] = set()
    known = [0, 0]
    newest: tuple[int, ...] = (-1, 1, 0)
    with closing(SqliteJournal(path, key=key)) as journal:
        for owner in (0, 1):
            address = f"/app/{owner}"
            for older in (1, 0):
                snapshot = journal.load(address, older=older).snapshot
                if snapshot is not None:
                    meta = msgspec.msgpack.decode(snapshot, type=Meta)
                    known[owner] = meta.next_id
                    for number, offset, length in meta.blocks:
                        segment = journal.read_blocks(address, number, [(offset, length)])
                        assert bytes(segment.block(offset, length)) == b"%d " % meta.next_id * 1000
                        segment.close()
            saved = journal.load(address)
            assert saved.passed_over == ""
            found.update(range(owner, known[owner], 2))
            for _, entry in saved.entries:
                _, n, of, at, _ = entry
                assert isinstance(n, int)
                assert isinstance(of, int)
                assert isinstance(at, int)
                found.add(n)
                newest = max(newest, (n, of, at))
    assert found == set(range(len(found))), f"{sorted(set(range(max(found))) - found)[:5]} are missing"
    number, size, place = newest
    assert number < max(known) or place == size - 1, "half of a batch is there"
    return len(found)


KILLED_AT = """
import ctypes, os, sys, traceback
from holdfast.checkpoint.store_tools import back_up_store, compact_store
shim, work = ctypes.CDLL(sys.argv[1]), sys.argv[2]
steps_left = ctypes.c_long.in_dll(shim, "steps_left")
for steps in range(1, 100_000, int(sys.argv[3])):
    pid = os.fork()
    if not pid:
        steps_left.value = steps
        try:
            eval(work)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    print(steps, code, flush=True)
    if sys.stdin.readline() != "on\\n" or code >= 0:
        break
"""
"""Does some work in forks: the first is killed at the first operation on the files of a folder, and so on."""


def disk_shim(folder: Path) -> Path:
    """What notes the operations on files, and kills at them."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    shim = folder / "disk.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(shim), str(SHIM), "-ldl"], check=True)
    return shim


def killed_at_each_step(tmp_path: Path, folder: Path, work: str) -> Iterator[tuple[int, int]]:
    """Have some work done again and again, killed later each time; gives the step and the exit status of each.

    The last one is not killed.
    """
    shim = disk_shim(tmp_path)
    env = {**environment(), "LD_PRELOAD": str(shim), "DISK_ROOT": str(folder), "DISK_LOG": os.devnull, "DISK_FAIL": "0"}
    command = [sys.executable, "-c", KILLED_AT, str(shim), work, str(EVERY)]
    with subprocess.Popen(command, env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        while line := server.stdout.readline():
            steps, code = map(int, line.split())
            yield steps, code
            with contextlib.suppress(BrokenPipeError):
                server.stdin.write("on\n")
                server.stdin.flush()
