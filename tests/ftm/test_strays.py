"""A follower that is wrong for good, in a process of its own: it does not count, is ended, and begins again, slowly."""

from __future__ import annotations

import asyncio
from typing import Any

import holdfast as hf
from holdfast.ftm.mechanisms.lfr import LFR
from tests.ftm.accounts import Counter, Load, Tags
from tests.ftm.test_failover import group_of, two_again
from tests.ftm.versions import FAULTY


async def test_a_follower_that_is_wrong_for_good_is_ended_and_the_next_one_joins(system: hf.ActorSystem) -> None:
    """Nothing is lost, wrong or doubled meanwhile, and nobody waits for it."""
    layers = LFR(), FAULTY(what="state", always=True, skip=5, replica="r2")
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=layers))
    await two_again(ref)
    load, seen = Load(ref, clients=2), list[Any]()
    with system.events() as events:
        async with asyncio.timeout(60):
            while sum(isinstance(one, hf.events.ReplicaFaulty) for one in seen) < 2:
                seen += events.take()
                await asyncio.sleep(0.005)
        await load.reached(20)
    await load.stop()
    faulty = [one for one in seen if isinstance(one, hf.events.ReplicaFaulty)]
    assert {(one.replica, one.times) for one in faulty} == {("r2", 3)}
    assert not any(isinstance(one, hf.events.FailedOver) for one in seen)
    assert group_of(ref).membership.primary == "r1"
    load.check(await ref.ask(Tags()))
