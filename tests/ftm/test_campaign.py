"""Strikes at random moments: replicas and root-side parts are killed or stopped, a counter and a bank under load.

`HOLDFAST_STRIKES=2000 python -m pytest tests/ftm/test_campaign.py` is the long campaign; `HOLDFAST_SEED` another one.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.accounts import Account, Add, Bank, Counter, Load, Put, Tags, Transfer
from tests.ftm.test_attach import attach, detach
from tests.ftm.test_failover import PARTS, SEED, group_of, two_again

STRIKES = int(os.environ.get("HOLDFAST_STRIKES", "12"))


async def strike(system: hf.ActorSystem, ref: hf.ActorRef[Any], rng: random.Random, *, both: bool) -> str:
    """Hit something; what it was."""
    group = group_of(ref)
    kinds = ["replica", "part", "replica and part", "stop", *(["both"] if both else [])]
    kind = rng.choice(kinds)
    name = rng.choice(group.membership.names)
    pid = system._workers.processes().get(f"{ref.path}/ftm/{name}")
    if pid is None:
        return "nothing"  # It was ended just now.
    cell = group.replicas.cell_of(rng.choice(PARTS))
    if "replica" in kind or kind == "both":
        os.kill(pid, signal.SIGKILL)
    if kind == "both":
        other = next(one for one in group.membership.names if one != name)
        await asyncio.sleep(rng.random() * 0.01)
        pids = system._workers.processes()
        if f"{ref.path}/ftm/{other}" in pids:
            os.kill(pids[f"{ref.path}/ftm/{other}"], signal.SIGKILL)
    if kind == "stop":
        os.kill(pid, signal.SIGSTOP)
    if "part" in kind:
        await asyncio.sleep(rng.random() * 0.02)
        if cell is not None:
            cell.kill()
    if kind != "part":
        async with asyncio.timeout(30):  # A second one at a time would be too many.
            while system._workers.processes().get(f"{ref.path}/ftm/{name}") == pid:
                await asyncio.sleep(0.001)
    return f"{kind} {name}"


async def struck(system: hf.ActorSystem, ref: hf.ActorRef[Any], load: Load, rng: random.Random, *, both: bool) -> None:
    for _ in range(STRIKES):
        await two_again(ref)
        await load.reached(rng.randrange(1, 50))
        await strike(system, ref, rng, both=both)
        await load.reached(5)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags(), timeout=30))


@pytest.mark.parametrize("method", ["without recovery", "hybrid", "replay_only"])
async def test_a_counter_is_struck(system: hf.ActorSystem, method: str) -> None:
    recovery = {"without recovery": None, "hybrid": hf.hybrid(interval=0.05), "replay_only": hf.replay_only()}[method]
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR(), recovery=recovery))
    await struck(system, ref, Load(ref, make=Add), random.Random(f"{SEED} {method}"), both=recovery is not None)


@pytest.mark.parametrize("recorded", [False, True])
async def test_a_bank_is_struck(system: hf.ActorSystem, recorded: bool) -> None:
    """Its accounts are recorded, or not; either way each transfer is made once."""
    account = hf.hybrid() if recorded else None
    one = await system.start(hf.child("one", hf.start(Account, 1000), recovery=account))
    two = await system.start(hf.child("two", hf.start(Account, 1000), recovery=account))
    bindings = {"one": one.path, "other": two.path}
    recovery = hf.hybrid(interval=0.05) if recorded else None
    spec = hf.child("bank", hf.start(Bank), mechanism=PBR(), bindings=bindings, recovery=recovery)
    ref = await system.start(spec)
    load = Load(ref, make=Transfer)
    await struck(system, ref, load, random.Random(f"{SEED} bank {recorded}"), both=recorded)
    assert await one.ask(Put(0)) == 1000 - len(load.answered)
    assert await two.ask(Put(0)) == 1000 + len(load.answered)


@pytest.mark.parametrize("method", ["without recovery", "hybrid"])
async def test_a_mechanism_comes_and_goes_while_replicas_are_struck(system: hf.ActorSystem, method: str) -> None:
    recovery = hf.hybrid(interval=0.05) if method == "hybrid" else None
    ref = await system.start(hf.child("alice", hf.start(Counter), recovery=recovery))
    load, rng = Load(ref), random.Random(f"{SEED} comes and goes {method}")
    for _ in range(max(2, STRIKES // 3)):
        await load.reached(rng.randrange(1, 50))
        await attach(system, ref)
        if rng.random() < 0.7:
            await strike(system, ref, rng, both=False)
            await load.reached(5)
        if rng.random() < 0.7:
            await two_again(ref)
        try:
            await detach(system, ref)
        except hf.TransactionFailed:  # It was struck in the middle of it: it stays protected, and goes on.
            assert isinstance(ref._cell.host.place, GroupPlace)
            await load.reached(5)
            await two_again(ref)
            await detach(system, ref)
    await load.reached(5)
    await load.stop()
    load.check(await ref.ask(Tags(), timeout=30))
