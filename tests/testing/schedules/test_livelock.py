"""A run that goes on for ever at one moment of virtual time is told after a budget; a burst that ends is not."""

from __future__ import annotations

import asyncio
import time

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, NotIdle, idle, simulate
from holdfast.testing.schedules.choices import Choices, Production, Walk
from holdfast.testing.schedules.strategies import Priorities
from holdfast.testing.simulation import run_schedule

SCHEDULES = [Production(0), Walk(1), Walk(2, 0.9), Priorities(1, 3, 1000), Priorities(2, 1, 1000)]


class Again(hf.Message):
    """Told on."""


class Piece(hf.Message):
    """One of many."""


class Restless(hf.Actor):
    """Tells itself, or another one, for ever."""

    def __init__(self, other: hf.ActorRef[hf.Actor] | None = None) -> None:
        self.to = other

    @hf.on(Again)
    def again(self, message: Again) -> None:
        (self.to or self.ctx.ref).tell(Again())

    @hf.on(Piece)
    def piece(self, message: Piece) -> None:
        self.to = self.ctx.sender


class Passer(hf.Actor):
    """Passes each piece on, and counts them."""

    def __init__(self, to: hf.ActorRef[hf.Actor] | None = None) -> None:
        self.to, self.count = to, 0

    @hf.on(Piece)
    def piece(self, message: Piece) -> None:
        self.count += 1
        if self.to is not None:
            self.to.tell(message)


@pytest.mark.parametrize("choices", SCHEDULES, ids=lambda one: f"{type(one).__name__}{one.seed}")
def test_an_actor_that_tells_itself_for_ever_is_named(choices: Choices) -> None:
    async def restless(system: GuardedSystem) -> None:
        system.spawn(hf.start(Restless), "restless").tell(Again())
        await asyncio.Event().wait()

    began = time.perf_counter()
    with pytest.raises(NotIdle, match=r"10000 ticks of the loop at virtual time 0 s: /app/restless \(Again\)"):
        run_schedule(restless, choices, {"system"}, {})
    assert time.perf_counter() - began < 30.0  # 0.3 s on a machine that does nothing else


def test_whoever_waits_for_rest_hears_of_it() -> None:
    async def restless(system: GuardedSystem) -> None:
        system.spawn(hf.start(Restless), "restless").tell(Again())
        with pytest.raises(NotIdle, match=r"200 ticks of the loop at virtual time 0 s: /app/restless \(Again\)"):
            await idle(system)

    run_schedule(restless, Walk(1), {"system"}, {}, ticks=200)


@pytest.mark.parametrize("choices", SCHEDULES, ids=lambda one: f"{type(one).__name__}{one.seed}")
def test_who_is_held_up_does_not_hide_those_who_go_on_for_ever(choices: Choices) -> None:
    """Two tell each other, while the schedule may hold up a third one for as long as it likes."""

    async def restless(system: GuardedSystem) -> None:
        one = system.spawn(hf.start(Restless), "one")
        system.spawn(hf.start(Restless, one), "two").tell(Again())
        late = system.spawn(hf.start(Passer), "late")
        for _ in range(10):
            late.tell(Piece())
        await asyncio.Event().wait()

    with pytest.raises(NotIdle, match="/app/one"):
        run_schedule(restless, choices, {"system"}, {}, ticks=500)


def test_a_task_that_never_waits_is_named() -> None:
    @simulate(seeds=1, ticks=300)
    async def spins(system: GuardedSystem) -> None:
        async def spinner() -> None:
            while True:
                await asyncio.sleep(0)

        task = asyncio.get_running_loop().create_task(spinner(), name="the spinner")
        await asyncio.Event().wait()
        task.cancel()

    with pytest.raises(NotIdle, match="300 ticks of the loop at virtual time 0 s: the spinner"):
        spins()


@pytest.mark.parametrize("choices", SCHEDULES, ids=lambda one: f"{type(one).__name__}{one.seed}")
def test_a_burst_that_ends_is_no_alarm_however_long_it_is(choices: Choices) -> None:
    """50,000 messages in one mailbox, each passed on twice, with a budget of 100 ticks."""

    async def drains(system: GuardedSystem) -> None:
        system.look_away()
        last = system.spawn(hf.start(Passer), "last")
        middle = system.spawn(hf.start(Passer, last), "middle")
        first = system.spawn(hf.start(Passer, middle), "first")
        for _ in range(50_000):
            first.tell(Piece())
        await idle(system)
        counter = last._cell.actor
        assert isinstance(counter, Passer)
        assert counter.count == 50_000

    run_schedule(drains, choices, {"system"}, {}, looks=False, ticks=100)


def test_time_that_passes_ends_the_count() -> None:
    async def beats(system: GuardedSystem) -> None:
        one = system.spawn(hf.start(Passer), "one")
        for _ in range(1000):
            one.tell(Piece())
            await asyncio.sleep(0.001)

    run_schedule(beats, Walk(1), {"system"}, {}, ticks=20)


def test_no_ticks_are_refused() -> None:
    with pytest.raises(ValueError, match="one tick or more"):
        simulate(ticks=0)
