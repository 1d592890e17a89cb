"""Pools: workers of one class, and a router that spreads messages over them."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections import Counter
from typing import Any

import pytest

import holdfast as hf
from tests.supervision.pools import (
    Boom,
    Gate,
    Job,
    Note,
    Notes,
    Other,
    Stranger,
    Via,
    Who,
    Worker,
    begin,
    names,
    one,
    settled,
)

# -- who gets it ---------------------------------------------------------------------------------------------------


async def test_round_robin_goes_in_turn() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system)
        assert await names(pool, 7) == "0 1 2 0 1 2 0"


async def test_random_spreads_and_is_not_in_turn() -> None:
    async with hf.ActorSystem(log=False, seed=1) as system:
        _, pool = await begin(system, routing="random")
        told = (await names(pool, 300)).split()
        counts = Counter(told)
        assert set(counts) == {"0", "1", "2"}
        assert min(counts.values()) > 60
        assert any(before == after for before, after in itertools.pairwise(told))


async def test_least_loaded_passes_over_who_is_at_work_or_has_a_queue() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, hf.start(Worker, gate), routing="least_loaded")
        one(system, 0).tell(Job(waits=True))
        for _ in range(3):
            one(system, 0).tell(Note())
        one(system, 2).tell(Job(waits=True))
        await settled(system)
        assert await names(pool, 4) == "1 1 1 1"
        asks = [pool.ask(Job(waits=True)) for _ in range(4)]
        await settled(system)
        gate.event.set()
        assert sorted(await asyncio.gather(*asks)) == ["1", "1", "2", "2"], "0 has a longer queue"


async def test_least_loaded_knows_the_load_of_processes() -> None:
    async with hf.ActorSystem(log=False) as system:
        worker = hf.child(None, hf.start(Sleeper), isolation="process")
        await system.start(hf.supervision.pool("w", worker, 2, routing="least_loaded"))
        pool = hf.supervision.pool_of(system, "/app/w", Sleeper)
        busy = await pool.ask(Who())
        number = busy.split()[0]
        held = system.ref(f"/app/w/{number}", Sleeper).ask(Hold(), 30)
        others = [await pool.ask(Who()) for _ in range(5)]
        assert {name.split()[0] for name in others} == {"1" if number == "0" else "0"}
        system.ref(f"/app/w/{number}", Sleeper).kill()
        with contextlib.suppress(hf.AskFailed):  # If its turn had begun; else the next life has it.
            await held


class Hold(hf.Message): ...


class Sleeper(hf.Actor):
    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        if self.ctx.life == 1:
            await asyncio.Event().wait()

    @hf.on(Who)
    def who(self, message: Who) -> str:
        return self.ctx.path.rpartition("/")[2]


@pytest.mark.parametrize("key", ["key", lambda message: message.key])
async def test_hash_keeps_a_key_with_its_worker(key: Any) -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, routing="hash", key=key)
        for number in range(20):
            name = f"key-{number}"
            for _ in range(2):
                assert await pool.ask(Job(name)) == str(hf.supervision.partition_of(name, 3))


@pytest.mark.holdfast(types=True)
async def test_a_message_without_its_key_is_refused_and_ends_nobody() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, routing="hash", key="key")
        with pytest.raises(hf.errors.NoRoute, match=r"AttributeError.*'key'"):
            await pool.ask(Who())
        with system.events() as events:
            pool.tell(Note())
            await settled(system)
            assert [event.address for event in events.take() if isinstance(event, hf.events.DeadLetter)] == [
                "/app/w/router"
            ]
        with pytest.raises(hf.errors.NoRoute):
            await pool.ask(Job(object()))  # type: ignore[arg-type]
        assert await pool.ask(Job("x")) == str(hf.supervision.partition_of("x", 3))
        assert pool._cell.life == 1


async def test_broadcast_tells_all_and_refuses_to_ask() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, routing="broadcast")
        pool.tell(Note("a"))
        await pool.send(Note("b"))
        await settled(system)
        for number in range(3):
            assert await one(system, number).ask(Notes()) == ["a", "b"]
        with pytest.raises(hf.errors.NotSupported, match="a broadcast has no single reply"):
            await pool.ask(Job())


# -- what is forwarded ---------------------------------------------------------------------------------------------


async def test_the_sender_stays_and_the_reply_goes_to_the_asker() -> None:
    async with hf.ActorSystem(log=False) as system:
        await begin(system)
        other = system.spawn(hf.start(Other), "other")
        assert await other.ask(Who()) == "1 /app/other"
        assert await one(system, 0).ask(Notes()) == ["hello from /app/other"]


async def test_messages_of_other_classes_are_refused_at_the_call() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system)
        with pytest.raises(hf.UnknownMessage, match="/app/w/router"):
            pool.tell(Stranger())


async def test_a_pool_is_found_by_the_class_of_its_workers() -> None:
    async with hf.ActorSystem(log=False) as system:
        await begin(system)
        with pytest.raises(hf.errors.WrongActor, match=r"a pool of .*Worker, not a pool of .*Other"):
            hf.supervision.pool_of(system, "/app/w", Other)
        await system.start(hf.supervisor("top"))
        with pytest.raises(hf.errors.WrongActor, match="PoolSupervisor"):
            hf.supervision.pool_of(system, "/app/top", Worker)
        with pytest.raises(hf.errors.NoSuchActor):
            hf.supervision.pool_of(system, "/app/none", Worker)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_the_deadline_stays() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, hf.start(Worker, gate), size=1)
        began = asyncio.get_running_loop().time()
        first, second = pool.ask(Job(waits=True), 2.0), pool.ask(Job(waits=True), 3.0)
        with pytest.raises(hf.AskTimeout) as caught:
            await first
        assert caught.value.handled is None
        with pytest.raises(hf.AskTimeout) as caught:
            await second
        assert caught.value.handled is False, "it waited behind the first one"
        assert asyncio.get_running_loop().time() - began == pytest.approx(3.0)
        gate.event.set()
        assert await names(pool, 1) == "0"
        assert gate.at_work == ["0"], "what nobody waits for is not run"


async def test_a_worker_that_asks_its_pool_is_passed_over_and_a_circle_is_refused() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, size=2)
        assert await pool.ask(Via(1)) == "0 1"
        assert await pool.ask(Via(1)) in ("0 1", "1 0")
        with pytest.raises(hf.RemoteCrash, match="AskDeadlock"):
            await pool.ask(Via(2))


# -- workers that are not up ---------------------------------------------------------------------------------------


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_who_is_between_two_lives_is_passed_over_until_it_is_back() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, hf.child(None, hf.start(Worker), backoff=hf.Backoff(10, 10)))
        one(system, 1).tell(Boom())
        await settled(system)
        assert await names(pool, 4) == "0 2 0 2"
        await asyncio.sleep(20)
        assert set((await names(pool, 3)).split()) == {"0", "1", "2"}


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("options", [{"restarting": "wait"}, {"routing": "hash", "key": "key"}])
async def test_or_it_is_waited_for(options: dict[str, Any]) -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, hf.child(None, hf.start(Worker), backoff=hf.Backoff(10, 10)), **options)
        for number in range(3):
            one(system, number).tell(Boom())
        await settled(system)
        began = asyncio.get_running_loop().time()
        asks = [pool.ask(Job(f"key-{number}"), 60) for number in range(6)]
        told = " ".join(await asyncio.gather(*asks))
        expected = [
            hf.supervision.partition_of(f"key-{number}", 3) if "key" in options else number % 3 for number in range(6)
        ]
        assert told == " ".join(map(str, expected))
        assert asyncio.get_running_loop().time() - began >= 5


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_while_nobody_is_up_messages_wait_in_their_order() -> None:
    async with hf.ActorSystem(log=False) as system:
        worker = hf.child(None, hf.start(Worker), backoff=hf.Backoff(10, 10))
        top, pool = await begin(system, worker, size=1, mailbox=hf.bounded(3, overflow="reject"))
        one(system, 0).tell(Boom())
        await settled(system)
        late = pool.ask(Job(), 1.0)
        pool.tell(Note("a"))
        pool.tell(Note("b"))
        await settled(system)
        status = await top.ask(hf.supervision.PoolInfo())
        assert (status.size, status.up, status.leaving, status.waiting) == (1, 0, 0, 3)
        with pytest.raises(hf.MailboxFull):
            pool.tell(Note("too many"))
        with pytest.raises(hf.AskTimeout) as caught:
            await late
        assert caught.value.handled is False
        await asyncio.sleep(20)
        pool.tell(Note("c"))
        await settled(system)
        assert await pool.ask(Notes()) == ["a", "b", "c"]
        status = await top.ask(hf.supervision.PoolInfo())
        assert (status.up, status.waiting) == (1, 0)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_broadcast_waits_while_nobody_is_up() -> None:
    async with hf.ActorSystem(log=False) as system:
        worker = hf.child(None, hf.start(Worker), backoff=hf.Backoff(10, 10))
        _, pool = await begin(system, worker, size=1, routing="broadcast")
        one(system, 0).tell(Boom())
        await settled(system)
        pool.tell(Note("a"))
        pool.tell(Note("b"))
        await asyncio.sleep(20)
        assert await one(system, 0).ask(Notes()) == ["a", "b"]


async def test_nothing_is_lost_or_doubled_or_left_while_workers_crash() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, size=3, intensity=10_000)
        answered = 0
        for round_ in range(100):
            asks = [pool.ask(Job(), 30) for _ in range(10)]
            one(system, round_ % 3).tell(Boom())
            asks += [pool.ask(Job(), 30) for _ in range(10)]
            answered += len(await asyncio.gather(*asks))
        assert answered == 2000
        await settled(system)
        assert (await top.ask(hf.supervision.PoolInfo())).up == 3


async def test_a_router_that_crashes_is_restarted_and_keeps_its_queue() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, hf.start(Worker, gate), size=1)
        gate.slow_start = True
        one(system, 0).kill()
        asks = [pool.ask(Job(), 30) for _ in range(5)]
        await settled(system)
        pool.kill()
        await settled(system)
        gate.event.set()
        assert await asyncio.gather(*asks) == ["0"] * 5
        assert pool._cell.life == 2


async def test_suspending_the_pool_holds_messages_too() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, hf.start(Worker, gate), size=1)
        gate.slow_start = True
        one(system, 0).kill()
        ask = pool.ask(Job(), 30)
        await settled(system)
        await system.suspend(pool)
        gate.event.set()
        await settled(system)
        assert not ask.done()
        await system.resume(pool)
        assert await ask == "0"


async def test_full_workers_are_passed_over_and_then_the_router_waits_for_room() -> None:
    gate = Gate()
    worker = hf.child(None, hf.start(Worker, gate), mailbox=hf.bounded(2))
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, worker, size=2, mailbox=hf.bounded(4))
        for number in range(2):
            one(system, number).tell(Job(waits=True))
        await settled(system)
        for number in range(8):
            await asyncio.wait_for(pool.send(Note(str(number))), 10)
        full = asyncio.ensure_future(pool.send(Note("8")))
        direct = asyncio.ensure_future(one(system, 0).send(Note("direct")))
        await settled(system)
        assert not full.done()
        assert not direct.done()
        assert (await top.ask(hf.supervision.PoolInfo())).waiting == 4
        gate.event.set()
        await asyncio.wait_for(asyncio.gather(full, direct), 10)
        await settled(system)
        notes = [await one(system, number).ask(Notes()) for number in range(2)]
        assert sorted(notes[0] + notes[1]) == sorted([*map(str, range(9)), "direct"])
        for told in notes:
            numbers = [note for note in told if note != "direct"]
            assert numbers == sorted(numbers), "in their order"


async def test_room_that_the_router_does_not_take_is_for_others_who_wait() -> None:
    gate = Gate()
    worker = hf.child(None, hf.start(Worker, gate), mailbox=hf.bounded(1))
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, worker, size=2)
        for number in range(2):
            one(system, number).tell(Job(waits=True))
            await settled(system)
            one(system, number).tell(Note("full"))
        await pool.send(Note("routed"))
        await settled(system)
        direct = [asyncio.ensure_future(one(system, number).send(Note("direct"))) for number in range(2)]
        await settled(system)
        gate.event.set()
        await asyncio.wait_for(asyncio.gather(*direct), 10)
        notes = [await one(system, number).ask(Notes()) for number in range(2)]
        assert sorted(notes) == [["full", "direct"], ["full", "routed", "direct"]]
