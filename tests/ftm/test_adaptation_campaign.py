"""Mechanisms change, and replicas die, at random and all together: nothing is lost, wrong or done twice."""

from __future__ import annotations

import asyncio
import os
import random
import signal

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from tests.ftm.accounts import Load, Tags
from tests.ftm.test_adaptation import protected, transition
from tests.ftm.test_adaptation_trouble import consistent, struck
from tests.ftm.test_failover import SEED, group_of, pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


@pytest.mark.parametrize("step", ["prepare", "quiesce", "commit"])
async def test_all_replicas_die_and_the_next_life_is_of_one_stack(system: hf.ActorSystem, step: str) -> None:
    ref = await protected(system, recovery=hf.hybrid(interval=0.05))
    load = Load(ref)
    await load.reached(10)

    def kill() -> None:
        for name in ("r1", "r2"):
            os.kill(pid_of(system, ref, name), signal.SIGKILL)

    struck(ref, step, kill)
    await transition(system, ref, LFR(), 60)
    await load.reached(10)
    assert await consistent(system, ref) == ("lfr",)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_random_changes_and_kills_under_load(system: hf.ActorSystem) -> None:
    ref = await protected(system)
    load, rng = Load(ref), random.Random(SEED)
    refused = 0
    for _ in range(12):
        await load.reached(rng.randrange(1, 30))
        killed = rng.choice(["r1", "r2", ""])
        delay = rng.random() * 0.02
        wanted = rng.choice([LFR(), PBR(), (PBR(), TR()), (LFR(), TR())])
        change = asyncio.ensure_future(transition(system, ref, wanted))
        await asyncio.sleep(delay)
        if killed in group_of(ref).membership.names:
            try:
                os.kill(pid_of(system, ref, killed), signal.SIGKILL)
            except (KeyError, ProcessLookupError):
                pass  # It has just been killed.
        try:
            await change
        except hf.TransactionRefused as error:
            refused += "just that already" in str(error)
        await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    await consistent(system, ref)
    assert refused < 12, "nothing was changed"
