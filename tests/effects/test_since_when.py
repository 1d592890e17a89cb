"""Whoever looks at a turn that rests hears since when it does, over the ends of its process and of the program."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.control.orders import Status
from tests.effects.clerk import IN_TIME
from tests.effects.patient import Go, patient
from tests.effects.test_clocks_set import set_clock

LATER = 1000.0


class Pay(hf.Message): ...


class Till(hf.Actor):
    @hf.on(Pay)
    async def pay(self, message: Pay) -> None:
        await self.ctx.effect(asyncio.sleep, 3600.0, key="pay")


async def resting(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> Status:
    """The status as soon as the turn rests."""
    async with asyncio.timeout(IN_TIME):
        while not (status := await system.get_status(ref)).turn_rests:
            await asyncio.sleep(0.01)
    return status


@pytest.mark.parametrize("step", ["s9999", "c9999", "c", "u9999999999"])
async def test_the_next_program_tells_since_when_a_turn_rests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", log=False, store=store) as system:
        ref = await system.start(patient())
        ref.tell(Go(["s0", step]))
        assert (await resting(system, ref)).turn_seconds < LATER
    async with hf.ActorSystem("app", log=False, store=store) as system:
        set_clock(monkeypatch, system, LATER)
        status = await resting(system, await system.start(patient()))
        assert LATER <= status.turn_seconds < LATER + IN_TIME
        (rest,) = system._node.cell_at(ref.path).host.rests(system._node.cell_at(ref.path))
        assert LATER <= system._node.clock.wall() - rest.since < LATER + IN_TIME


async def test_an_effect_that_is_out_again_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = hf.child("till", hf.start(Till), recovery=hf.hybrid(), shutdown="brutal_kill")
    store = f"sqlite:{tmp_path / 'app.db'}"
    for again in ("has been", "was out before, and has been out again"):
        async with hf.ActorSystem("app", log=False, store=store) as system:
            ref = await system.start(spec)
            if again == "has been":
                ref.tell(Pay())
            assert (await resting(system, ref)).turn_rests.startswith(f"waits for the effect pay, which {again}")


async def test_what_rests_in_a_process_does_not_wait_in_its_mailbox_and_survives_that() -> None:
    async with hf.ActorSystem("app", log=False, intensity=9) as system:
        ref = await system.start(patient("process"))
        begun = asyncio.get_running_loop().time()
        ref.tell(Go(["s0", "c9999"]))
        status = await resting(system, ref)
        ref.tell(Go(["c"]))
        cell = system._node.cell_at(ref.path)
        assert (status.queued, cell.host.backlog(cell), cell.host.work(cell).is_in_turn) == (0, 1, True)
        rested = asyncio.get_running_loop().time()
        os.kill(system.pid_of(ref), signal.SIGKILL)
        async with asyncio.timeout(IN_TIME):
            while (status := await system.get_status(ref)).life == 1 or not status.turn_rests or status.queued > 1:
                await asyncio.sleep(0.01)
        now = asyncio.get_running_loop().time()
        assert now - rested - 0.1 < status.turn_seconds < now - begun + 0.1
