"""What mechanisms do not do: docs/mechanisms-limits.md. When one of these is lifted, its line there goes too."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import TurnsLost
from tests.ftm.accounts import Add, Closed, Counter
from tests.ftm.test_failover import is_complete, pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


class Large(Counter):
    """Has more than the root keeps a copy of."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.load = os.urandom(size)


class Blocks(Counter):
    """An alternate that neither returns nor awaits anything."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        time.sleep(3600.0)
        return 0


def is_lucky(message: Any) -> bool:
    """An acceptance test that accepts nothing for one tag."""
    return not isinstance(message, Add) or message.tag != 13


def kill_both(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    for name in ("r1", "r2"):
        os.kill(pid_of(system, ref, name), signal.SIGKILL)


async def until_event(events: Any, kind: type[Any]) -> None:
    async for event in events:
        if isinstance(event, kind):
            return


async def test_replicas_run_wherever_the_kernel_has_them_run(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=hf.ftm.PBR()))
    await two_again(ref)
    for name in ("r1", "r2"):
        assert os.sched_getaffinity(pid_of(system, ref, name)) == os.sched_getaffinity(0)


async def test_without_state_access_a_follower_that_has_died_is_back_with_the_next_life(
    system: hf.ActorSystem,
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Closed), mechanism=hf.ftm.LFR()))
    with system.events() as events:
        assert await ref.ask(Add(1), timeout=60) == 1
        os.kill(pid_of(system, ref, "r2"), signal.SIGKILL)
        await until_event(events, hf.events.ReplicaLost)
        assert await ref.ask(Add(2), timeout=60) == 2
        os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
        await until_event(events, TurnsLost)
        assert await ref.ask(Add(3), timeout=60) == 1, "it begins afresh, and not alone"
        assert is_complete(ref)
        os.kill(pid_of(system, ref, "r2"), signal.SIGKILL)
        await until_event(events, hf.events.ReplicaLost)
    await system.ref("/app", hf.Supervisor).ask(hf.RestartChild("alice", running=True), timeout=60)
    assert is_complete(ref)
    assert await ref.ask(Add(4), timeout=60) == 1


@pytest.mark.parametrize(("size", "kept"), [(1_000, True), (20_000_000, False)])
async def test_the_root_keeps_no_large_state_for_a_stack_on_probation(
    system: hf.ActorSystem, size: int, kept: bool
) -> None:
    """Nobody keeps anything of an actor without recovery besides its replicas, but a copy on probation."""
    ref = await system.start(hf.child("alice", hf.start(Large, size)))
    assert await ref.ask(Add(1), timeout=60) == 1
    async with system.transaction(timeout=60) as change:
        change.protect(ref, hf.ftm.PBR())
    await two_again(ref)
    assert await ref.ask(Add(2), timeout=60) == 2
    with system.events() as events:
        kill_both(system, ref)
        assert await ref.ask(Add(3), timeout=60) == (3 if kept else 1)
        if not kept:
            await until_event(events, TurnsLost)


async def test_an_alternate_that_blocks_costs_the_life_and_its_message_is_put_aside(system: hf.ActorSystem) -> None:
    """It is not stopped: its replica is silent, and is ended for that."""
    quick = hf.ftm.Detection(interval=0.02, pause=0.2, hopeless=0.5)
    blocks = hf.ftm.RB(alternates=(Blocks,), test=(is_lucky,), detection=quick)
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=blocks))
    assert await ref.ask(Add(1), timeout=60) == 1
    with pytest.raises(hf.Quarantined):
        await ref.ask(Add(13), timeout=60)
    assert await ref.ask(Add(2), timeout=60) == 1, "without recovery the state went with the life"


class Book(hf.Message[None]):
    who: str


class Open(hf.Message[None]): ...


class Booked(hf.Message[list[str]]): ...


class Hotel(hf.Actor):
    """Puts aside what comes before it is open."""

    def __init__(self) -> None:
        self.is_open = False
        self.booked: list[str] = []

    @hf.on(Book)
    def book(self, message: Book) -> None:
        if self.is_open:
            self.booked.append(message.who)
        else:
            self.ctx.stash()

    @hf.on(Open)
    def open(self, message: Open) -> None:
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Booked)
    def all_booked(self, message: Booked) -> list[str]:
        return self.booked


@pytest.mark.parametrize(
    ("mechanism", "served"),
    [(hf.ftm.PBR(), []), (hf.ftm.TMR(), []), (hf.ftm.LFR(), ["late"]), (hf.ftm.TR(), ["late"])],
    ids=["pbr", "tmr", "lfr", "tr"],
)
@pytest.mark.some(2)
async def test_behind_lfr_and_tr_an_ask_that_was_put_aside_is_handled_when_its_time_is_over(
    system: hf.ActorSystem, mechanism: Any, served: list[str]
) -> None:
    """The replicas, or the runs, have decided together that it was begun in time."""
    hotel = await system.start(hf.child("hotel", hf.start(Hotel), mechanism=mechanism))
    assert await hotel.ask(Booked(), timeout=60) == []
    late = hotel.ask(Book("late"), timeout=3.0)
    assert await hotel.ask(Booked(), timeout=60) == []
    with pytest.raises(hf.AskTimeout):
        await late
    await hotel.ask(Open(), timeout=60)
    assert await hotel.ask(Booked(), timeout=60) == served


class Promise(hf.Message[str]): ...


class Forgetful(Counter):
    """Holds the handle of a later reply where no state has it."""

    _handle: hf.ReplyHandle[str] | None = None

    @hf.on(Promise)
    def promise(self, message: Promise) -> hf.ReplyHandle[str]:
        self._handle = self.ctx.reply_handle()
        return self._handle


async def test_a_promised_reply_whose_handle_is_in_no_state_ends_by_its_deadline_after_a_failover(
    system: hf.ActorSystem,
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Forgetful), mechanism=hf.ftm.PBR()))
    assert await ref.ask(Add(1), timeout=60) == 1
    await two_again(ref)
    asked = ref.ask(Promise(), timeout=4.0)
    assert await ref.ask(Add(2), timeout=60) == 2
    os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
    assert await ref.ask(Add(3), timeout=60) == 3
    with pytest.raises(hf.AskTimeout):
        await asked
