"""External programs for tests: what is run, and what is asked of it."""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any

import psutil
import pytest

import holdfast as hf
from tests.actors.process.waiting import end_of, next_event

PTRACE_DETACH, PTRACE_SEIZE, PTRACE_INTERRUPT, WALL = 17, 0x4206, 0x4207, 0x40000000
PYTHON = [sys.executable, "-I", "-S", "-c"]
STUBBORN = (
    "import signal, time\nfor n in (2, 15): signal.signal(n, signal.SIG_IGN)\nprint('up', flush=True)\ntime.sleep(99)"
)
"""Ignores what asks it to end."""
FAMILY = """
import os, signal, time
for away in (False, True):
    if os.fork() == 0:
        if away:
            os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        print(os.getpid(), flush=True)
        time.sleep(99)
time.sleep(99)
"""
"""Has two descendants that ignore SIGTERM; one has left its session."""


def sh(script: str, **options: Any) -> hf.ChildSpec:
    return hf.supervision.program(["sh", "-c", script], id=options.pop("id", "it"), **options)


def python(script: str, **options: Any) -> hf.ChildSpec:
    return hf.supervision.program([*PYTHON, script], id=options.pop("id", "it"), **options)


async def info(system: hf.ActorSystem, path: str = "/app/it") -> hf.supervision.ProgramStatus:
    return await system.ref(path, hf.supervision.Program).ask(hf.supervision.ProgramInfo(), 30)


async def refused(system: hf.ActorSystem, spec: hf.ChildSpec) -> str:
    with pytest.raises(hf.StartFailed) as caught:
        await system.start(spec)
    return str(caught.value)


def keeper_of(pid: int) -> psutil.Process:
    found = psutil.Process(pid).parent()
    assert found is not None
    assert "reaper.py" in " ".join(found.cmdline())
    return found


def ptrace(request: int, pid: int) -> int:
    call = ctypes.CDLL(None, use_errno=True).ptrace
    call.argtypes, call.restype = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p], ctypes.c_long
    return int(call(request, pid, None, None))


def hang(pid: int) -> None:
    """Hold a child of this process as a debugger does: SIGCONT does not have it go on; SIGKILL ends it."""
    if ptrace(PTRACE_SEIZE, pid):
        pytest.skip(f"nobody can be held here: {os.strerror(ctypes.get_errno())}")
    assert ptrace(PTRACE_INTERRUPT, pid) == 0
    os.waitpid(pid, WALL)


def let_go(pid: int) -> None:
    """Have one that `hang` holds go on."""
    assert ptrace(PTRACE_DETACH, pid) == 0


class Ends:
    """Descriptors of processes, so that their end can be awaited, whoever reaps them."""

    def __init__(self) -> None:
        self.fds: list[int] = []

    def add(self, *pids: int) -> None:
        self.fds.extend(os.pidfd_open(pid) for pid in pids)

    async def all(self) -> None:
        for fd in self.fds:
            await end_of(fd)


async def family(system: hf.ActorSystem, spec: hf.ChildSpec) -> tuple[int, list[int]]:
    """Start a FAMILY: its pid, and those of its descendants."""
    with system.events() as events:
        await system.start(spec)
        pids = [int((await next_event(events, hf.events.LogLine)).text) for _ in range(2)]
    return (await info(system)).pid, pids
