"""Each mechanism with real processes: SIGKILL of the one that leads, again and again, while requests flow."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.events import ReplicaJoined
from holdfast.ftm.model.mechanism import COMMON
from tests.ftm.accounts import Add, Counter, Tags

STACKS = {
    "PBR": (hf.ftm.PBR(),),
    "LFR": (hf.ftm.LFR(),),
    "PBR over TR": (hf.ftm.PBR(), hf.ftm.TR()),
    "LFR over TR": (hf.ftm.LFR(), hf.ftm.TR()),
}


@pytest.mark.parametrize("name", STACKS)
async def test_kills_of_the_one_that_leads_lose_and_double_nothing(system: hf.ActorSystem, name: str) -> None:
    """A57-A59."""
    mechanism: Any = hf.ftm.compose(STACKS[name])
    events = system.events()
    ref = await system.start(hf.child("c", hf.start(Counter), mechanism=mechanism))
    asked: list[asyncio.Future[int]] = []
    for round_ in range(3):
        async with asyncio.timeout(20):
            while not any(isinstance(one, ReplicaJoined) for one in events.take()):
                await asyncio.sleep(0.01)
        for n in range(100):
            asked.append(ref.ask(Add(100 * round_ + n), timeout=20.0))
            if n % 10 == 0:
                await asyncio.sleep(0.001)
        group = ref._cell.host.place.group  # type: ignore[attr-defined]
        pid = system._workers.processes()[f"{ref.path}/ftm/{group.membership.primary}"]
        os.kill(pid, signal.SIGKILL)
    replies = await asyncio.gather(*asked)
    events.close()
    assert replies == list(range(1, 301))
    assert await ref.ask(Tags()) == list(range(300))


class Known(hf.Message[list[str]]): ...


class Modules(hf.Actor):
    """Says what its process has imported."""

    @hf.on(Known)
    def known(self, message: Known) -> list[str]:
        return [name for name in COMMON if name in sys.modules]


async def test_a_replica_has_what_it_may_change_over_to(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("c", hf.start(Modules), mechanism=hf.ftm.PBR()))
    assert await ref.ask(Known()) == list(COMMON)
