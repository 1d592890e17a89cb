"""Helper processes of holdfast that a signal has stopped, or that hang: everything goes on, within limits, and nobody is left."""

from __future__ import annotations

import asyncio
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import psutil
import pytest

import holdfast as hf
from tests.actors.process.waiting import next_event, until
from tests.supervision.programs import FAMILY, PYTHON, STUBBORN, Ends, info, keeper_of, python
from tests.warm import own_children

FAMILY_UP = FAMILY.replace("time.sleep(99)\n", "time.sleep(99)\nprint('up', flush=True)\n", 1).rstrip()
BEATS = "import time\nwhile True:\n    print('up', flush=True)\n    time.sleep(0.05)"
PTRACE_SEIZE, PTRACE_INTERRUPT = 0x4206, 0x4207


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.fixture
def ends() -> Iterator[Ends]:
    found = Ends()
    yield found
    for fd in found.fds:
        os.close(fd)


def hang(pid: int) -> None:
    """Hold a child of ours as a debugger does: SIGCONT does not have it go on, and SIGKILL ends it."""
    ptrace = ctypes.CDLL(None, use_errno=True).ptrace
    ptrace.argtypes, ptrace.restype = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p], ctypes.c_long
    if ptrace(PTRACE_SEIZE, pid, None, None):
        pytest.skip(f"nobody may be traced here: {os.strerror(ctypes.get_errno())}")
    assert ptrace(PTRACE_INTERRUPT, pid, None, None) == 0
    os.waitpid(pid, 0x40000000)  # __WALL: until it is held


def stop(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)


def die(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


def go_on(pid: int) -> None:
    """Nothing: it is healthy."""


FATES = pytest.mark.parametrize("fate", [stop, hang, die])
"""Of the keeper."""


@FATES
@pytest.mark.parametrize("state", [go_on, stop, die])
async def test_a_program_is_stopped_whatever_has_become_of_its_keeper(
    system: hf.ActorSystem, ends: Ends, fate, state
) -> None:
    ref = await system.start(python(STUBBORN, ready="up", shutdown=0.1, restart="temporary"))
    pid = (await info(system)).pid
    keeper = keeper_of(pid).pid
    ends.add(pid, keeper)
    fate(keeper)
    state(pid)
    begin = time.monotonic()
    await system.stop(ref)
    assert time.monotonic() - begin < 4.0
    assert not own_children()
    await ends.all()
