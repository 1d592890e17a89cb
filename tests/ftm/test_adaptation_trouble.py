"""Whatever dies in the middle of a change of mechanisms, it is made or undone, and never mixed (T38-T41)."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.group import adaptation_engine
from holdfast.ftm.group.reconfiguration import STEPS, CannotAdapt
from holdfast.ftm.group.replicas import Replicas
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from holdfast.system.mechanism_notes import UNDER_WAY, AdaptationUndone, MechanismNotes
from holdfast.system.transaction.change import Change
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.test_adaptation import protected, stack, transition
from tests.ftm.test_failover import SEED, group_of, pid_of, two_again

# A refused or failed transaction ends with its block.
# ruff: noqa: PT012
# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


def struck(ref: hf.ActorRef[Any], step: str, strike: Any) -> list[str]:
    """Have `strike()` called at this step, once; tells which steps were reached."""
    seen: list[str] = []

    def on_step(name: str) -> None:
        seen.append(name)
        if name == step and seen.count(step) == 1:
            strike()

    host: Any = ref._cell.host.place
    host.on_step = on_step
    return seen


def fails() -> None:
    raise RuntimeError("struck")


async def consistent(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> tuple[str, ...]:
    """The stack, when all replicas have the same."""
    found = stack(ref)
    await two_again(ref)
    host: Any = ref._cell.host.place
    assert group_of(ref).adaptation.config == host.config
    assert group_of(ref).adaptation.change is None
    assert not group_of(ref).delivery.is_resting
    assert not group_of(ref).adaptation.is_changing
    return found


@pytest.mark.parametrize("step", STEPS)
async def test_the_engine_dies_at_each_step_and_its_next_life_goes_on(system: hf.ActorSystem, step: str) -> None:
    ref = await protected(system)
    load = Load(ref)
    for wanted in (LFR(), (PBR(), TR())):
        await load.reached(10)
        seen = struck(ref, step, fails)
        await transition(system, ref, wanted)
        assert step in seen
        names = tuple(one.name for one in (wanted if isinstance(wanted, tuple) else (wanted,)))
        assert await consistent(system, ref) == names
    await load.stop()
    load.check(await ref.ask(Tags()))


@pytest.mark.parametrize("role", ["primary", "backup"])
@pytest.mark.parametrize("step", STEPS)
async def test_a_replica_dies_at_each_step(system: hf.ActorSystem, step: str, role: str) -> None:
    ref = await protected(system)
    load, rng = Load(ref), random.Random(f"{SEED} {step} {role}")
    for wanted in (LFR() if role == "primary" else (PBR(), TR()),):
        await load.reached(rng.randrange(1, 20))
        group = group_of(ref)

        def kill(group: Any = group) -> None:
            names = [
                name for name in group.membership.names if (name == group.membership.primary) is (role == "primary")
            ]
            os.kill(pid_of(system, ref, names[0]), signal.SIGKILL)

        seen = struck(ref, step, kill)
        await transition(system, ref, wanted)
        assert step in seen
        names = tuple(one.name for one in (wanted if isinstance(wanted, tuple) else (wanted,)))
        assert await consistent(system, ref) == names
        await load.reached(5)
    await load.stop()
    load.check(await ref.ask(Tags()))


@pytest.mark.parametrize("step", STEPS)
async def test_who_wants_it_is_cancelled_at_each_step(system: hf.ActorSystem, step: str) -> None:
    """Before the commit nothing has changed; from then on it is in force, and goes on though nobody waits."""
    ref = await protected(system)
    load = Load(ref)
    await load.reached(10)
    change = asyncio.ensure_future(transition(system, ref, (LFR(), TR())))
    struck(ref, step, change.cancel)
    with pytest.raises(asyncio.CancelledError):
        await change
    async with system.transaction():  # It begins when the other one is over.
        pass
    is_in_force = step in ("commit", "switch", "tidy")
    assert await consistent(system, ref) == (("lfr", "tr") if is_in_force else ("pbr",))
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_a_replica_that_cannot_prepare_it_leaves_all_as_it_was(system: hf.ActorSystem, tmp_path: Path) -> None:
    """A file that changes between the check and the replicas is not the one that was meant."""
    file = tmp_path / "later.py"
    file.write_text("from holdfast.ftm.mechanisms.pbr import Checkpointing\nclass Later(Checkpointing): ...\n")
    file.chmod(0o600)
    ref = await protected(system)
    load = Load(ref)
    await load.reached(10)
    with pytest.raises(hf.TransactionFailed, match="has changed"):
        async with system.transaction(timeout=30) as change:
            change.update(ref, "after", file, role="primary")
            struck(ref, "prepare", lambda: file.write_text(file.read_text() + "\n"))
    assert await consistent(system, ref) == ("pbr",)
    assert ref._cell.spec.mechanism.exchanged == {}
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_a_stopped_replica_is_replaced_and_the_change_is_made(system: hf.ActorSystem) -> None:
    """It cannot come to rest, until the failure detector has it killed."""
    ref = await protected(system)
    load = Load(ref)
    await load.reached(10)
    primary = group_of(ref).membership.primary
    assert primary is not None
    struck(ref, "quiesce", lambda: os.kill(pid_of(system, ref, primary), signal.SIGSTOP))
    await transition(system, ref, LFR())
    assert await consistent(system, ref) == ("lfr",)
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))


@pytest.mark.parametrize("works", [True, False])
async def test_a_replica_that_goes_through_its_state_has_more_time_to_change_over(
    system: hf.ActorSystem, works: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds still as one that goes through a large state does; that it does, and how long it may, is told here."""
    ref = await protected(system)
    group, still = group_of(ref), 1.5
    (name,) = group.replicas.backups()
    pid = pid_of(system, ref, name)
    monkeypatch.setattr(adaptation_engine, "COMMITTED_WITHIN", 0.3)
    monkeypatch.setattr(Replicas, "at_work", lambda replicas, of: 30.0 if works and of == name else 0.0)

    def hold_still() -> None:
        os.kill(pid, signal.SIGSTOP)
        asyncio.get_running_loop().call_later(still, os.kill, pid, signal.SIGCONT)

    seen = struck(ref, "commit", hold_still)
    await transition(system, ref, LFR())
    assert "commit" in seen
    assert await ref.ask(Add(1)) == 1
    assert await consistent(system, ref) == ("lfr",)
    assert (pid_of(system, ref, name) == pid) is works


async def test_a_change_of_a_life_that_ends_is_refused(system: hf.ActorSystem) -> None:
    ref = await protected(system, restart="temporary")
    struck(ref, "prepare", lambda: ref._cell.kill())
    with pytest.raises(hf.TransactionFailed, match="transaction failed"):
        await transition(system, ref, LFR(), 20)


async def test_a_root_that_died_in_the_middle_says_so(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'store.db'}"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        await system.start(hf.child("alice", hf.start(Counter), recovery=hf.hybrid()))
        system._mechanism_notes.begun("/app/alice", "transition of /app/alice to LFR")
        system._mechanism_notes.put(
            "/app/alice", None, PBR()
        )  # Not kept: the root dies before the transaction is accepted.
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await system.start(hf.child("alice", hf.start(Counter), recovery=hf.hybrid()))
        assert ref._cell.spec.mechanism is None
        assert system._homes.notes(UNDER_WAY) == {}
        system._mechanism_notes.begun("/app/alice", "compose")
        with system.events() as stream:
            MechanismNotes(system._homes)
            (event,) = [one for one in stream.take() if isinstance(one, AdaptationUndone)]
        assert (event.address, event.step) == ("/app/alice", "compose")


async def test_the_error_says_what_stays() -> None:
    assert str(CannotAdapt("/app/alice", "it rains")) == "/app/alice keeps its mechanism: it rains"


async def test_primitives_have_an_undo(system: hf.ActorSystem) -> None:
    """A12, A77: stop, start and unbind, undone by what fails behind them."""
    one = await system.start(hf.child("one", hf.start(Counter)))
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=20) as change:
            change.stop(one)
            change.add("/app", hf.child("bad", hf.start(Failing)))
    assert await system.ref("/app/one", Counter).ask(Add(1)) == 1
    async with system.transaction(timeout=20) as change:
        change.stop("/app/one")
    with pytest.raises(hf.HoldfastError):
        await one.ask(Add(2), timeout=2)
    async with system.transaction(timeout=20) as change:
        assert change.start("/app", "one") == "/app/one"
    assert await system.ref("/app/one", Counter).ask(Add(3)) == 1
    with pytest.raises(hf.TransactionRefused, match="it runs"):
        async with system.transaction(timeout=20) as change:
            change.start("/app", "one")
    two = await system.start(hf.child("two", hf.start(Bound)))
    system.bind(two, "counter", system.ref("/app/one", Counter))
    with pytest.raises(hf.TransactionRefused, match="would point at"):
        async with system.transaction(timeout=20) as change:
            change.stop("/app/one")
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=20) as change:
            change.unbind(two, "counter")
            change.add("/app", hf.child("bad", hf.start(Failing)))
    assert await two.ask(Add(4)) == 2
    async with system.transaction(timeout=20) as change:
        change.unbind(two, "counter")
        change.stop("/app/one")
    with pytest.raises(hf.HoldfastError, match="not bound"):
        await two.ask(Add(5), timeout=2)


class Bound(hf.Actor):
    counter: hf.Binding[Counter]

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        return await self.counter.ask(message)


class Failing(hf.Actor):
    def on_start(self, restored: bool) -> None:
        raise RuntimeError("no")


async def test_parts_of_a_mechanism_are_not_changed_one_by_one(system: hf.ActorSystem) -> None:
    """T39, T41: without its proxy, or with bricks that are others in one replica, it would be none any more."""
    ref = await protected(system)
    ftm = f"{ref.path}/ftm"
    steps: list[Callable[[Change], Any]] = [
        lambda change: change.remove(f"{ftm}/proxy"),
        lambda change: change.stop(f"{ftm}/r2"),
        lambda change: change.stop(f"{ftm}/r1/before"),
        lambda change: change.add(f"{ftm}/r1", hf.child("more", hf.start(Counter))),
        lambda change: change.bind(f"{ftm}/proxy", "protocol", f"{ftm}/r2/protocol"),
        lambda change: change.strategy(ftm, "one_for_all"),
        lambda change: change.replace_code(f"{ftm}/r1/before", Counter),
        lambda change: change.replace_state(f"{ftm}/r1/server", dict),
    ]
    for step in steps:
        with pytest.raises(hf.TransactionRefused, match=r"part of the mechanism of /app/alice.*protect or update"):
            async with system.transaction() as change:
                step(change)
    with pytest.raises(hf.SpecError, match="part of the mechanism"):
        await system.stop(system.ref(f"{ftm}/proxy", hf.Actor))
    async with system.transaction(timeout=20) as change:  # These two change nothing.
        change.suspend(f"{ftm}/r1/before")
        change.resume(f"{ftm}/r1/before")
    assert await ref.ask(Add(1)) == 1
