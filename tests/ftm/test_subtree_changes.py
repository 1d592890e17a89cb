"""The mechanism of an actor below a supervisor in another process is changed, by the same transactions as anywhere."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.places.far_parent import SlotPlace
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from tests.ftm.accounts import Add, Boom, Counter, Load, Tags
from tests.ftm.test_adaptation_trouble import fails, struck
from tests.ftm.test_failover import SEED, group_of, pid_of, two_again
from tests.ftm.test_subtree import at, bank, bank_pid, protected

# A refused or failed transaction ends with its block.
# ruff: noqa: PT012


def names_of(ref: hf.ActorRef[Any]) -> list[str]:
    assert isinstance(ref._cell.host.place, GroupPlace)
    return [layer.name for layer in ref._cell.host.place.layers]


async def test_its_mechanism_is_changed_under_load(system: hf.ActorSystem) -> None:
    await system.start(bank(protected("alice")))
    alice = at(system, "alice")
    load = Load(alice)
    await load.reached(20)
    async with system.transaction(timeout=30) as change:
        change.protect(alice, LFR())
    assert names_of(alice) == ["lfr"]
    await load.reached(20)
    async with system.transaction(timeout=30) as change:
        change.protect(alice, (PBR(), TR()))
    assert names_of(alice) == ["pbr", "tr"]
    await load.reached(20)
    await two_again(alice)
    os.kill(pid_of(system, alice, group_of(alice).membership.primary or ""), signal.SIGKILL)
    await load.reached(20)
    await load.stop()
    load.check(await alice.ask(Tags()))
    assert alice._cell.life == 1


async def test_the_new_stack_holds_over_restarts_of_the_child_and_of_the_subtree(system: hf.ActorSystem) -> None:
    await system.start(bank())
    ref = at(system, "inner/deep")
    async with system.transaction(timeout=30) as change:
        change.protect(ref, (LFR(), TR()))
    await system.terminate(ref)  # Its supervisor, in the process, starts it again.
    assert await ref.ask(Add(0), timeout=30.0) == 1
    assert names_of(ref) == ["lfr", "tr"]
    house = system.ref("/app/bank", hf.Supervisor)
    await house.ask(hf.TerminateChild("inner"))
    await house.ask(hf.RestartChild("inner"), timeout=30.0)
    ref = at(system, "inner/deep")
    assert names_of(ref) == ["lfr", "tr"]
    await kill_subtree(system)
    assert await ref.ask(Add(0), timeout=30.0) >= 1
    assert names_of(ref) == ["lfr", "tr"]


async def test_a_dry_run_says_what_would_be_and_an_undone_one_leaves_it(system: hf.ActorSystem) -> None:
    await system.start(bank(protected("alice")))
    alice = at(system, "alice")
    async with system.transaction(dry_run=True) as change:
        change.protect(alice, LFR())
    assert change.describe().splitlines()[:3] == [
        "1. protect /app/bank/alice by LFR",
        "- /app/bank/alice: Counter, permanent, task, protected by PBR",
        "+ /app/bank/alice: Counter, permanent, task, protected by LFR",
    ]
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=30) as change:
            change.protect(alice, LFR())
            change.add("/app/bank", hf.child("bad", hf.start(Bad)))
    assert names_of(alice) == ["pbr"]
    await system.terminate(alice)
    assert await alice.ask(Add(0), timeout=30.0) == 1
    assert names_of(alice) == ["pbr"]
    async with system.transaction() as change:
        change.protect(alice, PBR())  # It has just that already.
    assert names_of(alice) == ["pbr"]


def recorded(name: str = "alice", **options: Any) -> hf.ChildSpec:
    return hf.child(name, hf.start(Counter), recovery=hf.hybrid(interval=0.05), **options)


async def attach(system: hf.ActorSystem, ref: hf.ActorRef[Any], mechanism: Any = None) -> None:
    async with system.transaction(timeout=30) as change:
        change.protect(ref, mechanism or PBR())


async def detach(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=30) as change:
        change.protect(ref, None)


async def test_attached_and_detached_under_load_nothing_is_lost(system: hf.ActorSystem) -> None:
    await system.start(bank(recorded(), recorded("bob")))
    alice = at(system, "alice")
    load = Load(alice)
    for _ in range(2):
        await load.reached(30)
        await attach(system, alice)
        assert isinstance(alice._cell.host.place, GroupPlace)
        await load.reached(30)
        await two_again(alice)
        os.kill(pid_of(system, alice, group_of(alice).membership.primary or ""), signal.SIGKILL)
        await load.reached(30)
        await two_again(alice)
        await detach(system, alice)
        assert isinstance(alice._cell.host.place, SlotPlace)
        assert not [path for path in system.tree() if path.startswith("/app/bank/alice/ftm")]
    await load.reached(30)
    await load.stop()
    load.check(await alice.ask(Tags()))
    assert alice._cell.life == 1


async def kill_subtree(system: hf.ActorSystem) -> None:
    """Kill the process of the subtree, and wait until it is dead."""
    pid = bank_pid(system)
    os.kill(pid, signal.SIGKILL)
    async with asyncio.timeout(20):
        while os.path.exists(f"/proc/{pid}"):
            await asyncio.sleep(0.005)


async def test_what_was_attached_or_detached_holds_over_restarts(system: hf.ActorSystem) -> None:
    await system.start(bank(hf.supervisor("inner", children=[recorded("deep")], intensity=1000)))
    ref = at(system, "inner/deep")
    assert await ref.ask(Add(0)) == 1
    await attach(system, ref, (LFR(), TR()))
    await system.terminate(ref)
    assert await ref.ask(Add(1), timeout=30.0) == 2
    assert names_of(ref) == ["lfr", "tr"]
    await kill_subtree(system)
    assert await ref.ask(Add(2), timeout=30.0) == 3
    assert names_of(ref) == ["lfr", "tr"]
    await detach(system, ref)
    with pytest.raises(hf.RemoteCrash, match="boom"):
        await ref.ask(Boom())
    assert await ref.ask(Add(3), timeout=30.0) == 4
    assert system.pid_of(ref) == bank_pid(system)
    await kill_subtree(system)
    assert await ref.ask(Tags(), timeout=30.0) == [0, 1, 2, 3]
    assert isinstance(ref._cell.host.place, SlotPlace)


@pytest.mark.parametrize("victim", ["subtree", "replica"])
async def test_whatever_dies_while_it_is_handed_over_nothing_is_lost(system: hf.ActorSystem, victim: str) -> None:
    """The transaction is made, or is undone; requests are answered once in any case."""
    rng = random.Random(f"{SEED} {victim}")
    await system.start(bank(recorded()))
    alice = at(system, "alice")
    load = Load(alice)
    for change in (attach, detach, attach, detach):
        await load.reached(20)
        changing = asyncio.ensure_future(change(system, alice))
        await asyncio.sleep(rng.random() * 0.3)
        path = "/app/bank" if victim == "subtree" else f"/app/bank/alice/ftm/{rng.choice(['r1', 'r2'])}"
        pid = system._workers.processes().get(path)
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):  # It has just ended.
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(hf.TransactionFailed, hf.TransactionRefused):
            await changing
    await load.reached(20)
    await load.stop()
    load.check(await alice.ask(Tags()))


async def test_undone_with_its_transaction_it_lives_as_before(system: hf.ActorSystem) -> None:
    await system.start(bank(recorded(), recorded("bob", mechanism=PBR())))
    alice, bob = at(system, "alice"), at(system, "bob")
    loads = Load(alice, clients=2), Load(bob, clients=2)
    for load in loads:
        await load.reached(10)
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=30) as change:
            change.protect(alice, LFR())
            change.protect(bob, None)
            change.add("/app/bank", hf.child("bad", hf.start(Bad)))
    assert isinstance(alice._cell.host.place, SlotPlace)
    assert names_of(bob) == ["pbr"]
    await two_again(bob)
    os.kill(pid_of(system, bob, group_of(bob).membership.primary or ""), signal.SIGKILL)
    for load, ref in zip(loads, (alice, bob), strict=True):
        await load.reached(10)
        await load.stop()
        load.check(await ref.ask(Tags()))


class Wait(hf.Message[int]): ...


class Slow(Counter):
    """A turn that lasts as long as there is a file; another one tells that it has begun."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self._file = Path(file)

    @hf.on(Wait)
    async def wait(self, message: Wait) -> int:
        self._file.with_suffix(".begun").touch()
        while self._file.exists():
            await asyncio.sleep(0.005)
        return self.total


async def begun(file: Path) -> None:
    async with asyncio.timeout(30):
        while not file.with_suffix(".begun").exists():
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("verb", ["attach", "detach", "transition"])
async def test_a_turn_that_does_not_end_rolls_it_back(system: hf.ActorSystem, tmp_path: Path, verb: str) -> None:
    """Within a time limit; what has waited is handled, and it can be done afterwards."""
    file = tmp_path / "slow"
    file.touch()
    mechanism = None if verb == "attach" else PBR()
    slow = hf.child("alice", hf.start(Slow, str(file)), recovery=hf.hybrid(), mechanism=mechanism)
    await system.start(bank(slow))
    alice = at(system, "alice")
    waiting = [asyncio.ensure_future(alice.ask(message, timeout=30)) for message in (Wait(), Add(0))]

    async def change(seconds: float) -> None:
        async with system.transaction(timeout=seconds) as collected:
            match verb:
                case "attach":
                    collected.protect(alice, PBR())
                case "detach":
                    collected.protect(alice, None)
                case _:
                    collected.protect(alice, LFR())

    with pytest.raises(hf.TransactionFailed):
        await change(1.0)
    file.unlink()
    assert await asyncio.gather(*waiting) == [0, 1]
    await change(30.0)
    assert await alice.ask(Add(1)) == 2


@pytest.mark.parametrize("step", ["prepare", "commit"])
async def test_the_engine_dies_at_each_step_and_its_next_life_goes_on(system: hf.ActorSystem, step: str) -> None:
    await system.start(bank(protected("alice")))
    alice = at(system, "alice")
    load = Load(alice, clients=2)
    await load.reached(5)
    seen = struck(alice, step, fails)
    async with system.transaction(timeout=30) as change:
        change.protect(alice, LFR())
    assert step in seen
    assert names_of(alice) == ["lfr"]
    await two_again(alice)
    await load.reached(5)
    await load.stop()
    load.check(await alice.ask(Tags()))


async def test_a_change_that_its_process_does_not_survive_is_made_of_the_next_life(system: hf.ActorSystem) -> None:
    """The whole group ends with the subtree, and begins as it was; then it is changed."""
    await system.start(bank(protected("alice", recovery=hf.hybrid())))
    alice = at(system, "alice")
    assert await alice.ask(Add(0)) == 1
    pid = bank_pid(system)
    struck(alice, "prepare", lambda: os.kill(pid, signal.SIGKILL))
    async with system.transaction(timeout=30) as change:
        change.protect(alice, LFR())
    assert await alice.ask(Add(1), timeout=30.0) == 2
    assert names_of(alice) == ["lfr"]
    assert bank_pid(system) != pid


async def test_with_a_store_the_stack_is_there_again(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'store.db'}"
    spec = bank(recorded(), hf.supervisor("inner", children=[recorded("deep", mechanism=PBR())]))
    async with hf.ActorSystem("app", store=store, log=False) as system:
        await system.start(spec)
        alice, deep = at(system, "alice"), at(system, "inner/deep")
        assert [await alice.ask(Add(0)), await deep.ask(Add(0))] == [1, 1]
        async with system.transaction(timeout=30) as change:
            change.protect(alice, PBR())
            change.protect(deep, ("pbr", TR()))
    async with hf.ActorSystem("app", store=store, log=False) as system:
        await system.start(spec)
        alice, deep = at(system, "alice"), at(system, "inner/deep")
        assert (names_of(alice), names_of(deep)) == (["pbr"], ["pbr", "tr"])
        assert [await alice.ask(Add(1)), await deep.ask(Add(1))] == [2, 2]
        async with system.transaction(timeout=30) as change:
            change.protect(alice, None)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        await system.start(spec)
        assert isinstance(at(system, "alice")._cell.host.place, SlotPlace)
        assert await at(system, "alice").ask(Tags()) == [0, 1]


class Bad(hf.Actor):
    def __init__(self) -> None:
        raise RuntimeError("no")
