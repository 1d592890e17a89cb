"""What the kernel refuses while a forked process writes a snapshot: it is told, and nothing of that snapshot stays."""

from __future__ import annotations

import os
import subprocess
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from tests.checkpoint.strikes import NEVER, event
from tests.faults.traced import can_trace

pytestmark = pytest.mark.skipif(not can_trace(), reason="needs strace, and the right to trace")

MANY = 3_000_000
"""Cells of a grid that is written by a forked process, if there is little to write."""


class Change(hf.Message[None]): ...


class Held(hf.Message[tuple[int, int]]):
    """How many descriptors are open, and how many children there are."""


class Grid(hf.Actor):
    def __init__(self) -> None:
        self.grid = np.zeros(MANY)
        self.turns = 0

    @hf.on(Change)
    def change(self, message: Change) -> None:
        self.turns += 1

    @hf.on(Held, readonly=True)
    def held(self, message: Held) -> tuple[int, int]:
        with open(f"/proc/self/task/{os.getpid()}/children") as children:
            return len(os.listdir("/proc/self/fd")), len(children.read().split())


@pytest.mark.parametrize("call", ["memfd_create", "clone", "pidfd_open", "epoll_ctl"])
async def test_nothing_stays_of_a_snapshot_that_cannot_be_written(call: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        recovery = hf.hybrid(interval=NEVER)
        ref: Any = await system.start(hf.child("grid", hf.start(Grid), isolation="process", recovery=recovery))
        for _ in range(2):
            await ref.ask(Change(), timeout=60.0)
            await system.checkpoint(ref, timeout=60.0)
        await ref.ask(Change(), timeout=60.0)
        before = await ref.ask(Held(), timeout=60.0)
        tracer = subprocess.Popen(
            ["strace", "-p", str(system.pid_of(ref)), "-o", "/dev/null",
             "-e", f"trace={call}", "-e", f"inject={call}:error=ENOMEM"],
            stderr=subprocess.PIPE,
        )  # fmt: skip
        assert tracer.stderr is not None
        try:
            assert b"attached" in tracer.stderr.readline()
            with system.events() as stream:
                with pytest.raises(hf.HoldfastError, match="Cannot allocate memory"):
                    await system.checkpoint(ref, timeout=60.0)
                await event(stream, hf.events.SnapshotFailed)
        finally:
            tracer.terminate()
            tracer.wait()
            tracer.stderr.close()
        assert await ref.ask(Held(), timeout=60.0) == before
        await system.checkpoint(ref, timeout=60.0)
