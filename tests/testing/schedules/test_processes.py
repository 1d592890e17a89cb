"""Actors in processes of their own under a seed: the real frames and codec, and a kill at every frame."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.testing import Faults, GuardedSystem, Simulation, idle, simulate
from holdfast.testing.schedules.choices import Walk
from holdfast.testing.schedules.processes import FIRST_PID
from holdfast.testing.simulation import run_schedule

OWN = {"system", "faults", "simulation"}


class Add(hf.Message[int]):
    number: int


class Slowly(hf.Message[int]):
    seconds: float


class Total(hf.Message[int]): ...


class Counter(hf.Actor):
    def __init__(self, log: str = "") -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.number
        return self.total

    @hf.on(Total)
    def get(self, message: Total) -> int:
        return self.total

    @hf.on(Slowly)
    async def slowly(self, message: Slowly) -> int:
        await asyncio.sleep(message.seconds)
        return self.total


CLEANED: list[str] = []


class Cleaner(hf.Actor):
    """Would clean up if its process were not killed."""

    @hf.on(Slowly)
    async def slowly(self, message: Slowly) -> int:
        try:
            await asyncio.sleep(message.seconds)
        finally:
            CLEANED.append("its turn")
        return 0

    def on_stop(self, reason: Any) -> None:
        CLEANED.append("on_stop")


async def counter(system: GuardedSystem, **options: Any) -> hf.ActorRef[Counter]:
    spec = hf.child("counter", hf.start(Counter), isolation="process", backoff=hf.Backoff(0.001), **options)
    ref: hf.ActorRef[Counter] = await system.start(spec)
    return ref


@simulate(seeds=30, latency=(0.0, 0.01), intensity=1000)
async def test_a_recorded_actor_loses_nothing_when_its_process_is_killed(
    system: GuardedSystem, simulation: Simulation
) -> None:
    system.expect_crashes()
    ref = await counter(system, recovery=hf.hybrid())
    asks = [ref.ask(Add(1)) for _ in range(5)]
    simulation.kill_process(ref)
    assert sorted(await asyncio.gather(*asks)) == [1, 2, 3, 4, 5]
    assert await ref.ask(Total()) == 5


class Grow(hf.Message[int]):
    size: int


class Large(hf.Actor):
    """Its state is passed on in shared memory."""

    def __init__(self) -> None:
        self.data = b""

    @hf.on(Grow)
    def grow(self, message: Grow) -> int:
        self.data += bytes(message.size)
        return len(self.data)


@simulate(seeds=3, latency=(0.0, 0.01), intensity=1000)
async def test_a_state_of_megabytes_survives_a_kill(system: GuardedSystem, simulation: Simulation) -> None:
    system.expect_crashes()
    spec = hf.child("large", hf.start(Large), isolation="process", recovery=hf.hybrid(), backoff=hf.Backoff(0.001))
    ref = await system.start(spec)
    assert await ref.ask(Grow(3_000_000)) == 3_000_000
    await system.checkpoint(ref)
    simulation.kill_process(ref)
    assert await ref.ask(Grow(1)) == 3_000_001


@pytest.mark.parametrize("point", ["frame out", "frame in"])
@pytest.mark.parametrize("number", range(12))
def test_a_kill_at_each_frame_loses_nothing(point: str, number: int) -> None:
    async def killed(system: GuardedSystem, faults: Faults, simulation: Simulation) -> None:
        system.expect_crashes()
        ref = await counter(system, recovery=hf.hybrid())
        with faults.on(ref, at=point, crash=1.0, after=number, times=1):
            assert [await ref.ask(Add(1)) for _ in range(4)] == [1, 2, 3, 4]
            simulation.trace.append(("struck", str(len(faults.strikes))))
        assert await ref.ask(Total()) == 4

    for seed in range(5):
        run_schedule(killed, Walk(seed), OWN, {}, latency=(0.0, 0.001))


def test_the_kills_do_strike() -> None:
    """Else the test above would show nothing."""
    struck = 0
    for number in range(12):

        async def killed(system: GuardedSystem, faults: Faults, after: int = number) -> None:
            nonlocal struck
            system.expect_crashes()
            ref = await counter(system, recovery=hf.hybrid())
            with faults.on(ref, at="frame in", crash=1.0, after=after, times=1):
                for _ in range(4):
                    await ref.ask(Add(1))
                struck += len(faults.strikes)

        run_schedule(killed, Walk(1), {"system", "faults"}, {})
    assert struck >= 4


@simulate(seeds=20)
async def test_an_ask_of_a_process_that_is_killed_fails_and_the_next_life_is_a_new_one(
    system: GuardedSystem, simulation: Simulation
) -> None:
    system.expect_crashes()
    ref = await counter(system)
    assert await ref.ask(Add(3)) == 3
    waits = ref.ask(Slowly(10.0))
    await idle(system)
    simulation.kill_process(ref)
    with pytest.raises(hf.AskFailed):
        await waits
    assert await ref.ask(Total()) == 0


def test_nothing_of_a_killed_process_runs_any_more() -> None:
    async def killed(system: GuardedSystem, simulation: Simulation) -> None:
        CLEANED.clear()
        system.expect_crashes()
        ref = await system.start(hf.child("cleaner", hf.start(Cleaner), isolation="process"))
        waits = ref.ask(Slowly(10.0))
        await idle(system)
        simulation.kill_process(ref)
        with pytest.raises(hf.AskFailed):
            await waits
        await asyncio.sleep(100.0)
        assert CLEANED == []

    for seed in range(10):
        run_schedule(killed, Walk(seed), {"system", "simulation"}, {})


@simulate(seeds=10)
async def test_an_orderly_stop_of_a_process_does_clean_up(system: GuardedSystem) -> None:
    CLEANED.clear()
    ref = await system.start(hf.child("cleaner", hf.start(Cleaner), isolation="process"))
    await system.stop(ref)
    assert CLEANED == ["on_stop"]


@simulate(seeds=10)
async def test_its_pid_is_that_of_nobody(system: GuardedSystem) -> None:
    ref = await counter(system)
    pid = system.pid_of(ref)
    assert pid >= FIRST_PID
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@simulate(seeds=10)
async def test_a_subtree_lives_in_a_process(system: GuardedSystem, simulation: Simulation) -> None:
    system.expect_crashes()
    children = [hf.child(name, hf.start(Counter)) for name in ("one", "other")]
    top = await system.start(hf.supervisor("top", children=children, isolation="process"))
    one, other = (system.ref(f"/app/top/{name}", Counter) for name in ("one", "other"))
    assert [*await asyncio.gather(one.ask(Add(1)), other.ask(Add(2)))] == [1, 2]
    simulation.kill_process(top)
    await idle(system)  # What is asked before its end is seen fails with it.
    assert [*await asyncio.gather(one.ask(Add(1)), other.ask(Add(2)))] == [1, 2]


@simulate(seeds=10)
async def test_an_actor_moves_into_a_process_and_back(system: GuardedSystem) -> None:
    ref = await system.start(hf.child("counter", hf.start(Counter)))
    assert await ref.ask(Add(1)) == 1
    for place in ("process", "task"):
        asks = [ref.ask(Add(1)) for _ in range(3)]
        await system.set_isolation(ref, place)
        await asyncio.gather(*asks)
    assert await ref.ask(Total()) == 7


@simulate(seeds=10, intensity=1000)
async def test_a_protected_actor_outlives_the_process_of_its_primary(
    system: GuardedSystem, simulation: Simulation
) -> None:
    system.expect_crashes()
    ref = await system.start(hf.child("counter", hf.start(Counter), mechanism=PBR()))
    assert await ref.ask(Add(1)) == 1
    primary = next(path for path in system._workers.processes() if path.startswith("/app/counter/"))
    asks = [ref.ask(Add(1), timeout=60.0) for _ in range(3)]
    simulation.kill_process(system.ref(primary, hf.Actor))
    assert sorted(await asyncio.gather(*asks)) == [2, 3, 4]


def test_a_run_with_processes_is_repeated() -> None:
    async def killed(system: GuardedSystem, faults: Faults, simulation: Simulation) -> None:
        system.expect_crashes()
        ref = await counter(system, recovery=hf.hybrid())
        with faults.on(ref, at="frame in", crash=0.1), faults.on(ref, at="frame out", crash=0.1):
            assert [await ref.ask(Add(1)) for _ in range(4)] == [1, 2, 3, 4]

    for seed in range(10):
        first, again = (
            run_schedule(killed, Walk(seed), OWN, {"intensity": 1000}, latency=(0.0, 0.01)) for _ in range(2)
        )
        assert first.trace == again.trace
        assert first.choices.kept() == again.choices.kept()


def test_latencies_are_virtual_time() -> None:
    seconds: list[float] = []

    async def asks(system: GuardedSystem) -> None:
        ref = await counter(system)
        loop = asyncio.get_running_loop()
        for _ in range(20):
            begin = loop.time()
            await ref.ask(Total())
            seconds.append(loop.time() - begin)

    run_schedule(asks, Walk(1), {"system"}, {}, latency=(0.5, 1.0))
    assert all(1.0 <= one <= 2.0 for one in seconds)
    assert len({round(one, 2) for one in seconds}) > 5


@pytest.mark.parametrize("latency", [-1.0, (2.0, 1.0), float("inf")])
def test_a_latency_that_cannot_be_is_refused(latency: Any) -> None:
    with pytest.raises(hf.SpecError, match="latency must be"):

        @simulate(latency=latency)
        async def late(system: GuardedSystem) -> None: ...
