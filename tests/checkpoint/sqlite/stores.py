"""What is done to stores, by these tests and by a process of its own."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

from holdfast.checkpoint.journal import (
    Entry,
    Saved,
)
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.sqlite.row_codec import crc_of
from holdfast.checkpoint.sqlite.store_parts import Parts

A, B = "/app/bank/alice", "/app/bank/bob"


def inputs(count: int, address: str = A, start: int = 0) -> list[tuple[str, Entry]]:
    return [(address, ("in", number)) for number in range(start, start + count)]


def numbers(saved: Saved) -> list[Any]:
    return [entry[1] for _, entry in saved.entries]


KEY = bytes(range(32))
"""The key of the encrypted stores of these tests, also in the scripts."""


def reopened(path: Path, key: bytes | None = None) -> Saved:
    with closing(SqliteJournal(path, key=key)) as journal:
        return journal.load(A)


def made(folder: Path | str) -> list[Path]:
    """What is in a folder of a store besides its identity."""
    return sorted(one for one in Path(folder).iterdir() if one.name != "store-id")


def edit(path: Path, *statements: str) -> None:
    """Damage a closed store behind its back."""
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        for statement in statements:
            db.execute(statement)


def disown(path: Path | str, key: bytes | None = None) -> None:
    """Have the owner of the store taken for dead, though it may live."""
    parts = Parts(str(path), key)
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        parts.unlock(db)
        epoch, _, _, *rest = db.execute("SELECT epoch, pid, start, floor, live FROM store").fetchone()
        crc = crc_of(epoch, 0, "", *rest, key=parts.cipher.digest_key)
        db.execute("UPDATE store SET pid = 0, start = '', crc = ?", (crc,))


def flip(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


CHILD = """
import os, random, signal, sys
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.sqlite.row_codec import crc_of
path, what, seed, key = sys.argv[1], sys.argv[2], int(sys.argv[3]), bytes.fromhex(sys.argv[4]) or None
journal = SqliteJournal(path, synchronous="fsync" if seed % 2 else "os", key=key)
print("open", journal.epoch, flush=True)
choose = random.Random(seed)
if what == "hold":
    journal.append([("/app/bank/alice", ("in", 1))])
    print("held", flush=True)
    sys.stdin.read()
if what == "stop":  # in the middle of a transaction, with SQLite's write lock held
    with journal._store.transaction():
        os.kill(os.getpid(), signal.SIGSTOP)
number, live, done = 0, {0: [], 1: []}, 0
while what == "write":
    size = choose.choice([1, 1, 2, 7, 40])
    batch = [(f"/{(number + n) % 2}", ("in", number + n, size, n, "x" * choose.randrange(200))) for n in range(size)]
    for (address, _), position in zip(batch, journal.append(batch)):
        live[int(address[1])].append(position)
    number += size
    os.write(1, b"%d\\n" % number)  # acknowledged
    if choose.random() < 0.1:
        owner = choose.randrange(2)
        snapshot = b"%d " % (number) + b"x" * choose.choice([10, 3 << 20])
        journal.cut(f"/{owner}", snapshot, live[owner], turn=number)
        live[owner] = []
        os.write(1, b"cut %d %d\\n" % (owner, number))
"""


def spawn(path: Path, what: str, seed: int = 0, key: bytes | None = None) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), what, str(seed), (key or b"").hex()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )


def end(child: subprocess.Popen[bytes]) -> bytes:
    """Kill the child; return what it had still said."""
    child.kill()
    return child.communicate()[0]


def line(child: subprocess.Popen[bytes]) -> bytes:
    assert child.stdout is not None
    return child.stdout.readline()
