"""Behind many losses the second replica is back as soon as behind the first: no kill makes the next one cost more."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm import LFR, PBR
from holdfast.testing import GuardedSystem, Simulation, simulate
from tests.ftm.accounts import Counter

LOSSES = 30
BACK_WITHIN = 1.0
"""Seconds that a group may be without its second replica."""


@pytest.mark.parametrize("every", [0.6, 1.3, 3.0])
@pytest.mark.parametrize("mechanism", [PBR(), LFR()], ids=["pbr", "lfr"])
@pytest.mark.some(3)
def test_a_replica_that_is_lost_at_a_steady_rate_is_back_within_a_second(mechanism: Any, every: float) -> None:
    @simulate(seed=7, intensity=10_000)
    async def losses(system: GuardedSystem, simulation: Simulation) -> None:
        system.expect_crashes()
        system.expect_dead_letters()
        ref = await system.start(hf.child("safe", hf.start(Counter), recovery=hf.hybrid(), mechanism=mechanism))
        alone: list[float] = []
        for _ in range(LOSSES):
            leader = (await system.protection(ref)).leader
            simulation.kill_process(system.ref(f"{ref.path}/ftm/{leader}", hf.Actor))
            begin = asyncio.get_running_loop().time()
            await asyncio.sleep(0.01)
            while not (await system.protection(ref)).is_whole:
                await asyncio.sleep(0.01)
            alone.append(asyncio.get_running_loop().time() - begin)
            await asyncio.sleep(max(0.0, every - alone[-1]))
        assert max(alone) <= BACK_WITHIN, alone

    losses()
