"""System calls fail under a running system: nothing acknowledged is lost, it ends in time, errors name the cause."""

from __future__ import annotations

import asyncio
import errno
import math
import os
import random
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

import holdfast as hf
from tests.faults.ledgers import NAMES, ROUNDS, Entered, Ledger, store_of, tree
from tests.faults.traced import can_trace, end_all

RUNS = int(os.environ.get("HOLDFAST_SYSCALLS", "0"))
"""Faults drawn by the seed; some that are always the same without it."""
SEED = int(os.environ.get("HOLDFAST_SEED", "1"))
WITHIN = 120.0
"""Seconds in which everything ends, on a busy machine, also if each process and each ask takes its longest time."""

# Not among them: what uvloop itself cannot do without (eventfd, epoll), where it ends the process at once.
# Of epoll, see `test_watches.py`.
KINDS = {
    "sync": ("fsync,fdatasync", "EIO ENOSPC", 120),
    "write a file": ("pwrite64,pwritev,pwritev2", "ENOSPC EIO EDQUOT", 60),
    "open": ("openat,open", "EMFILE ENFILE EIO EPERM ENOMEM", 300),
    "size": ("ftruncate,fallocate", "ENOSPC EIO ENOMEM", 20),
    "name": ("rename,renameat,renameat2,link,linkat,unlink,unlinkat,mkdir,mkdirat", "EIO ENOSPC EPERM EROFS", 20),
    "lock": ("flock,fcntl", "ENOLCK EIO", 60),
    "process": ("clone,clone3,fork,vfork,execve", "EAGAIN ENOMEM", 12),
    "socket": ("socketpair,pipe2,memfd_create,pidfd_open,dup,dup3", "EMFILE ENFILE ENOMEM", 12),
    "message": ("sendmsg,recvmsg", "ENOBUFS ENOMEM", 20),
    "bytes": ("write,writev,read,sendto,recvfrom", "ENOMEM EIO ENOBUFS ENOSPC", 300),
    "signal": ("pidfd_send_signal,kill", "EPERM", 4),
    "memory": ("mmap,mremap", "ENOMEM", 200),
}


class Fault(NamedTuple):
    """The call that fails, with which error, at which of its times in each process; `lasts`: and ever after."""

    kind: str
    error: str
    when: int
    lasts: bool
    loop: str = "uvloop"

    def __str__(self) -> str:
        return f"{self.kind}-{self.error}-{self.when}{'+' if self.lasts else ''}-{self.loop}"

    @property
    def option(self) -> str:
        return f"inject={KINDS[self.kind][0]}:error={self.error}:when={self.when}{'+' if self.lasts else ''}"


OF_SQLITE = {
    "EIO": ["disk I/O error", "unable to open database file"],
    "ENOSPC": ["database or disk is full", "disk I/O error"],
    "EDQUOT": ["disk I/O error"],
    "EMFILE": ["unable to open database file"],
    "ENFILE": ["unable to open database file"],
    "EPERM": ["unable to open database file", "disk I/O error"],
    "ENOMEM": ["out of memory", "MemoryError", "disk I/O error", "unable to open database file"],
    "ENOLCK": ["database is locked", "disk I/O error", "locking protocol"],
    "EROFS": ["disk I/O error", "unable to open database file"],
}
"""What SQLite makes of it."""

ALWAYS = [
    Fault("sync", "EIO", 9, lasts=False),
    Fault("write a file", "EIO", 47, lasts=True),  # while the store is made
    Fault("socket", "EMFILE", 4, lasts=True),
    Fault("signal", "EPERM", 1, lasts=False, loop="asyncio"),
]


def draw(number: int) -> Fault:
    chance = random.Random(f"{SEED} {number}")
    kind = chance.choice(list(KINDS))
    _, errors, most = KINDS[kind]
    when = round(math.exp(chance.uniform(0.0, math.log(most))))
    return Fault(kind, chance.choice(errors.split()), when, chance.random() < 0.3, chance.choice(["uvloop", "asyncio"]))


FAULTS = [draw(number) for number in range(RUNS)] or ALWAYS

PROGRAM = "import sys; sys.path.append(sys.argv.pop()); from tests.faults.ledgers import main; main()"
ROOT = Path(__file__).parents[2]


pytestmark = pytest.mark.skipif(not can_trace(), reason="needs strace, and the right to trace")


class Outcome(NamedTuple):
    code: int
    said: str
    acknowledged: list[list[int]]


def run(fault: Fault, folder: Path) -> Outcome:
    """The program, with the fault, to its end."""
    notes = folder / "acknowledged"
    notes.write_bytes(bytes(len(NAMES) * ROUNDS))
    with open(folder / "said", "wb") as said:
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(folder), fault.loop, str(ROOT)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, cwd=folder,
        )  # fmt: skip
    assert program.stdin is not None
    assert program.stdout is not None
    assert program.stdout.readline() == b"ready\n"
    calls, option = KINDS[fault.kind][0], fault.option
    tracer = subprocess.Popen(
        ["strace", "-f", "-p", str(program.pid), "-o", str(folder / "calls"), "-e", f"trace={calls}", "-e", option],
        stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        assert tracer.stderr is not None
        assert b"attached" in tracer.stderr.readline()
        try:
            out, _ = program.communicate(b"go\n", timeout=WITHIN)
        except subprocess.TimeoutExpired:
            program.send_signal(signal.SIGUSR1)  # It prints its stacks.
            pytest.fail(f"it does not end: {_end(folder)}")
        try:
            tracer.wait(30)
        except subprocess.TimeoutExpired:
            pytest.fail(f"a process is left behind: {_end(folder)}")
    finally:
        end_all(program, tracer, folder)
    text = out.decode() + (folder / "said").read_text(errors="replace")
    memory = notes.read_bytes()
    acknowledged = [[number for number in range(ROUNDS) if memory[at * ROUNDS + number]] for at in range(len(NAMES))]
    return Outcome(program.returncode, text, acknowledged)


def _end(folder: Path) -> str:
    struck = [line for line in (folder / "calls").read_text(errors="replace").splitlines() if "INJECTED" in line]
    return "\n".join([*struck[-5:], (folder / "said").read_text(errors="replace")[-6000:]])


async def kept(folder: Path) -> list[list[int]]:
    """What is there when nothing fails any more."""
    async with hf.ActorSystem("app", log=False, store=store_of(folder)) as system:
        await system.start(tree(processes=False))
        return [await system.ref(f"/app/bank/{name}", Ledger).ask(Entered(), timeout=60.0) for name in NAMES]


@pytest.mark.parametrize("fault", FAULTS, ids=str)
def test_a_call_that_fails(fault: Fault, tmp_path: Path) -> None:
    outcome = run(fault, tmp_path)
    print(
        f"{fault}: exit code {outcome.code}, acknowledged {[len(one) for one in outcome.acknowledged]}\n{outcome.said}"
    )
    struck = "INJECTED" in (tmp_path / "calls").read_text(errors="replace")
    if not struck:
        assert outcome.code == 0
    assert outcome.code in (0, 1), "it did not end by itself"
    for name, acknowledged, there in zip(NAMES, outcome.acknowledged, asyncio.run(kept(tmp_path)), strict=True):
        assert len(there) == len(set(there)), f"{name}: done twice"
        assert set(acknowledged) <= set(there), f"{name}: lost"
    if outcome.code:
        what = (os.strerror(getattr(errno, fault.error)), *OF_SQLITE.get(fault.error, ()), "has died")
        assert any(words in outcome.said for words in what), "it does not say what failed"
        assert re.search(r"/app|store |fork server|^ImportError: |get_data", outcome.said, re.MULTILINE), (
            "it does not say where"
        )
