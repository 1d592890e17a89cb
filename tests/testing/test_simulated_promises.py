"""What is promised of messages and supervisors, under many orders and faults: each seed is another run.

Actors in processes of their own are killed in `tests/checkpoint/test_campaign.py`; here all is in one process, exactly.
"""

import asyncio
from typing import Any

import holdfast as hf
from holdfast.testing import Faults, GuardedSystem, Simulation, idle, probe, simulate
from holdfast.testing.simulation import run_seed

KEPT = hf.hybrid(interval=0.02, max_deliveries=1000)  # Kills by the dozen, and no message is to blame.


class Put(hf.Message[int]):
    source: str
    n: int


class All(hf.Message[list[tuple[str, int]]]): ...


class Send(hf.Message):
    to: hf.ActorRef
    count: int


class Store(hf.Actor):
    def __init__(self) -> None:
        self.items: list[tuple[str, int]] = []

    @hf.on(Put)
    async def put(self, message: Put) -> int:
        self.items.append((message.source, message.n))
        if message.n % 3 == 0:
            await asyncio.sleep(0.01)
        return len(self.items)

    @hf.on(All, readonly=True)
    def read(self, message: All) -> list[tuple[str, int]]:
        return list(self.items)


class Source(hf.Actor):
    @hf.on(Send)
    async def send(self, message: Send) -> None:
        for n in range(message.count):
            message.to.tell(Put(self.ctx.path, n))
            await asyncio.sleep(self.ctx.random.random() * 0.01)


@simulate(seeds=100, intensity=1000)
async def test_a_killed_recorded_actor_applies_each_accepted_message_once_and_in_order(
    system: GuardedSystem, simulation: Simulation
) -> None:
    """T14, T20: kills fall anywhere, in the middle of turns too."""
    store = await system.start(hf.child("store", hf.start(Store), recovery=KEPT))
    for name in ("a", "b"):
        system.spawn(hf.start(Source), name).tell(Send(store, 10))
    asked = [store.ask(Put("test", n), timeout=3600.0) for n in range(5)]
    for _ in range(3):
        await asyncio.sleep(0.001 + 0.01 * (simulation.seed % 7))
        store.kill()
    replies = await asyncio.gather(*asked)
    await asyncio.sleep(1.0)
    items = await store.ask(All())
    for source, count in (("/app/a", 10), ("/app/b", 10), ("test", 5)):
        assert [n for path, n in items if path == source] == list(range(count))
    assert replies == [items.index(("test", n)) + 1 for n in range(5)]
    assert store._cell.life == 4


@simulate(seeds=100, intensity=1000)
async def test_a_crash_loses_its_own_message_and_no_other(system: GuardedSystem, faults: Faults) -> None:
    """T20: whoever asked gets an answer or a typed failure; per sender the order stays."""
    system.expect_crashes()
    store = await system.start(hf.child("store", hf.start(Store), recovery=KEPT))
    async with faults.on(store, at="turn end", crash=0.2), faults.on(store, at="turn begin", crash=0.1, delay=0.1):
        asked = [store.ask(Put("test", n), timeout=3600.0) for n in range(10)]
        outcomes: list[Any] = await asyncio.gather(*asked, return_exceptions=True)
    items = await store.ask(All())
    failed = [n for n, outcome in enumerate(outcomes) if isinstance(outcome, hf.RemoteCrash)]
    assert [n for _, n in items] == [n for n in range(10) if n not in failed]
    crashes = [strike for strike in faults.strikes if strike.kind == "crash"]
    assert len(failed) <= len(crashes) == len(system.crashes)  # A turn may also crash when it is replayed.


@simulate(seeds=50)
async def test_messages_of_one_sender_keep_their_order_whoever_else_sends(system: GuardedSystem) -> None:
    sink = probe(system)
    for n in range(4):
        system.spawn(hf.start(Source), f"s{n}").tell(Send(sink.ref, 5))
    await asyncio.sleep(1.0)
    await idle(system)
    received: list[Any] = list(sink.waiting)
    assert len(received) == 20
    for n in range(4):
        assert [message.n for message in received if message.source == f"/app/s{n}"] == list(range(5))


class Crash(hf.Message): ...


class Fragile(hf.Actor):
    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("crash")


@simulate(seeds=50)
async def test_one_for_all_brings_all_back_whoever_crashes_and_however_they_coincide(system: GuardedSystem) -> None:
    system.expect_crashes()
    children = [hf.child(name, hf.start(Fragile)) for name in "abc"]
    await system.start(hf.supervisor("s", strategy="one_for_all", intensity=100, children=children))
    refs = [system.ref(f"/app/s/{name}", Fragile) for name in "abc"]
    for ref in refs:
        ref.tell(Crash())
    await idle(system)
    lives = [ref._cell.life for ref in refs]
    assert all(ref._cell.state == "running" for ref in refs)
    assert 2 <= max(lives) <= 4
    assert len(system.crashes) == 3  # What was queued at a sibling that was restarted is kept, and crashes it in turn.


def test_runs_with_recovery_are_exact_too() -> None:
    def trace(seed: int) -> list[Any]:
        async def run(system: GuardedSystem) -> None:
            store = await system.start(hf.child("store", hf.start(Store), recovery=KEPT))
            for name in "abcd":
                system.spawn(hf.start(Source), name).tell(Send(store, 5))
            await asyncio.sleep(0.02)
            store.kill()
            await asyncio.sleep(1.0)
            items.extend(await store.ask(All()))

        items: list[Any] = []
        return [run_seed(run, seed, {"system"}, {}).trace, items]

    for seed in range(5):
        assert trace(seed) == trace(seed)
    assert trace(0) != trace(1)


@simulate(seeds=3)
async def test_runs_that_are_compared_are_repeated_by_their_seed(system: GuardedSystem) -> None:
    """What they are called belongs to the system, and not to the process of the tests."""
    ref = await system.start(hf.child("store", hf.start(Store), recovery=hf.hybrid(), mechanism=hf.ftm.TMR()))
    for n in range(3):
        await ref.ask(Put("test", n), timeout=3600.0)
    assert [n for _, n in await ref.ask(All(), timeout=3600.0)] == [0, 1, 2]
