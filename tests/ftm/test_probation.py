"""A stack on probation gives way in time: no request and no state goes with it, whatever its bricks do."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import pytest

import holdfast as hf
from holdfast.ftm.bricks.brick_messages import Done, Work
from holdfast.ftm.bricks.bricks import Before
from holdfast.ftm.events import MechanismSettled
from holdfast.ftm.group import hung, probation
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tmr import TMR, ComputingAlong, Voting
from holdfast.ftm.mechanisms.tr import TR
from holdfast.ftm.model.mechanism import Mechanism, Role
from holdfast.system.mechanism_notes import AdaptationUndone
from tests.ftm import probation_root
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.bad_bricks import Wrong
from tests.ftm.test_adaptation import stack
from tests.ftm.test_failover import two_again
from tests.ftm.test_subtree import bank

# Processes do not care which event loop the root has.
pytestmark = [pytest.mark.asyncio(loop_factories=["uvloop"]), pytest.mark.usefixtures("warm_programs")]


PATHS = os.pathsep.join(filter(None, [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]))


async def taken_back(change: Any) -> MechanismSettled:
    """How a change went that has to be taken back."""
    async with asyncio.timeout(60):
        (outcome,) = await change.settled()
    assert not outcome.is_kept
    return outcome


class EndsAtFirstCompute(ComputingAlong):
    """Ends a replica that is asked to compute, when it has several requests behind it."""

    async def from_peer(self, message: hf.Message[Any]) -> Any:
        if self._standing.epoch >= 0 and getattr(message, "requests", None):
            os._exit(9)
        return await super().from_peer(message)


class EndsWithoutOthers(Voting):
    """Ends the replica that leads as soon as it has heard that the others are gone."""

    async def after(self, done: Done) -> Done | None:
        out = await super().after(done)
        if done.ends:
            os._exit(9)
        return out


@dataclasses.dataclass(frozen=True)
class Doomed(TMR):
    """All of its replicas end with the first request."""

    name: ClassVar[str] = "tmr"
    roles: ClassVar[dict[str, Role]] = {
        "leader": Role(before=ComputingAlong, after=EndsWithoutOthers),
        "follower": Role(before=EndsAtFirstCompute, computes=False),
    }


async def test_the_state_survives_bricks_that_end_all_replicas_at_once(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=TMR()))
    await two_again(ref)
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, Doomed())
    await taken_back(change)
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == ("tmr",)
    assert type(ref._cell.spec.mechanism) is TMR


class EndsByItself(Before):
    """Ends its replica some requests later, both replicas in the same moment."""

    async def before(self, work: Work) -> Work:
        if work.requests and self.has_peer:
            self.ctx.create_task(self._tell())
        return work

    peer_messages = (Add,)

    async def _tell(self) -> None:
        asked = asyncio.ensure_future(self.ask_peer(Add(1)))
        await asyncio.sleep(0.05)
        os._exit(9)
        await asked

    async def from_peer(self, message: hf.Message[Any]) -> None:
        await asyncio.sleep(0.05)
        os._exit(9)


@dataclasses.dataclass(frozen=True)
class Ending(Mechanism):
    name: ClassVar[str] = "ending"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=EndsByItself), "other": Role(before=EndsByItself)}


@pytest.mark.parametrize("below", [PBR(), LFR()], ids=lambda one: one.name)
async def test_the_state_survives_bricks_that_end_both_replicas_under_load(
    system: hf.ActorSystem, below: Mechanism
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=below))
    await two_again(ref)
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, (Ending(), *stack(ref)))
    await taken_back(change)
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == (below.name,)


class Drops(Before):
    """Lets one request of three fall."""

    count = 0

    async def before(self, work: Work) -> Work:
        kept = list[Any]()
        for one in work.requests:
            self.count += 1
            if self.count % 3:
                kept.append(one)
        return Work(work.epoch, work.config, work.number, kept, work.go)


@dataclasses.dataclass(frozen=True)
class Dropping(Mechanism):
    name: ClassVar[str] = "dropping"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=Drops), "other": Role()}


@pytest.mark.parametrize("below", [(PBR(),), (LFR(),), (TMR(),), (TR(),)], ids=lambda one: one[0].name)
async def test_a_request_that_is_dropped_is_served_by_the_stack_before(
    system: hf.ActorSystem, below: tuple[Mechanism, ...]
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=below))
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, (Dropping(), *stack(ref)))
    outcome = await taken_back(change)
    assert "let a request fall" in outcome.why
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == (below[0].name,)


class Misanswers(Before):
    """Ends requests of an amount with what is no reply to them."""

    async def before(self, work: Work) -> Work:
        for one in work.requests:
            if isinstance(self.message_of(one), Add):
                work = self.answer(work, one, "no number")
        return work


class Repeats(Before):
    """Hands on its requests twice."""

    async def before(self, work: Work) -> Work:
        return Work(work.epoch, work.config, work.number, [*work.requests, *work.requests], work.go)


@dataclasses.dataclass(frozen=True)
class Misanswering(Dropping):
    name: ClassVar[str] = "misanswering"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=Misanswers), "other": Role()}


@dataclasses.dataclass(frozen=True)
class Repeating(Dropping):
    name: ClassVar[str] = "repeating"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=Repeats), "other": Role()}


@pytest.mark.parametrize("below", [PBR(), LFR(), TR()], ids=lambda one: one.name)
@pytest.mark.parametrize(
    ("bad", "why"),
    [(Misanswering(), "what is no reply to it"), (Repeating(), "handed on a request twice")],
    ids=lambda one: one.name if isinstance(one, Mechanism) else "",
)
async def test_bricks_that_end_or_hand_on_a_request_wrongly_are_taken_back(
    system: hf.ActorSystem, bad: Mechanism, why: str, below: Mechanism
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=below))
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, (bad, *stack(ref)))
    outcome = await taken_back(change)
    assert why in outcome.why
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == (below.name,)


class Waits(hf.system.Operation):
    """A step whose end waits until it is known what comes of the change that another one makes."""

    verb = "wait"

    def __init__(self, settled: Any) -> None:
        super().__init__("probation")
        self._settled = settled

    async def check(self, system: hf.ActorSystem, draft: Any) -> None: ...

    async def finish(self, system: hf.ActorSystem) -> None:
        await self._settled


@pytest.mark.parametrize("below", [(TR(),), ()], ids=["adapt", "attach"])
async def test_how_a_change_went_is_told_however_late_one_asks(
    system: hf.ActorSystem, below: tuple[Mechanism, ...]
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=below or None))
    load = Load(ref)
    await load.reached(20)
    settled = asyncio.get_running_loop().create_future()

    def seen(event: object) -> None:
        if isinstance(event, MechanismSettled) and not settled.done():
            settled.set_result(None)

    system._node.events.add_sink(seen)
    async with system.transaction(timeout=60) as change:
        change.step(Waits(settled))
        if below:
            change.protect(ref, (Dropping(), *stack(ref)))
        else:
            change.protect(ref, Dropping())
    await taken_back(change)
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))


@pytest.mark.parametrize("part", ["before", "after"])
@pytest.mark.parametrize(
    ("below", "whose"),
    [(PBR(), "leader"), (LFR(), "leader"), (LFR(), "other"), (TMR(), "leader"), (TR(), "leader")],
    ids=str,
)
@pytest.mark.some(5)
async def test_a_brick_that_does_not_return_is_told_in_whatever_role(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, below: Mechanism, whose: str, part: str
) -> None:
    monkeypatch.setattr(probation, "MOST_SECONDS", 8.0)
    monkeypatch.setattr(probation, "SECONDS", 2.0)
    for module in (probation, hung):  # What is found too soon, on a busy machine, is found as well.
        monkeypatch.setattr(module, "STUCK_AFTER", 1.0)
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=below))
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, (Wrong("hang", "message", part, whose), *stack(ref)))
    outcome = await taken_back(change)
    assert "let nothing pass" in outcome.why
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert stack(ref) == (below.name,)


async def test_an_actor_whose_attached_mechanism_fails_is_unprotected_again(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, (Wrong("exit", "message", "before", "leader"), PBR()))
    outcome = await taken_back(change)
    assert (outcome.before, outcome.layers) == ((), ("wrong", "pbr"))
    assert not (await system.protection(ref)).is_protected
    assert ref._cell.spec.mechanism is None
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, PBR())
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))


async def test_detaching_ends_the_probation_of_what_was_attached(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    async with system.transaction(timeout=60) as attached:
        attached.protect(ref, PBR())
    async with system.transaction(timeout=60) as change:
        change.protect(ref, None)
    async with asyncio.timeout(60):
        (outcome,) = await attached.settled()
    assert outcome.is_kept
    assert "before its time was over" in outcome.why, "it has not passed"
    assert await change.settled() == ()


async def test_who_is_stopped_during_the_probation_has_not_passed(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    async with system.transaction(timeout=60) as change:
        change.protect(ref, PBR())
    await system.stop(ref)
    async with asyncio.timeout(20):
        (outcome,) = await change.settled()
    assert (outcome.is_kept, outcome.layers) == (True, ("pbr",))
    assert "before its time was over" in outcome.why


@pytest.mark.parametrize("bad", [Dropping(), Ending()], ids=lambda one: one.name)
async def test_a_stack_is_taken_back_below_a_supervisor_with_a_process_of_its_own(
    system: hf.ActorSystem, bad: Mechanism
) -> None:
    await system.start(bank(hf.child("alice", hf.start(Counter), mechanism=PBR())))
    ref = system.ref("/app/bank/alice", Counter)
    load = Load(ref)
    await load.reached(20)
    async with system.transaction(timeout=60) as change:
        change.protect(ref, (bad, *stack(ref)))
    await taken_back(change)
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    await system.terminate(ref)  # Its supervisor, in the process, starts it again.
    assert await ref.ask(Add(0), timeout=60) == 1
    assert stack(ref) == ("pbr",)


@pytest.mark.parametrize("is_killed", [True, False])
async def test_a_root_that_is_killed_on_probation_comes_back_with_the_stack_before(
    tmp_path: Path, is_killed: bool
) -> None:
    """One that is closed in good order has settled it."""
    store = f"sqlite:{tmp_path / 'store.db'}"
    command = [sys.executable, probation_root.__file__, store]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": PATHS}
    ) as root:
        assert root.stdin is not None
        assert root.stdout is not None
        assert await asyncio.to_thread(root.stdout.readline) == "changed\n"
        if is_killed:
            root.kill()
        root.stdin.close()
    undone = ["probation"] * 2 if is_killed else []
    for _ in range(2):
        async with hf.ActorSystem("app", store=store, log=False) as system:
            with system.events() as events:
                alice, bob = [await system.start(one) for one in probation_root.SPECS]
                assert [one.step for one in events.take() if isinstance(one, AdaptationUndone)] == undone
            assert await alice.ask(Tags()) == [0]
            found = (await system.protection(alice)).stack, (await system.protection(bob)).stack
            assert found == (((), ("pbr",)) if is_killed else (("pbr",), ("lfr",)))
        undone = []
