"""The death of the root in a simulated run: what its store has comes back, and nothing else of it goes on."""

from __future__ import annotations

import asyncio
import gc
import warnings
from collections.abc import Awaitable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import StaleEpoch, StoreFailed
from holdfast.testing import Faults, GuardedSystem, Simulation, UnexpectedEnd, advance, idle, simulate
from holdfast.testing.schedules.disk import NoRootToKill, SimulatedDisk
from holdfast.testing.simulation import run_seed

DISK: dict[str, Any] = {"store": "simulated"}
OWN = {"system", "simulation"}


class Add(hf.Message[int]):
    number: int


class Total(hf.Message[int]):
    pass


class Told(hf.Message):
    number: int


class Ping(hf.Message[int]):
    pass


class Sum(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.number
        return self.total

    @hf.on(Total)
    def report(self, message: Total) -> int:
        return self.total


RAN: list[str] = []
"""Who has run; simulated processes share it."""


class Beat(hf.Actor):
    """Runs every second, by a timer, by a task and by a turn that waits."""

    async def on_start(self, restored: bool) -> None:
        self.ctx.every(1.0, Told(0))
        self.ctx.create_task(self.go_on())

    async def go_on(self) -> None:
        try:
            while True:
                await asyncio.sleep(1.0)
                RAN.append("task")
        finally:
            RAN.append("end")

    @hf.on(Told)
    async def beat(self, message: Told) -> None:
        RAN.append("timer")
        await asyncio.sleep(0.5)
        RAN.append("turn")

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        return 1


async def start_sum(system: GuardedSystem, **options: Any) -> hf.ActorRef[Sum]:
    return await system.start(hf.child("sum", hf.start(Sum), **options))


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("power", [False, True])
def test_what_was_acknowledged_is_there_after_a_kill_at_any_moment(isolation: Any, power: bool) -> None:
    options: dict[str, Any] = {"recovery": hf.hybrid(interval=3), "isolation": isolation}
    missing = failed = 0

    async def killed(system: GuardedSystem, simulation: Simulation) -> None:
        nonlocal missing, failed
        ref = await start_sum(system, **options)
        asked = acknowledged = 0

        async def client(*, asks: bool) -> None:
            nonlocal asked, acknowledged, failed
            for _ in range(8):
                try:
                    asked += 1
                    await (ref.ask(Add(1)) if asks else ref.send(Add(1)))
                    acknowledged += 1
                except hf.AskFailed:
                    failed += 1
                except hf.ActorStopped:
                    return

        clients = [asyncio.create_task(client(asks=number % 2 == 0)) for number in range(4)]
        for _ in range(2):
            await simulation.moment(40)
            system = await simulation.crash_root(power=power)
            ref = await start_sum(system, **options)
            least = acknowledged
            total = await ref.ask(Total())
            assert least <= total <= asked, (least, total, asked)
            missing += total < asked
        await asyncio.gather(*clients)

    simulate(killed, seeds=60, durability="fsync" if power else "os", sync=(0.0, 0.01), **DISK)()
    assert failed, "no kill came while somebody waited"
    assert missing, "every ask was handled, whenever the kill came"


def test_a_power_cut_takes_what_was_only_written() -> None:
    found = set[int]()

    async def killed(system: GuardedSystem, simulation: Simulation) -> None:
        ref = await start_sum(system, recovery=hf.hybrid())
        for _ in range(5):
            await ref.ask(Add(1))
        system = await simulation.crash_root(power=True)
        found.add(await (await start_sum(system, recovery=hf.hybrid())).ask(Total()))

    simulate(killed, seeds=60, durability="os", **DISK)()
    assert found > {0, 3}
    found.clear()
    simulate(killed, seeds=30, durability="fsync", **DISK)()
    assert found == {5}


@simulate(seeds=20, **DISK)
async def test_nothing_of_the_old_root_runs(system: GuardedSystem, simulation: Simulation) -> None:
    RAN.clear()
    ref = await system.start(hf.child("beat", hf.start(Beat)))
    await system.start(hf.supervisor("top", children=[hf.child("beat", hf.start(Beat))], isolation="process"))
    await asyncio.sleep(3.2)
    await idle(system)
    assert {*RAN} == {"task", "timer", "turn"}
    ref.tell(Told(2))
    await simulation.moment()
    await simulation.crash_root()
    heard, before = len(RAN), len(simulation.trace)
    ref.tell(Told(3))
    with pytest.raises(hf.ActorStopped):
        await ref.ask(Ping())
    await asyncio.sleep(10.0)
    assert len(RAN) == heard
    assert not [path for path, _ in simulation.trace[before:] if "beat" in path]


@simulate(seeds=10)
async def test_without_a_store_nothing_comes_back(system: GuardedSystem, simulation: Simulation) -> None:
    ref = await start_sum(system, recovery=hf.hybrid())
    assert await ref.ask(Add(3)) == 3
    waits = asyncio.create_task(system.start(hf.child("slow", hf.start(Beat), recovery=hf.hybrid())))
    system = await simulation.crash_root()
    ref = await start_sum(system, recovery=hf.hybrid())
    assert await ref.ask(Total()) == 0
    [end] = await asyncio.gather(waits, return_exceptions=True)
    assert isinstance(end, hf.HoldfastError | hf.ActorRef)


@simulate(seeds=10, **DISK)
async def test_kept_children_come_back(system: GuardedSystem, simulation: Simulation) -> None:
    pool = await system.start(hf.dynamic("pool", journal=True))
    one = await pool.ask(hf.StartChild(hf.child("one", hf.start(Sum), recovery=hf.hybrid())))
    assert await one.ask(Add(4)) == 4
    system = await simulation.crash_root()
    await system.start(hf.dynamic("pool", journal=True))
    assert await system.ref("/app/pool/one", Sum).ask(Total()) == 4


def test_the_same_seed_is_the_same_run() -> None:
    async def killed(system: GuardedSystem, simulation: Simulation) -> None:
        ref = await start_sum(system, recovery=hf.hybrid(interval=2), isolation="process")
        asks = [asyncio.ensure_future(ref.ask(Add(1))) for _ in range(6)]
        await simulation.moment(30)
        system = await simulation.crash_root(power=True)
        ref = await start_sum(system, recovery=hf.hybrid(interval=2), isolation="process")
        total = await ref.ask(Total())
        simulation.trace.append(("total", f"{total} {sum(one.exception() is not None for one in asks)}"))

    first, again = (
        [run_seed(killed, seed, OWN, {"durability": "fsync", **DISK}).trace for seed in range(12)] for _ in range(2)
    )
    assert first == again
    assert len({str(trace) for trace in first}) > 6


def test_a_root_that_acknowledges_too_early_is_found() -> None:
    """The promise is broken on purpose: acknowledged before the sync, whatever the child's durability says."""

    async def killed(system: GuardedSystem, simulation: Simulation) -> None:
        ref = await start_sum(system, recovery=hf.hybrid(durability="os"))
        total = await ref.ask(Add(1))
        await simulation.moment(10)
        system = await simulation.crash_root(power=True)
        assert await (await start_sum(system, recovery=hf.hybrid())).ask(Total()) == total

    with pytest.raises(AssertionError) as caught:
        simulate(killed, durability="fsync", **DISK)()
    note = "\n".join(caught.value.__notes__)
    assert "loss=1:" in note
    assert "shrunk to" in note


def test_what_cannot_be_killed_is_refused(tmp_path: Path) -> None:
    class Killer(hf.Actor):
        def __init__(self, simulation: Simulation) -> None:
            self.simulation = simulation

        @hf.on(Add)
        async def kill(self, message: Add) -> int:
            with pytest.raises(NoRootToKill, match="only the test"):
                await self.simulation.crash_root()
            return 1

    async def inside(system: GuardedSystem, simulation: Simulation) -> None:
        assert await system.spawn(hf.start(Killer, simulation)).ask(Add(1)) == 1

    simulate(inside, seeds=2)()

    async def held(system: GuardedSystem, simulation: Simulation) -> None:
        with pytest.raises(NoRootToKill, match="simulated"):
            await simulation.crash_root()

    simulate(held, seed=1, store=f"sqlite:{tmp_path / 'store'}")()
    with pytest.raises(ValueError, match="one turn or more"):
        simulate(_no_moment, seed=1)()
    with pytest.raises(hf.SpecError, match="sync"):
        simulate(_no_moment, sync=-1.0)


async def _no_moment(system: GuardedSystem, simulation: Simulation) -> None:
    await simulation.moment(0)


def test_an_older_opening_writes_nothing() -> None:
    disk = SimulatedDisk()
    old = disk.open()
    old.append([("/app/a", ("in", 1))])
    new = disk.open()
    for write in (lambda: old.append([("/app/a", ("in", 2))]), lambda: old.note("k", b"v"), old.sync):
        with pytest.raises(StaleEpoch):
            write()
    assert [entry for _, entry in new.load("/app/a").entries] == [("in", 1)]
    new.close()
    with pytest.raises(StoreFailed, match="closed"):
        new.append([("/app/a", ("in", 3))])


def test_a_sync_takes_drawn_seconds() -> None:
    took = set[float]()

    async def adds(system: GuardedSystem, simulation: Simulation) -> None:
        ref = await start_sum(system, recovery=hf.hybrid())
        loop = asyncio.get_running_loop()
        began = loop.time()
        assert await ref.ask(Add(1)) == 1
        took.add(loop.time() - began)

    simulate(adds, seeds=10, durability="fsync", sync=(0.25, 0.5), **DISK)()
    assert all(0.25 <= seconds < 5.0 for seconds in took)
    assert len(took) > 3
    took.clear()
    simulate(adds, seeds=10, durability="fsync", sync=0.5, **DISK)()
    assert all(seconds % 0.5 == 0.0 for seconds in took)


@simulate(seeds=20, **DISK)
async def test_there_is_one_root(system: GuardedSystem, simulation: Simulation) -> None:
    await start_sum(system, recovery=hf.hybrid())
    first = system
    found = await asyncio.gather(*(simulation.crash_root() for _ in range(2)), return_exceptions=True)
    systems = [one for one in found if isinstance(one, GuardedSystem)]
    assert systems
    assert all(isinstance(one, NoRootToKill | GuardedSystem) for one in found)
    living = [one for one in [first, *systems] if is_running(one)]
    assert len(living) == 1
    assert await (await start_sum(living[0], recovery=hf.hybrid())).ask(Add(1)) == 1


def is_running(system: GuardedSystem) -> bool:
    try:
        system.spawn(hf.start(Sum))
    except hf.HoldfastError:
        return False
    return True


@pytest.mark.holdfast(store="simulated")
@simulate(seeds=3)
async def test_the_marker_may_name_the_store(system: GuardedSystem, simulation: Simulation) -> None:
    ref = await start_sum(system, recovery=hf.hybrid())
    assert await ref.ask(Add(2)) == 2
    system = await simulation.crash_root()
    assert await (await start_sum(system, recovery=hf.hybrid())).ask(Total()) == 2


def test_a_sync_needs_the_simulated_store() -> None:
    async def nothing(system: GuardedSystem) -> None:
        """Never begun."""

    with pytest.raises(hf.SpecError, match="give store='simulated'"):
        simulate(nothing, sync=1.0)()


@simulate(seeds=20, **DISK)
async def test_a_restart_that_is_given_up_can_be_tried_again(system: GuardedSystem, simulation: Simulation) -> None:
    ref = await start_sum(system, recovery=hf.hybrid())
    assert await ref.ask(Add(2)) == 2
    for _ in range(3):
        attempt = asyncio.create_task(simulation.crash_root())
        for _ in range(2):  # It has begun, and its successor is not up.
            await asyncio.sleep(0)
        attempt.cancel()
        [outcome] = await asyncio.gather(attempt, return_exceptions=True)
        if isinstance(outcome, GuardedSystem):  # It came up before.
            system = outcome
    system = await simulation.crash_root()
    assert await (await start_sum(system, recovery=hf.hybrid())).ask(Total()) == 2


@simulate(seeds=10, **DISK)
async def test_another_system_of_the_test_lives_on(system: GuardedSystem, simulation: Simulation) -> None:
    async with GuardedSystem("other") as other:
        beat = await other.start(hf.child("beat", hf.start(Beat)))
        waits = asyncio.create_task(beat.send(Told(1)))
        ticks = asyncio.create_task(advance(5.0))
        await simulation.crash_root()
        await asyncio.gather(waits, ticks)
        assert await beat.ask(Ping()) == 1


@simulate(seeds=10, **DISK)
async def test_whoever_waits_hears_of_the_kill(system: GuardedSystem, simulation: Simulation, faults: Faults) -> None:
    ref = await start_sum(system, recovery=hf.hybrid(durability="fsync"))
    with faults.on(ref, at="reply", delay=1.0, seconds=60.0):
        waits: list[Awaitable[object]] = [ref.ask(Add(1), 3600.0), asyncio.ensure_future(ref.send(Add(1)))]
        await asyncio.sleep(1.0)
        last = asyncio.ensure_future(ref.send(Add(1)))
        await asyncio.sleep(0)
        system = await simulation.crash_root()
        ends = await asyncio.gather(*waits, last, return_exceptions=True)
        assert isinstance(ends[0], hf.AskFailed)
        assert ends[1] is None
        assert ends[2] is None or isinstance(ends[2], hf.AskFailed | hf.ActorStopped)
    assert asyncio.get_running_loop().time() < 10.0


class Refused(hf.Refusal): ...


class Refusing(hf.Actor):
    @hf.on(Ping)
    def refuse(self, message: Ping) -> int:
        raise Refused


class Asking(hf.Actor):
    """Asks once, or twice at once, and takes a refusal for an answer."""

    other: hf.Binding[Refusing]

    def __init__(self) -> None:
        self.refusals = 0

    @hf.on(Told)
    async def ask(self, message: Told) -> None:
        try:
            if message.number == 1:
                await self.other.ask(Ping())
            else:
                await asyncio.gather(self.other.ask(Ping()), self.other.ask(Ping()))
        except (Refused, hf.AskTimeout):
            self.refusals += 1


@pytest.mark.parametrize("asks", [1, 2])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()])
def test_a_refusal_that_a_killed_root_has_not_seen_is_no_leak(recovery: hf.Method | None, asks: int) -> None:
    tree = [
        hf.child("refusing", hf.start(Refusing), recovery=recovery),
        hf.child("asking", hf.start(Asking), recovery=hf.hybrid(), bindings={"other": "/app/refusing"}),
    ]

    @simulate(seeds=60, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        _, asking = [await system.start(spec) for spec in tree]
        asking.tell(Told(asks))
        await simulation.moment(12)
        system = await simulation.crash_root()
        for spec in tree:
            await system.start(spec)
        await advance(20.0)

    run()


def test_what_a_client_has_not_awaited_is_a_leak_also_if_the_root_is_killed_later() -> None:
    left: list[asyncio.Future[int]] = []

    @simulate(seed=0, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        refusing = await system.start(hf.child("refusing", hf.start(Refusing)))
        left.append(refusing.ask(Ping()))
        await idle(system)
        await simulation.crash_root()

    with pytest.raises(UnexpectedEnd, match="nobody has awaited the ask of Ping"):
        run()


class Pipes(hf.Actor):
    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        self.ctx.pipe_to_self(asyncio.sleep(1.0), lambda _: Told(0))
        return 1

    @hf.on(Told)
    def told(self, message: Told) -> None:
        pass


@simulate(seeds=8, **DISK)
async def test_background_work_that_ends_as_the_test_does_holds_up_no_shutdown(system: GuardedSystem) -> None:
    """With seed 3, its result is submitted and the actor that has it written is told so, and then that one ends."""
    pipes = await system.start(hf.child("pipes", hf.start(Pipes), recovery=hf.hybrid()))
    await pipes.ask(Ping())
    await asyncio.sleep(1.0)


def test_background_work_that_had_not_begun_when_the_root_was_killed_is_closed() -> None:
    async def killed(system: GuardedSystem, simulation: Simulation) -> None:
        system.expect_crashes()
        pipes = await system.start(hf.child("pipes", hf.start(Pipes), recovery=hf.hybrid()))
        await pipes.ask(Ping())
        await simulation.crash_root()

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for seed in range(12):
            run_seed(killed, seed, OWN, DISK)
        gc.collect()
    assert [str(one.message) for one in caught if "never awaited" in str(one.message)] == []
