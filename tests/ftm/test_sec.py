"""Secured links with real processes, and an attacker who sits on them."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.events import ReplicaJoined
from holdfast.ftm.mechanism import MechanismRefused
from holdfast.ftm.mechanisms.sec import SEC
from holdfast.ftm.sec.authority import CertificationAuthority
from tests.ftm.accounts import Add, Counter, Tags

CA = "/app/ca"


@pytest.fixture
async def secured(system: hf.ActorSystem) -> AsyncIterator[hf.ActorSystem]:
    await system.start(hf.child("ca", hf.start(CertificationAuthority)))
    yield system


def group_of(ref: Any) -> Any:
    return ref._cell.host.group


async def joined(ref: Any, count: int = 2) -> None:
    async with asyncio.timeout(20):
        while group_of(ref) is None or len(group_of(ref).members) < count:
            await asyncio.sleep(0.005)


async def kill_primary(system: hf.ActorSystem, ref: Any) -> None:
    """Returns when another one leads."""
    before = group_of(ref).failovers
    os.kill(system._workers.processes()[f"{ref.path}/ftm/{group_of(ref).primary}"], signal.SIGKILL)
    async with asyncio.timeout(20):
        while group_of(ref).failovers == before:
            await asyncio.sleep(0.002)


STACKS: dict[str, Callable[[], tuple[Any, ...]]] = {
    "SEC": lambda: (SEC(CA),),
    "SEC over PBR": lambda: (SEC(CA), hf.PBR()),
    "SEC over LFR": lambda: (SEC(CA), hf.LFR()),
    "SEC over PBR over TR": lambda: (SEC(CA), hf.PBR(), hf.TR()),
}


@pytest.mark.parametrize("name", STACKS)
async def test_requests_are_answered_over_it(secured: hf.ActorSystem, name: str) -> None:
    """A66, A71."""
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.compose(STACKS[name]())))
    replies = await asyncio.gather(*[ref.ask(Add(n), timeout=20.0) for n in range(200)])
    assert replies == list(range(1, 201))
    assert group_of(ref).link is not None


@pytest.mark.parametrize("name", [name for name in STACKS if name != "SEC"])
async def test_kills_of_the_one_that_leads_lose_and_double_nothing(secured: hf.ActorSystem, name: str) -> None:
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.compose(STACKS[name]())))
    asked: list[asyncio.Future[int]] = []
    for round_ in range(3):
        await joined(ref)
        for n in range(100):
            asked.append(ref.ask(Add(100 * round_ + n), timeout=20.0))
            if n % 10 == 0:
                await asyncio.sleep(0.001)
        await kill_primary(secured, ref)
    assert await asyncio.gather(*asked) == list(range(1, 301))
    assert await ref.ask(Tags()) == list(range(300))
