"""Bad changes: whatever new bricks do wrong, and whenever, the old stack is there in the end, and nothing is lost.

`HOLDFAST_BAD_CHANGES=1 python -m pytest tests/ftm/test_bad_changes.py` tries all of them, with kills in between; here
there are a few of each kind. `HOLDFAST_SEED` chooses when replicas are killed.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.bricks.brick_messages import Work
from holdfast.ftm.bricks.bricks import Before
from holdfast.ftm.bricks.replica_orders import Computes
from holdfast.ftm.events import MechanismSettled
from holdfast.ftm.group import failover, hung, probation
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.bad_bricks import HOWS, PARTS, WHENS, Wrong, WrongProceed
from tests.ftm.test_adaptation import stack
from tests.ftm.test_failover import SEED, group_of, is_complete, pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

MOST_KILLS = 8
"""Of one change."""
IS_LONG = "HOLDFAST_BAD_CHANGES" in os.environ


def can_be(how: str, when: str, part: str, role: str) -> bool:
    """Whether there is such a case."""
    if how in ("garbage", "swallow") and (when != "message" or part == "proceed"):
        return False
    if when == "peer":
        return part == "before" and role == "other"
    return role != "other" or when != "message"  # A backup that only keeps the state sees no batch.


ALL = [
    (WrongProceed if part == "proceed" else Wrong)(how, when, part, role, late)
    for how, when, part, role, late in itertools.product(HOWS, WHENS, PARTS, ("leader", "other"), (False, True))
    if can_be(how, when, part, role)
]
REFUSED = (
    Wrong("raise", "init", "before", "leader", late=False),
    Wrong("exit", "start", "after", "other", late=False),
    Wrong("allocate", "message", "before", "leader", late=False),
    WrongProceed("raise", "message", "proceed", "leader", late=False),
    Wrong("exit", "start", "after", "other", late=True),
    Wrong("raise", "start", "before", "leader", late=True),
)
"""Found before they are the mechanism: in the trial, or when replicas prepare."""
TAKEN_BACK = (
    Wrong("raise", "message", "after", "leader"),
    Wrong("exit", "message", "before", "leader"),
    Wrong("swallow", "message", "before", "leader"),
    Wrong("garbage", "message", "after", "leader"),
    WrongProceed("hang", "message", "proceed", "leader"),
    Wrong("raise", "peer", "before", "other"),
)
"""Found only when requests come."""


async def judged(system: hf.ActorSystem, name: str, bad: Wrong, rng: random.Random | None, below: Any) -> str:
    """Protect an actor, have it go over to a bad mechanism under load, and see that all is as before; how it went."""
    ref = await system.start(hf.child(name, hf.start(Counter), mechanism=below))
    load = Load(ref)
    await load.reached(20)
    enough = asyncio.Event()
    killing = None if rng is None else asyncio.ensure_future(kill_now_and_then(system, ref, rng, enough))
    how = "refused"
    try:
        async with asyncio.timeout(300):
            async with system.transaction(timeout=120) as change:
                change.protect(ref, (bad, *stack(ref)))
            (outcome,) = await change.settled()
    except hf.TransactionFailed as failed:
        how = f"not undone: {failed}" if failed.kept else how
    else:
        how = "kept" if outcome.is_kept else "taken back"
    if killing is not None:
        enough.set()
        await killing
    assert how in ("refused", "taken back"), f"{bad}: {how}"  # Kills do not hide it.
    await load.reached(20)
    assert stack(ref) == (below.name,), bad
    await two_again(ref)
    os.kill(pid_of(system, ref, group_of(ref).membership.primary or ""), signal.SIGKILL)  # Failover works as before.
    await load.reached(20)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    # A kill of the replica that is left begins another life, with the state that the root has kept.
    assert ref._cell.life == 1 or rng is not None, f"{bad}: the life at the address has ended"
    await system.stop(ref)
    return how


async def kill_now_and_then(
    system: hf.ActorSystem, ref: hf.ActorRef[Any], rng: random.Random, enough: asyncio.Event
) -> None:
    """Kill one replica of a complete group, a few times; the next one when that is known, and made good."""
    kills = 0
    while kills < MOST_KILLS and not enough.is_set():
        await two_again(ref)
        await asyncio.sleep(rng.random() * 2.0)
        group = group_of(ref)
        name = rng.choice(group.membership.names)
        if not is_complete(ref) or group.replicas.life_of(name) != group.membership.members.get(name):
            continue
        life, kills = group.replicas.life_of(name), kills + 1
        os.kill(pid_of(system, ref, name), signal.SIGKILL)
        async with asyncio.timeout(60):
            while group.replicas.life_of(name) == life:
                await asyncio.sleep(0.001)


@pytest.mark.parametrize("bad", REFUSED, ids=str)
async def test_what_is_found_beforehand_is_refused(system: hf.ActorSystem, bad: Wrong) -> None:
    with system.events() as events:
        assert await judged(system, "alice", bad, None, PBR()) == "refused"
        assert not [one for one in events.take() if isinstance(one, MechanismSettled)]


async def test_what_is_found_under_load_is_taken_back(system: hf.ActorSystem) -> None:
    cases = [judged(system, f"a{n}", bad, None, PBR()) for n, bad in enumerate(TAKEN_BACK)]
    assert await asyncio.gather(*cases) == ["taken back"] * len(cases)


async def test_attaching_is_tried_too(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    load = Load(ref)
    for bad in REFUSED[1:4]:
        await load.reached(10)
        with pytest.raises(hf.TransactionFailed, match=r"exited with code 9|out of memory|has raised this"):
            async with system.transaction(timeout=60) as change:
                change.protect(ref, (bad, PBR()))
    await load.reached(10)
    assert not (await system.protection(ref)).is_protected
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_failover_does_not_wait_for_a_change_that_hangs(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    load = Load(ref)
    await load.reached(10)
    host: Any = ref._cell.host.place
    group, prepares = group_of(ref), asyncio.Event()
    host.on_step = lambda step: prepares.set() if step == "prepare" else None

    async def changed() -> None:
        async with system.transaction(timeout=60) as change:
            change.protect(ref, (Wrong("hang", "start", "before", "any"), *stack(ref)))

    changing = asyncio.ensure_future(changed())
    await prepares.wait()
    os.kill(pid_of(system, ref, group.membership.primary or ""), signal.SIGKILL)
    async with asyncio.timeout(60):
        while not group.failovers:
            await asyncio.sleep(0.001)
    assert not changing.done()
    await load.reached(20)
    with pytest.raises(hf.TransactionFailed, match=r"on_start did not return within|has failed when"):
        await changing
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == ("pbr",)


async def test_a_kill_while_a_change_blocks_the_other_replica_loses_nothing(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    assert [await ref.ask(Add(tag)) for tag in range(5)] == [1, 2, 3, 4, 5]
    await two_again(ref)
    host: Any = ref._cell.host.place
    pid = pid_of(system, ref, group_of(ref).membership.primary or "")
    host.on_step = lambda step: os.kill(pid, signal.SIGKILL) if step == "prepare" and ref._cell.life == 1 else None
    with pytest.raises(hf.TransactionFailed, match=r"has failed when it prepared it|has ended"):
        async with system.transaction(timeout=60) as change:
            change.protect(ref, (Wrong("hang", "init", "before", "other"), *stack(ref)))
    assert await ref.ask(Tags(), timeout=60) == [0, 1, 2, 3, 4]
    assert stack(ref) == ("pbr",)


async def test_the_stack_before_comes_back_to_one_that_leads_while_bricks_keep_what_it_was_given(
    system: hf.ActorSystem,
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=LFR()))
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, (Wrong("hang", "peer", "before", "other"), *stack(ref)))
    group, seconds = group_of(ref), 0.2
    async with asyncio.timeout(30):
        while (await group.replicas.ask(group.replicas.backups()[0], Computes(group.switch.turn, seconds), 5.0)).passes:
            await asyncio.sleep(0)
    os.kill(pid_of(system, ref, group.membership.primary or ""), signal.SIGKILL)
    async with asyncio.timeout(90):
        (outcome,) = await change.settled()
    assert not outcome.is_kept
    await load.reached(20)
    await two_again(ref)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == ("lfr",)


@pytest.mark.parametrize("address", ["/app/nobody", "/app/other"])
async def test_links_that_nobody_certifies_are_refused(system: hf.ActorSystem, address: str) -> None:
    await system.start(hf.child("other", hf.start(Counter)))
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    load = Load(ref)
    await load.reached(10)
    with pytest.raises(hf.TransactionFailed, match=r"no authority lives|has no handler") as failed:
        async with system.transaction(timeout=60) as change:
            change.protect(ref, (hf.ftm.SEC(address), *stack(ref)))
    assert not failed.value.kept
    await load.reached(10)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == ("pbr",)


class Reluctant(Counter):
    """Does not come back."""

    async def on_start(self, restored: bool) -> None:
        if restored:
            await asyncio.sleep(3600.0)


async def test_a_replica_that_waits_for_the_life_that_it_begins_can_be_stopped(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Reluctant), mechanism=PBR()))
    assert await ref.ask(Add(1)) == 1
    group = group_of(ref)
    await two_again(ref)
    left = next(name for name in group.membership.names if name != group.membership.primary)
    os.kill(pid_of(system, ref, group.membership.primary or ""), signal.SIGKILL)
    server = system._node.cell_at(f"{ref.path}/ftm/{left}").ref
    async with asyncio.timeout(60):
        while group.membership.leading is None:
            await asyncio.sleep(0.001)
        status = await system.get_status(server)  # Its turn is free.
        assert status.turn is None
        await system.stop(ref)


@pytest.mark.skipif(not IS_LONG, reason="it takes long: HOLDFAST_BAD_CHANGES=1")
@pytest.mark.parametrize("kills", [False, True])
@pytest.mark.parametrize("bad", ALL, ids=str)
async def test_all_bad_changes(system: hf.ActorSystem, bad: Wrong, kills: bool) -> None:
    rng = random.Random(f"{SEED} {bad}") if kills else None
    below = PBR() if bad.part == "proceed" else random.Random(str(bad)).choice((PBR(), LFR()))
    await judged(system, "alice", bad, rng, below)


class HangsLater(Before):
    """Lets one batch pass, and keeps the next."""

    is_used = False

    async def before(self, work: Work) -> Work:
        if work.requests and self.is_used:
            await asyncio.Event().wait()
        self.is_used = self.is_used or bool(work.requests)
        return work


async def test_no_stack_is_kept_while_it_may_hold_a_request_for_ever(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probation, "SECONDS", 3.0)
    monkeypatch.setattr(probation, "TURNS", 1)
    ref = await system.start(hf.child("one", hf.start(Counter), mechanism=PBR()))
    await two_again(ref)
    async with system.transaction(timeout=120) as change:
        change.update(ref, "before", HangsLater)
    first = await ref.ask(Add(1), timeout=120)
    second = ref.ask(Add(1), timeout=120)
    async with asyncio.timeout(120):
        (outcome,) = await change.settled()
    assert not outcome.is_kept
    assert await second == first + 1


async def test_a_change_right_after_one_was_taken_back_is_made(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("one", hf.start(Counter), mechanism=PBR()))
    await two_again(ref)
    async with system.transaction(timeout=120) as change:
        change.protect(ref, (Wrong("exit", "message", "before", "leader"), *stack(ref)))
    answer = ref.ask(Add(1), timeout=120)
    async with asyncio.timeout(120):
        (outcome,) = await change.settled()
    assert not outcome.is_kept
    async with system.transaction(timeout=120) as change:
        change.protect(ref, LFR())
    assert stack(ref) == ("lfr",)
    assert await answer == 1


@pytest.mark.parametrize(
    "stack", [(Wrong("hang", "peer", "before", "other"), PBR()), (Wrong("hang", "message", "before", "other"), LFR())]
)
async def test_bricks_that_hang_in_a_replica_that_does_not_lead_are_found_without_probation_too(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, stack: tuple[Any, ...]
) -> None:
    """Else whoever leads would wait for ever, or nobody could take over."""
    monkeypatch.setattr(hung, "STUCK_AFTER", 0.5)
    monkeypatch.setattr(failover, "INSPECT_EVERY", 0.2)
    with system.events() as events:
        ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=stack))
        await two_again(ref)
        assert await ref.ask(Add(1), timeout=60) == 1
        async with asyncio.timeout(20):
            async for event in events:
                if isinstance(event, hf.events.ReplicaLost) and "let nothing pass" in event.why:
                    assert event.replica == "r2"
                    break
        assert await ref.ask(Add(2), timeout=60) == 2
