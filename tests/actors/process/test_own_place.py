"""A place of one's own is one class: here a process that leaves the processor to others. Any home goes with it."""

from __future__ import annotations

import os
import signal
from typing import Any

import psutil
import pytest

import holdfast as hf
from holdfast.actors.kernel.address_host import AddressHost
from holdfast.actors.kernel.lifecycle import NEAR
from holdfast.actors.process.process_host import FLIGHT, WorkerPlace
from holdfast.actors.process.worker_pool import Worker
from holdfast.checkpoint.home.journal_home import JournalHome
from holdfast.supervision.spec import ChildSpec

NICE = 7


class NicePlace(WorkerPlace):
    """A process with a low priority."""

    async def fork(self, *, again: bool = False) -> Worker:
        worker = await super().fork(again=again)
        os.setpriority(os.PRIO_PROCESS, worker.pid, NICE)
        return worker


class NiceSystem(hf.ActorSystem):
    """A system whose processes are such places."""

    def _host_for(self, spec: ChildSpec) -> AddressHost:
        if spec.isolation != "process":
            return super()._host_for(spec)
        recovery = spec.recovery
        home = FLIGHT if recovery is None else JournalHome(self._homes, recovery, NEAR)
        return AddressHost(home, NicePlace(home, NEAR, self._workers, spec.limits), NEAR)


class Add(hf.Message[int]):
    number: int


class Sum(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.number
        return self.total


def nice_of(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> int:
    return int(psutil.Process(system.pid_of(ref)).nice())


@pytest.mark.parametrize(("recovery", "after_kill"), [(None, 1), (hf.hybrid(), 4)], ids=["plain", "recorded"])
async def test_lives_begin_there_move_there_and_back_and_are_restarted_there(
    recovery: hf.Method | None, after_kill: int
) -> None:
    async with NiceSystem("app", log=False, intensity=10) as system:
        ref = await system.start(hf.child("sum", hf.start(Sum), isolation="process", recovery=recovery))
        assert await ref.ask(Add(1)) == 1
        assert nice_of(system, ref) == NICE
        await system.set_isolation(ref, "task", timeout=60.0)
        assert await ref.ask(Add(1)) == 2
        assert system.pid_of(ref) == os.getpid()
        await system.set_isolation(ref, "process", timeout=60.0)
        assert await ref.ask(Add(1)) == 3
        assert nice_of(system, ref) == NICE
        os.kill(system.pid_of(ref), signal.SIGKILL)
        assert await ref.ask(Add(1), timeout=60.0) == after_kill
        assert nice_of(system, ref) == NICE
