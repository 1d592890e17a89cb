"""The owner is killed at each operation on its files, within a write and after it: what was acknowledged is there.

A process forks an owner for each step: so it takes a hundredth of a second, not a start of Python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.checkpoint.sqlite.stores import KEY

SOURCE = Path(__file__).with_name("disk.c")
EVERY = 1 if "HOLDFAST_CUTS" in os.environ else 3
"""Each step in a campaign, else each third."""

SERVER = """
import ctypes, os, shutil, sys, traceback
from contextlib import closing
from holdfast.checkpoint.sqlite import SqliteJournal, append_log
append_log.MOST_ROWS = 6
shim, folder, key = ctypes.CDLL(sys.argv[1]), sys.argv[2], bytes.fromhex(sys.argv[4]) or None
steps_left = ctypes.c_long.in_dll(shim, "steps_left")

def live(say):
    journal = SqliteJournal(folder + "/app.db", key=key)
    positions, number = [], 0
    for step, size in enumerate([1, 1, 2, 1, 1, 3, 1, 40, 1, 1, 1, 1, 5, 2, 1, 1]):
        numbers = range(number, number + size)
        positions += journal.append([("/a", ("in", n, size, n - number)) for n in numbers])
        number += size
        say(b"+%d " % number)
        if step in (4, 11):
            journal.sync()
        if step == 6:
            journal.note("key", b"value")
            say(b"n ")
        if step in (8, 13):
            journal.cut("/a", b"%d" % number, positions, turn=number, keep=1 + step % 2)
            say(b"c%d " % number)
    journal.close()
    say(b"end ")

def look(said):
    words = said.split()
    acknowledged = max((int(word[1:]) for word in words if word[:1] in b"+c"), default=0)
    cut = max((int(word[1:]) for word in words if word[:1] == b"c"), default=0)
    with closing(SqliteJournal(folder + "/app.db", key=key)) as journal:
        saved = journal.load("/a")
        known = int(saved.snapshot or b"0")
        found = [entry[1] for _, entry in saved.entries]
        assert known >= cut, (known, said)
        assert found == list(range(known, known + len(found))), (known, found, said)
        assert known + len(found) >= acknowledged, (known, found, said)
        if found:
            _, last, size, place = saved.entries[-1][1]
            assert place == size - 1, f"half of a batch: {saved.entries}"
        assert b"n" not in words or journal.noted("key") == b"value", said
        more = known + len(found)
        journal.append([("/a", ("in", more))])
        assert journal.load("/a").entries[-1][1] == ("in", more)

def forked(do, steps=0):
    out, into = os.pipe()
    pid = os.fork()
    if not pid:
        code = 1
        try:
            steps_left.value = steps
            do(lambda word: os.write(into, word))
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    os.close(into)
    with open(out, "rb") as said:
        heard = said.read()
    return heard, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])

for steps in range(1, 100_000, int(sys.argv[3])):
    shutil.rmtree(folder)
    os.mkdir(folder)
    assert forked(lambda say: SqliteJournal(folder + "/app.db", key=key).close())[1] == 0
    said, code = forked(live, steps)
    assert (code == 0) == (b"end" in said) and code in (0, -9), (steps, said, code)
    heard, found = forked(lambda say: look(said))
    assert found == 0, f"killed at step {steps}, after {said}"
    if code == 0:
        break
print(steps)
"""


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What kills."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    library = tmp_path_factory.mktemp("shim") / "disk.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(SOURCE), "-ldl"], check=True)
    return library


@pytest.mark.parametrize("key", [b"", KEY], ids=["plain", "encrypted"])
def test_what_was_acknowledged_survives_a_kill_at_each_step(shim: Path, tmp_path: Path, key: bytes) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    paths = os.pathsep.join(filter(None, sys.path))
    env = {**os.environ, "PYTHONPATH": paths, "LD_PRELOAD": str(shim)}
    env |= {"DISK_ROOT": str(folder), "DISK_LOG": os.devnull, "DISK_FAIL": "0"}
    command = [sys.executable, "-c", SERVER, str(shim), str(folder), str(EVERY), key.hex()]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 50
