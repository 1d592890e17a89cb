"""A program whose system calls are made to fail: two recorded ledgers are asked, one of them in a process.

It notes what was acknowledged in memory that it shares with whoever looks, since a file could not be written to either.
"""

from __future__ import annotations

import asyncio
import ctypes
import faulthandler
import mmap
import os
import resource
import signal
import sys
from pathlib import Path

import holdfast as hf

ROUNDS = 40
NAMES = ("task", "process")
SECONDS = 10.0
LONGEST = 150
"""Seconds after which the kernel ends the program; for each of its processes, seconds of computing."""
PR_SET_PDEATHSIG, PR_SET_PTRACER = 1, 0x59616D61


class Enter(hf.Message[int]):
    number: int


class Entered(hf.Message[list[int]]):
    pass


class Ledger(hf.Actor):
    def __init__(self) -> None:
        self.numbers: list[int] = []

    @hf.on(Enter)
    def enter(self, message: Enter) -> int:
        self.numbers.append(message.number)
        return message.number

    @hf.on(Entered)
    def entered(self, message: Entered) -> list[int]:
        return self.numbers


def tree(*, processes: bool) -> hf.ChildSpec:
    children = [
        hf.child(
            name,
            hf.start(Ledger),
            isolation="process" if processes and name == "process" else "task",
            recovery=hf.hybrid(interval=0.2),
        )
        for name in NAMES
    ]
    return hf.supervisor("bank", intensity=20, period=1.0, children=children)


def store_of(folder: Path) -> str:
    return f"sqlite:{folder / 'app.db'}"


async def work(folder: Path, acknowledged: mmap.mmap) -> None:
    async with hf.ActorSystem("app", log=False, store=store_of(folder), durability="fsync") as system:
        await system.start(tree(processes=True))
        ledgers = [system.ref(f"/app/bank/{name}", Ledger) for name in NAMES]
        for number in range(ROUNDS):
            for at, ledger in enumerate(ledgers):
                try:
                    assert await ledger.ask(Enter(number), timeout=SECONDS) == number
                    acknowledged[at * ROUNDS + number] = 1
                except (hf.HoldfastError, TimeoutError) as error:
                    print(f"{type(error).__name__}: {error}", flush=True)
            if number == ROUNDS // 2:
                try:
                    await system.checkpoint(ledgers[0])
                    os.kill(system.pid_of(ledgers[1]), signal.SIGKILL)
                except (hf.HoldfastError, OSError) as error:
                    print(f"{type(error).__name__}: {error}", flush=True)


def be_bounded() -> None:
    """Let anybody trace us, and let the kernel end us: whoever runs us may be killed and can then see to nothing."""
    prctl = ctypes.CDLL(None).prctl
    prctl(PR_SET_PTRACER, ctypes.c_ulong(-1), 0, 0, 0)
    prctl(PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGKILL), 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
    signal.alarm(LONGEST)


def main() -> None:
    """Wait for the word, then work."""
    folder, loop = Path(sys.argv[1]), sys.argv[2]
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    be_bounded()
    with open(folder / "acknowledged", "r+b") as file:
        acknowledged = mmap.mmap(file.fileno(), 0)
    os.write(1, b"ready\n")
    sys.stdin.buffer.readline()
    if loop == "uvloop":
        hf.run(work(folder, acknowledged))
    else:
        asyncio.run(work(folder, acknowledged))
