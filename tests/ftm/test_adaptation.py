"""Mechanisms are composed, exchanged and updated under load: nothing is lost, wrong or done twice (A76-A82, T36)."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.bricks.brick_messages import Done
from holdfast.ftm.bricks.bricks import After
from holdfast.ftm.events import MechanismChanged
from holdfast.ftm.group import adaptation_engine
from holdfast.ftm.group.reconfiguration import CannotAdapt
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR, Checkpointing
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.model.mechanism import MechanismRefused
from tests.ftm.accounts import Account, Add, Bank, Closed, Counter, Load, Put, Tags, Total, Transfer
from tests.ftm.test_failover import METHODS, group_of, other, pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])
# A refused or failed transaction ends with its block.
# ruff: noqa: PT012

STACKS: tuple[Any, ...] = (LFR(), (PBR(), TR()), PBR(), (LFR(), TR()), TR(), PBR(acknowledge=False), PBR())
COUNTING = '''
from holdfast.ftm.mechanisms.pbr import Checkpointing

class Counting(Checkpointing):
    """The same, and it says that it is there."""

    async def after(self, done):
        return await super().after(done)
'''


class Noted(Checkpointing):
    """New code for the primary's After."""


class Wrong(hf.Actor):
    """No brick at all."""


class Slow(Counter):
    """A turn of it takes as long as a file is there."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self.file = file

    @hf.on(Total)
    async def read(self, message: Total) -> int:  # type: ignore[override]  # pyright: ignore[reportIncompatibleMethodOverride]
        while os.path.exists(self.file):
            await asyncio.sleep(0.005)
        return self.total


async def transition(system: hf.ActorSystem, ref: hf.ActorRef[Any], mechanism: Any, seconds: float = 30) -> None:
    several = mechanism if isinstance(mechanism, tuple) else (mechanism,)
    async with system.transaction(timeout=seconds) as change:
        change.protect(ref, several)


async def protected(system: hf.ActorSystem, start: Any = None, mechanism: Any = None, **spec: Any) -> hf.ActorRef[Any]:
    start = start or hf.start(Counter)
    return await system.start(hf.child("alice", start, mechanism=mechanism or PBR(), **spec))


def stack(ref: hf.ActorRef[Any]) -> tuple[str, ...]:
    """What its spec and its replicas say."""
    layers = ref._cell.spec.mechanism
    layers = layers if isinstance(layers, tuple) else (layers,)
    assert layers == ref._cell.host.place.layers  # type: ignore[attr-defined]
    return tuple(layer.name for layer in layers)


@pytest.mark.parametrize("method", METHODS)
async def test_every_transition_under_load_loses_nothing(system: hf.ActorSystem, method: str) -> None:
    """A13, A86."""
    ref = await protected(system, recovery=METHODS[method]())
    load, events = Load(ref), system.events()
    for wanted in STACKS:
        await load.reached(20)
        await transition(system, ref, wanted)
        await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    changed = [event for event in events.take() if isinstance(event, MechanismChanged)]
    assert [event.layers for event in changed][:3] == [("lfr",), ("pbr", "tr"), ("pbr",)]
    assert [event.config for event in changed] == list(range(2, 2 + len(STACKS)))
    assert ref._cell.life == 1
    assert load.longest < 5.0
    events.close()


async def test_failover_works_in_every_stack_that_was_changed_to(system: hf.ActorSystem) -> None:
    ref = await protected(system)
    load = Load(ref)
    for wanted in (LFR(), (PBR(), TR()), (LFR(), TR()), PBR()):
        await transition(system, ref, wanted)
        for name in (group_of(ref).membership.primary, other(group_of(ref))):
            assert name is not None
            await load.reached(10)
            os.kill(pid_of(system, ref, name), signal.SIGKILL)
            await load.reached(10)
            await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert group_of(ref).adaptation.config == 5


async def test_money_is_moved_once_while_mechanisms_change(system: hf.ActorSystem) -> None:
    """Turns that have begun, and wait for replies of others, are let through (T36, T37)."""
    one = await system.start(hf.child("one", hf.start(Account, 1000)))
    two = await system.start(hf.child("two", hf.start(Account, 1000)))
    ref = await protected(system, hf.start(Bank), bindings={"one": one.path, "other": two.path})
    load = Load(ref, make=Transfer)
    for wanted in (LFR(), PBR(), (PBR(), TR()), PBR()):
        await load.reached(5)
        await transition(system, ref, wanted)
    await load.stop()
    tags = await ref.ask(Tags())
    load.check(tags)
    assert (await one.ask(Put(0)), await two.ask(Put(0))) == (1000 - len(tags), 1000 + len(tags))


async def test_one_layer_comes_and_another_goes(system: hf.ActorSystem) -> None:
    ref = await protected(system)
    load, events = Load(ref), system.events()
    async with system.transaction(timeout=30) as change:
        change.protect(ref, ("pbr", TR()))
    assert stack(ref) == ("pbr", "tr")
    await load.reached(20)
    async with system.transaction(timeout=30) as change:
        change.protect(ref, "tr")
    assert stack(ref) == ("tr",)
    assert len(group_of(ref).membership.names) == 1
    await load.reached(20)
    async with system.transaction(timeout=30) as change:
        change.protect(ref, (LFR(), "tr"))
    assert stack(ref) == ("lfr", "tr")
    await two_again(ref)
    await change.settled()  # A death on probation could be taken for its fault.
    os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
    await load.reached(20)
    async with system.transaction(timeout=30) as change:
        change.protect(ref, (PBR(), "tr"))
    settled = [event for event in events.take() if isinstance(event, hf.events.MechanismSettled)]
    assert stack(ref) == ("pbr", "tr"), settled
    events.close()
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_one_brick_gets_new_code(system: hf.ActorSystem, tmp_path: Path) -> None:
    """The others are not touched, and a replica that begins again has it too."""
    file = tmp_path / "counting.py"
    file.write_text(COUNTING)
    file.chmod(0o600)
    ref = await protected(system)
    load = Load(ref)
    for new in (Noted, file):
        await load.reached(10)
        async with system.transaction(timeout=30) as change:
            change.update(ref, "after", new, role="primary")
        lines = [line for line in change.difference if line[0] in "+-"]
        assert len(lines) == 2
        assert "pbr primary after" in lines[0]
        await load.reached(10)
    assert ref._cell.spec.mechanism == PBR()
    (brick,) = ref._cell.spec.mechanism.exchanged.values()
    assert brick.__name__ == "Counting"
    await two_again(ref)
    primary = group_of(ref).membership.primary
    assert primary is not None
    os.kill(pid_of(system, ref, primary), signal.SIGKILL)
    await load.reached(20)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_what_cannot_be_is_refused_with_its_reason(system: hf.ActorSystem) -> None:
    """T42: before anything is done."""
    ref = await protected(system)
    closed = await system.start(hf.child("closed", hf.start(Closed), mechanism=LFR()))
    plain = await system.start(hf.child("plain", hf.start(Counter)))
    cases: list[tuple[str, Any]] = [
        ("must stand outside of", lambda change: change.protect(ref, (TR(), "pbr"))),
        ("keeps replicas already", lambda change: change.protect(ref, ("pbr", LFR()))),
        ("state_access = False", lambda change: change.protect(closed, PBR())),
        ("state_access = False", lambda change: change.protect(closed, ("lfr", TR()))),
        ("no mechanism yet", lambda change: change.update(plain, "after", Noted)),
        ("must be a After", lambda change: change.update(ref, "after", Wrong, role="primary")),
        ("say which role", lambda change: change.update(ref, "after", Noted)),
        ("a brick is one of", lambda change: change.update(ref, "server", Noted)),
        ("there is no mechanism of that name", lambda change: change.protect(ref, "nothing")),
        ("cannot be read", lambda change: change.protect(ref, "/nowhere/m.py")),
    ]
    before = group_of(ref).adaptation.config
    for reason, wanted in cases:
        with pytest.raises(hf.TransactionRefused, match=reason):
            async with system.transaction() as change:
                wanted(change)
    assert (stack(ref), group_of(ref).adaptation.config, stack(closed)) == (("pbr",), before, ("lfr",))
    assert await ref.ask(Add(0)) == 1


async def test_a_dry_run_shows_steps_and_bricks(system: hf.ActorSystem) -> None:
    ref = await protected(system)
    async with system.transaction(dry_run=True) as change:
        change.protect(ref, LFR())
        change.protect(ref, ("lfr", TR()))
    text = change.describe()
    assert "1. protect /app/alice by LFR" in text
    assert "2. protect /app/alice by LFR + TR" in text
    assert "- /app/alice/ftm pbr primary after: holdfast.ftm.mechanisms.pbr:Checkpointing" in text
    assert "+ /app/alice/ftm tr single after: holdfast.ftm.mechanisms.tr:Compare" in text
    assert stack(ref) == ("pbr",)


async def test_a_turn_that_does_not_end_rolls_it_back(
    system: hf.ActorSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A83, T36: within a time limit; requests that waited meanwhile are handled."""
    file = tmp_path / "slow"
    file.touch()
    ref = await protected(system, hf.start(Slow, str(file)))
    slow = asyncio.ensure_future(ref.ask(Total(), timeout=30))
    await asyncio.sleep(0.05)  # It has begun, or will: either way it does not end.
    waiting = asyncio.ensure_future(ref.ask(Add(0), timeout=30))
    with pytest.raises(hf.TransactionFailed, match="has not ended"), monkeypatch.context() as patch:
        patch.setattr(adaptation_engine, "REST_WITHIN", 1.0)
        await transition(system, ref, LFR())
    assert stack(ref) == ("pbr",)
    file.unlink()
    await asyncio.gather(slow, waiting)
    await transition(system, ref, LFR())
    assert await ref.ask(Add(1)) == 2


async def test_what_fails_behind_it_puts_the_old_stack_back(system: hf.ActorSystem) -> None:
    """T39."""
    ref = await protected(system)
    load = Load(ref)
    await load.reached(10)
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=30) as change:
            change.protect(ref, (LFR(), TR()))
            change.add("/app", hf.child("bad", hf.start(Failing)))
    assert stack(ref) == ("pbr",)
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))


class Failing(hf.Actor):
    def on_start(self, restored: bool) -> None:
        raise RuntimeError("no")


async def test_two_at_a_time_are_done_one_after_the_other(system: hf.ActorSystem) -> None:
    ref = await protected(system)
    load = Load(ref)
    await asyncio.gather(transition(system, ref, LFR()), transition(system, ref, (PBR(), TR())))
    assert stack(ref) == ("pbr", "tr")
    host: Any = ref._cell.host.place
    first = asyncio.ensure_future(host.adapt(ref._cell, PBR(), lambda: None))
    with pytest.raises(CannotAdapt, match="being changed"):
        await asyncio.gather(host.adapt(ref._cell, LFR(), lambda: None), first)
    await first
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_a_brick_without_its_bindings_is_refused_by_the_replicas(system: hf.ActorSystem) -> None:
    ref = await protected(system)
    with pytest.raises(hf.TransactionRefused, match="nothing would be bound"):
        async with system.transaction() as change:
            change.update(ref, "after", NeedsMore, role="primary")
            change.add("/app", hf.child("never", hf.start(Counter)))
    assert "/app/never" not in system.tree()
    assert await ref.ask(Add(0)) == 1


class NeedsMore(After):
    """Has a binding that nobody knows of."""

    elsewhere: hf.Binding[hf.Actor]

    async def after(self, done: Done) -> Done | None:
        return done


async def test_with_a_store_the_stack_is_there_again(tmp_path: Path) -> None:
    """T40: what was committed is kept as a whole; what the program declares anew is newer."""
    store = f"sqlite:{tmp_path / 'store.db'}"
    spec = hf.child("alice", hf.start(Counter), recovery=hf.hybrid(interval=0.05))
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await system.start(spec)
        assert await ref.ask(Add(0)) == 1
        async with system.transaction(timeout=30) as change:
            change.protect(ref, PBR())
            change.protect(ref, ("pbr", TR()))
        assert await ref.ask(Add(1)) == 2
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await system.start(spec)
        assert stack(ref) == ("pbr", "tr")
        assert await ref.ask(Add(2)) == 3
        async with system.transaction(timeout=30) as change:
            change.protect(ref, None)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await system.start(spec)
        assert ref._cell.spec.mechanism is None
        assert await ref.ask(Add(3)) == 4
        async with system.transaction(timeout=30) as change:
            change.protect(ref, PBR())
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await system.start(hf.child("alice", hf.start(Counter), recovery=hf.hybrid(), mechanism=LFR()))
        assert stack(ref) == ("lfr",)
        assert await ref.ask(Tags()) == [0, 1, 2, 3]


async def test_a_class_that_cannot_be_made_without_settings_is_refused(system: hf.ActorSystem) -> None:
    with pytest.raises(MechanismRefused, match="must be one such as"):
        from holdfast.ftm.model.composition import layers_of

        layers_of(3)
