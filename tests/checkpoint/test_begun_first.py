"""A turn that has sent something is the first of the next life, whatever the hooks of that life put back."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tmr import TMR
from holdfast.ftm.mechanisms.tr import TR


class Put(hf.Message[int]):
    n: int


class Fetch(hf.Message[int]):
    n: int


class Read(hf.Message[list[int]]): ...


class Wait(hf.Message[int]):
    """Answered when somebody has said so."""


class Asked(hf.Message[int]):
    """Answered when somebody waits."""


class Open(hf.Message[None]):
    """All are answered from now on."""


class Gate(hf.Actor):
    def __init__(self) -> None:
        self._waiting: list[hf.ReplyHandle[int]] = []
        self._watching: list[hf.ReplyHandle[int]] = []

    @hf.on(Wait)
    def wait(self, message: Wait) -> hf.ReplyHandle[int]:
        self._waiting.append(self.ctx.reply_handle())
        for handle in self._watching:
            handle.reply(0)
        return self._waiting[-1]

    @hf.on(Asked)
    def asked(self, message: Asked) -> hf.ReplyHandle[int]:
        self._watching.append(self.ctx.reply_handle())
        return self._watching[-1]

    @hf.on(Open)
    def open(self, message: Open) -> None:
        for handle in self._waiting:
            handle.reply(0)


class Let(hf.Message[int]):
    """Nothing is put aside any more."""


class Returning(hf.Actor):
    """What it has put aside comes back in the next life: by this hook."""

    def __init__(self, hook: str) -> None:
        self.hook, self.seen, self.is_open = hook, list[int](), False

    def on_start(self, restored: bool) -> None:
        if self.hook == "on_start":
            self.ctx.unstash()

    def on_recovered(self) -> None:
        if self.hook == "on_recovered":
            self.ctx.unstash()

    @hf.on(Put)
    def put(self, message: Put) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        self.seen.append(message.n)
        return message.n

    @hf.on(Let)
    def let(self, message: Let) -> int:
        self.is_open = True
        return 0

    @hf.on(Fetch)
    async def fetch(self, message: Fetch) -> int:
        await self.ctx.find("/app/gate", Gate).ask(Wait(), timeout=25.0)
        self.seen.append(message.n)
        return message.n

    @hf.on(Read, readonly=True)
    def read(self, message: Read) -> list[int]:
        return list(self.seen)


STACKS: dict[str, Any] = {"none": None, "pbr": PBR(), "lfr": LFR(), "tr": TR(), "tmr": TMR()}


@pytest.mark.parametrize("hook", ["on_start", "on_recovered"])
@pytest.mark.parametrize(
    ("stack", "who"),
    [*((stack, "all") for stack in STACKS), ("process", "all"), ("pbr", "leader")],
)
async def test_what_has_sent_something_comes_before_what_a_hook_puts_back(
    system: hf.ActorSystem, stack: str, who: str, hook: str
) -> None:
    events = system.events()
    gate = await system.start(hf.child("gate", hf.start(Gate)))
    ref = await system.start(
        hf.child(
            "alice",
            hf.start(Returning, hook),
            mechanism=STACKS.get(stack),
            isolation="process" if stack == "process" else "task",
            recovery=hf.hybrid(interval=3600.0),
        )
    )
    if STACKS.get(stack) is not None:
        async with asyncio.timeout(25):
            while not (await system.protection(ref)).is_whole:
                await asyncio.sleep(0.005)
    put = [ref.ask(Put(n), timeout=25.0) for n in (1, 2)]
    assert await ref.ask(Let(), timeout=25.0) == 0
    await system.checkpoint(ref)
    watching = gate.ask(Asked(), timeout=25.0)
    fetched = ref.ask(Fetch(3), timeout=25.0)
    await watching
    if who == "all":
        ref.kill()
    else:
        leader = (await system.protection(ref)).leader
        pid = system.pid_of(system.ref(f"{ref.path}/ftm/{leader}", hf.Actor))
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
    await gate.ask(Open(), timeout=25.0)
    assert await fetched == 3
    if who == "leader" and hook == "on_recovered":  # That is not called by a failover.
        ref.kill()
    assert await asyncio.gather(*put) == [1, 2]
    assert await ref.ask(Read(), timeout=25.0) == [3, 1, 2]
    assert not [one for one in events.take() if isinstance(one, hf.events.RecoveryFailed)]
