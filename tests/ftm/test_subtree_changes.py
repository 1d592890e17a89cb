"""The mechanism of an actor below a supervisor in another process is changed, by the same transactions as anywhere."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.subtree import SubtreeHome
from holdfast.ftm.adaptation import STEPS
from holdfast.ftm.host import GroupHost
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.subtree import SubtreeGroup
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.test_failover import METHODS, group_of, pid_of, two_again
from tests.ftm.test_subtree import RECOVERIES, at, bank, bank_pid, protected

# A refused or failed transaction ends with its block.
# ruff: noqa: PT012


def names_of(ref: hf.ActorRef[Any]) -> list[str]:
    assert isinstance(ref._cell.host, GroupHost)
    return [layer.name for layer in ref._cell.host.layers]


@pytest.mark.parametrize("method", RECOVERIES)
async def test_its_mechanism_is_changed_under_load(system: hf.ActorSystem, method: str) -> None:
    await system.start(bank(protected("alice", recovery=METHODS[method]())))
    alice = at(system, "alice")
    load = Load(alice)
    await load.reached(20)
    async with system.transaction(timeout=30) as change:
        change.transition(alice, LFR())
    assert names_of(alice) == ["lfr"]
    await load.reached(20)
    async with system.transaction(timeout=30) as change:
        change.compose(alice, TR())
        change.transition(alice, PBR())
    assert names_of(alice) == ["pbr", "tr"]
    await load.reached(20)
    await two_again(alice)
    os.kill(pid_of(system, alice, group_of(alice).primary or ""), signal.SIGKILL)
    await load.reached(20)
    await load.stop()
    load.check(await alice.ask(Tags()))
    assert alice._cell.life == 1


@pytest.mark.parametrize("who", ["alice", "inner/deep"])
async def test_the_new_stack_holds_over_restarts_of_the_child_and_of_the_subtree(
    system: hf.ActorSystem, who: str
) -> None:
    await system.start(bank())
    ref = at(system, who)
    async with system.transaction(timeout=30) as change:
        change.transition(ref, (LFR(), TR()))
    await system.terminate(ref)  # Its supervisor, in the process, starts it again.
    assert await ref.ask(Add(0), timeout=30.0) == 1
    assert names_of(ref) == ["lfr", "tr"]
    if who == "inner/deep":
        house = system.ref("/app/bank", hf.Supervisor)
        await house.ask(hf.TerminateChild("inner"))
        await house.ask(hf.RestartChild("inner"), timeout=30.0)
        assert names_of(at(system, who)) == ["lfr", "tr"]
    pid = bank_pid(system)
    os.kill(pid, signal.SIGKILL)
    async with asyncio.timeout(20):
        while os.path.exists(f"/proc/{pid}"):
            await asyncio.sleep(0.005)
    assert await at(system, who).ask(Add(0), timeout=30.0) >= 1
    assert names_of(at(system, who)) == ["lfr", "tr"]


async def test_a_dry_run_says_what_would_be_and_an_undone_one_leaves_it(system: hf.ActorSystem) -> None:
    await system.start(bank(protected("alice")))
    alice = at(system, "alice")
    async with system.transaction(dry_run=True) as change:
        change.transition(alice, LFR())
    assert change.describe().splitlines()[:3] == [
        "1. transition of /app/bank/alice to LFR (from PBR to LFR)",
        "- /app/bank/alice: Counter, permanent, task, protected by PBR",
        "+ /app/bank/alice: Counter, permanent, task, protected by LFR",
    ]
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=30) as change:
            change.transition(alice, LFR())
            change.add("/app/bank", hf.child("bad", hf.start(Bad)))
    assert names_of(alice) == ["pbr"]
    await system.terminate(alice)
    assert await alice.ask(Add(0), timeout=30.0) == 1
    assert names_of(alice) == ["pbr"]
    with pytest.raises(hf.TransactionRefused, match="has just that already"):
        async with system.transaction() as change:
            change.transition(alice, PBR())


def recorded(name: str = "alice", **options: Any) -> hf.ChildSpec:
    return hf.child(name, hf.start(Counter), recovery=hf.hybrid(interval=0.05), **options)


async def attach(system: hf.ActorSystem, ref: hf.ActorRef[Any], mechanism: Any = None) -> None:
    async with system.transaction(timeout=30) as change:
        change.attach(ref, mechanism or PBR())


async def detach(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=30) as change:
        change.detach(ref)


async def test_attached_and_detached_under_load_nothing_is_lost(system: hf.ActorSystem) -> None:
    await system.start(bank(recorded(), recorded("bob")))
    alice = at(system, "alice")
    load = Load(alice)
    for _ in range(2):
        await load.reached(30)
        await attach(system, alice)
        assert isinstance(alice._cell.host, SubtreeGroup)
        await load.reached(30)
        await two_again(alice)
        os.kill(pid_of(system, alice, group_of(alice).primary or ""), signal.SIGKILL)
        await load.reached(30)
        await two_again(alice)
        await detach(system, alice)
        assert isinstance(alice._cell.host, SubtreeHome)
        assert not [path for path in system.tree() if path.startswith("/app/bank/alice/ftm")]
    await load.reached(30)
    await load.stop()
    load.check(await alice.ask(Tags()))
    assert alice._cell.life == 1


class Bad(hf.Actor):
    def __init__(self) -> None:
        raise RuntimeError("no")
