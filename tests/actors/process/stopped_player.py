"""Actors whose processes have helpers that a signal stops."""

from __future__ import annotations

import os
import signal

import numpy as np

import holdfast as hf
from holdfast.checkpoint.snapshot import image_writer


class Pid(hf.Message[int]):
    """Asks for the number of the process."""


class Compute(hf.Message[str]):
    """Has a function run in a process of its own, which is stopped meanwhile."""


def stopped() -> str:
    os.kill(os.getpid(), signal.SIGSTOP)
    return "it went on"


class Member(hf.Actor):
    """Lives in a process, and has functions run in others."""

    @hf.on(Pid)
    def pid(self, message: Pid) -> int:
        return os.getpid()

    @hf.on(Compute)
    async def compute(self, message: Compute) -> str:
        return await self.ctx.effect(stopped, isolation="process")


class Large(hf.Actor):
    """Has a state that a forked process writes, which is stopped before it does."""

    def __init__(self) -> None:
        self.state = np.arange(image_writer.FORK_BYTES // 8 + 1)
        write = image_writer.__dict__["_write_and_exit"]

        def stops_before(*arguments: object) -> None:
            stopped()
            write(*arguments)

        image_writer.__dict__["_write_and_exit"] = stops_before

    @hf.on(Pid)
    def pid(self, message: Pid) -> int:
        return os.getpid()
