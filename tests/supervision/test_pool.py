"""Pools: workers of one class, and a router that spreads messages over them."""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from tests.actors.process.waiting import next_event, until


class Job(hf.Message[str]):
    """Answered with the worker's name, at once or when the gate is open."""

    key: str = ""
    waits: bool = False


class Note(hf.Message):
    text: str = ""


class Notes(hf.Message[list[str]]): ...


class Who(hf.Message[str]): ...


class Pid(hf.Message[int]): ...


class Boom(hf.Message): ...


class Via(hf.Message[str]):
    """Ask the pool from within a worker."""

    again: int = 0


class Stranger(hf.Message): ...


class Gate:
    """Holds up jobs until it is opened; kept by the test."""

    def __init__(self) -> None:
        self.event = asyncio.Event()
        self.at_work: list[str] = []
        self.slow_start = False


class Worker(hf.Actor):
    def __init__(self, gate: Gate | None = None) -> None:
        self._gate = gate
        self.notes: list[str] = []

    @property
    def name(self) -> str:
        return self.ctx.path.rpartition("/")[2]

    async def on_start(self, restored: bool) -> None:
        if self._gate is not None and self._gate.slow_start:
            await self._gate.event.wait()

    @hf.on(Job)
    async def job(self, message: Job) -> str:
        if message.waits and self._gate is not None:
            self._gate.at_work.append(self.name)
            await self._gate.event.wait()
        return self.name

    @hf.on(Note)
    def note(self, message: Note) -> None:
        sender = self.ctx.sender
        self.notes.append(message.text + ("" if sender is None else f" from {sender.path}"))

    @hf.on(Notes, readonly=True)
    def all_notes(self, message: Notes) -> list[str]:
        return self.notes

    @hf.on(Who)
    def who(self, message: Who) -> str:
        sender = self.ctx.sender
        return f"{self.name} {'' if sender is None else sender.path}"

    @hf.on(Pid)
    def pid(self, message: Pid) -> int:
        return os.getpid()

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("boom")

    @hf.on(Via)
    async def via(self, message: Via) -> str:
        if not message.again:
            return self.name
        pool = hf.pool_of(self.ctx.cell, "/app/w", Worker)
        return f"{self.name} {await pool.ask(Via(message.again - 1))}"


class Other(hf.Actor):
    @hf.on(Who)
    async def who(self, message: Who) -> str:
        pool = hf.pool_of(self.ctx.cell, "/app/w", Worker)
        pool.tell(Note("hello"))
        return await pool.ask(Who())


async def begin(
    system: hf.ActorSystem, worker: Any = None, size: int = 3, **options: Any
) -> tuple[hf.ActorRef[Any], hf.ActorRef[Worker]]:
    """The pool's supervisor, and the pool."""
    options.setdefault("intensity", 99)
    top = await system.start(hf.pool("w", worker or hf.start(Worker), size, **options))
    return top, hf.pool_of(system, "/app/w", Worker)


def one(system: hf.ActorSystem, number: int) -> hf.ActorRef[Worker]:
    return system.ref(f"/app/w/{number}", Worker)


async def names(pool: hf.ActorRef[Worker], count: int, key: Callable[[int], str] = lambda _: "") -> str:
    return " ".join([await pool.ask(Job(key(number))) for number in range(count)])


async def settled(system: hf.ActorSystem) -> None:
    """Until nothing happens any more; turns may wait (which `node.settled` would wait for): all is in this process."""
    for _ in range(20):
        await asyncio.sleep(0)
        while system.node.awake:
            await asyncio.sleep(0)


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
        await system.start(hf.pool("w", worker, 2, routing="least_loaded"))
        pool = hf.pool_of(system, "/app/w", Sleeper)
        busy = await pool.ask(Who())
        number = busy.split()[0]
        held = system.ref(f"/app/w/{number}", Sleeper).ask(Hold(), 30)
        others = [await pool.ask(Who()) for _ in range(5)]
        assert {name.split()[0] for name in others} == {"1" if number == "0" else "0"}
        system.ref(f"/app/w/{number}", Sleeper).kill()
        with pytest.raises(hf.AskFailed):
            await held


class Hold(hf.Message): ...


class Sleeper(hf.Actor):
    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
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
                assert await pool.ask(Job(name)) == str(hf.partition_of(name, 3))


async def test_a_message_without_its_key_is_refused_and_ends_nobody() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, routing="hash", key="key")
        with pytest.raises(hf.NoRoute, match=r"AttributeError.*'key'"):
            await pool.ask(Who())
        with system.events() as events:
            pool.tell(Note())
            await settled(system)
            assert [event.address for event in events.take() if isinstance(event, hf.DeadLetter)] == ["/app/w/router"]
        with pytest.raises(hf.NoRoute):
            await pool.ask(Job(object()))  # type: ignore[arg-type]
        assert await pool.ask(Job("x")) == str(hf.partition_of("x", 3))
        assert pool._cell.life == 1


async def test_broadcast_tells_all_and_refuses_to_ask() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system, routing="broadcast")
        pool.tell(Note("a"))
        await pool.send(Note("b"))
        await settled(system)
        for number in range(3):
            assert await one(system, number).ask(Notes()) == ["a", "b"]
        with pytest.raises(hf.NotSupported, match="a broadcast has no single reply"):
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
        with pytest.raises(hf.WrongActor, match=r"a pool of .*Worker, not a pool of .*Other"):
            hf.pool_of(system, "/app/w", Other)
        await system.start(hf.supervisor("top"))
        with pytest.raises(hf.WrongActor, match="PoolSupervisor"):
            hf.pool_of(system, "/app/top", Worker)
        with pytest.raises(hf.NoSuchActor):
            hf.pool_of(system, "/app/none", Worker)


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
        expected = [hf.partition_of(f"key-{number}", 3) if "key" in options else number % 3 for number in range(6)]
        assert told == " ".join(map(str, expected))
        assert asyncio.get_running_loop().time() - began >= 5


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_while_nobody_is_up_messages_wait_in_their_order() -> None:
    async with hf.ActorSystem(log=False) as system:
        worker = hf.child(None, hf.start(Worker), backoff=hf.Backoff(10, 10))
        top, pool = await begin(system, worker, size=1, mailbox=hf.bounded(3, overflow="fail"))
        one(system, 0).tell(Boom())
        await settled(system)
        late = pool.ask(Job(), 1.0)
        pool.tell(Note("a"))
        pool.tell(Note("b"))
        await settled(system)
        status = await top.ask(hf.PoolInfo())
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
        status = await top.ask(hf.PoolInfo())
        assert (status.up, status.waiting) == (1, 0)


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
        assert (await top.ask(hf.PoolInfo())).up == 3


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
        assert (await top.ask(hf.PoolInfo())).waiting == 4
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


# -- size ----------------------------------------------------------------------------------------------------------


async def test_it_grows_and_shrinks_while_it_works() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, size=2)
        assert await top.ask(hf.ResizePool(5)) == 2
        assert await names(pool, 5) == "0 1 2 3 4"
        assert await top.ask(hf.ResizePool(1)) == 5
        assert await names(pool, 3) == "0 0 0"
        assert [info.id for info in await top.ask(hf.WhichChildren())] == ["0", "router"]
        assert await top.ask(hf.ResizePool(2)) == 1
        assert [info.id for info in await top.ask(hf.WhichChildren())] == ["0", "1", "router"], "the router stays last"
        for wrong in (hf.ResizePool(-1), hf.ResizePool(1, -1.0)):
            with pytest.raises(hf.SpecError, match="must be >= 0"):
                await top.ask(wrong)


async def test_who_goes_handles_what_it_has_and_gets_nothing_new() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, hf.start(Worker, gate), size=2)
        asks = [pool.ask(Job(waits=True), 30) for _ in range(6)]
        await settled(system)
        resizing = top.ask(hf.ResizePool(1, 20.0), 30)
        await until(lambda: one(system, 1)._cell.admit.__name__ == "admit_closing")
        status = await top.ask(hf.PoolInfo())
        assert (status.size, status.leaving) == (1, 1), "the supervisor answers meanwhile"
        asks += [pool.ask(Job(), 30) for _ in range(4)]
        await settled(system)
        assert not resizing.done()
        gate.event.set()
        assert Counter(await asyncio.gather(*asks)) == {"0": 7, "1": 3}
        assert await resizing == 2
        assert "/app/w/1" not in system.tree()


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_who_takes_too_long_to_go_is_stopped_and_its_asks_fail() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        worker = hf.child(None, hf.start(Worker, gate), shutdown=1.0)
        top, pool = await begin(system, worker, size=2)
        asks = [pool.ask(Job(waits=True), 60) for _ in range(4)]
        began = asyncio.get_running_loop().time()
        assert await top.ask(hf.ResizePool(1, 3.0), 30) == 2
        assert asyncio.get_running_loop().time() - began == pytest.approx(4.0)
        gate.event.set()
        told = await asyncio.gather(*asks, return_exceptions=True)
        assert [type(outcome) for outcome in told] == [str, hf.AskFailed, str, hf.ActorStopped]


async def test_who_crashes_on_its_way_out_goes_on_with_what_it_has() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, hf.start(Worker, gate), size=2)
        asks = [pool.ask(Job(waits=True), 30) for _ in range(6)]
        await settled(system)
        resizing = top.ask(hf.ResizePool(1, 20.0), 30)
        await until(lambda: one(system, 1)._cell.admit.__name__ == "admit_closing")
        one(system, 1).kill()
        gate.event.set()
        told = Counter(type(outcome) for outcome in await asyncio.gather(*asks, return_exceptions=True))
        assert told == {str: 5, hf.AskFailed: 1}, "but for the one it was at"
        assert await resizing == 2


async def test_a_pool_of_nobody_waits_until_there_is_somebody() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system)
        await top.ask(hf.ResizePool(0))
        ask = pool.ask(Job())
        await settled(system)
        assert not ask.done()
        await top.ask(hf.ResizePool(1))
        assert await ask == "0"


async def test_workers_that_end_for_good_are_none_any_more() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, hf.child(None, hf.start(Worker), restart="temporary"))
        one(system, 1).tell(Boom())
        await settled(system)
        assert (await top.ask(hf.PoolInfo())).size == 2
        assert await names(pool, 4) == "0 2 0 2"
        await top.ask(hf.TerminateChild("0"))
        assert await names(pool, 2) == "2 2"


async def test_workers_stopped_by_hand_are_passed_over_until_they_are_started_by_hand() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, restarting="wait")
        await top.ask(hf.TerminateChild("1"))
        assert await names(pool, 4) == "0 2 0 2"
        await top.ask(hf.RestartChild("1"))
        assert set((await names(pool, 3)).split()) == {"0", "1", "2"}


# -- processes -----------------------------------------------------------------------------------------------------


async def test_each_worker_in_a_process_of_its_own() -> None:
    async with hf.ActorSystem(log=False, intensity=99) as system:
        top, pool = await begin(system, size=2, isolation="process")
        pids = {await pool.ask(Pid()) for _ in range(4)}
        assert len(pids | {os.getpid()}) == 3
        with system.events() as events:
            asks = [pool.ask(Job(), 30) for _ in range(20)]
            os.kill(pids.pop(), signal.SIGKILL)
            outcomes = await asyncio.gather(*asks, return_exceptions=True)
            assert {type(outcome) for outcome in outcomes} <= {str, hf.AskFailed}
            await next_event(events, hf.ChildRestarted)
        await until(lambda: len(system.tree()) == 5)
        assert await pool.ask(Pid()) != os.getpid()
        assert await top.ask(hf.ResizePool(3)) == 2
        assert await pool.ask(Via(1), 30) in {f"{a} {b}" for a in "012" for b in "012" if a != b}


async def test_a_pool_below_a_supervisor_with_a_process_of_its_own() -> None:
    async with hf.ActorSystem(log=False) as system:
        spec = hf.pool("w", hf.start(Worker), 2, routing="hash", key="key")
        top = await system.start(hf.supervisor("top", children=[spec], isolation="process"))
        pool = hf.pool_of(system, "/app/top/w", Worker)
        assert await names(pool, 10, str) == " ".join(str(hf.partition_of(str(number), 2)) for number in range(10))
        with pytest.raises(hf.UnknownMessage):
            await pool.ask(Stranger())
        with pytest.raises(hf.NoRoute):
            await pool.ask(Pid())
        workers = system.ref("/app/top/w", hf.PoolSupervisor)
        assert await workers.ask(hf.ResizePool(3)) == 2
        assert await workers.ask(hf.PoolInfo()) == hf.PoolStatus(3, 3, 0, 0)
        with system.events() as events:
            os.kill(system.pid_of(top), signal.SIGKILL)
            await next_event(events, hf.ActorStarted, lambda event: event.address == pool.path)
        assert await pool.ask(Job("x"), 30) in ("0", "1")


# -- specs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"size": 0}, "size must be a whole number >= 1"),
        ({"size": True}, "size must be a whole number >= 1"),
        ({"routing": "fastest"}, "routing must be one of round_robin, least_loaded"),
        ({"restarting": "fail"}, "restarting must be one of skip, wait"),
        ({"routing": "hash"}, "takes a key"),
        ({"key": "key"}, "takes a key"),
        ({"routing": "hash", "key": 3}, "key must be the name of a field"),
        ({"isolation": "thread"}, "isolation must be one of"),
        ({"mailbox": 3}, "mailbox must be"),
        ({"intensity": -1}, "intensity must be"),
    ],
)
def test_what_makes_no_sense_is_refused_when_the_spec_is_built(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(hf.SpecError, match=problem):
        hf.pool("w", hf.start(Worker), **options)


async def test_children_cannot_be_added_or_taken_away_by_hand() -> None:
    with pytest.raises(hf.SpecError, match="a supervisor is none"):
        hf.pool("w", hf.supervisor("top"))
    with pytest.raises(hf.SpecError, match="the worker must come from start"):
        hf.pool("w", 3)  # type: ignore[arg-type]
    async with hf.ActorSystem(log=False) as system:
        top, _ = await begin(system)
        for call in (hf.StartChild(hf.child("x", hf.start(Worker))), hf.DeleteChild("0")):
            with pytest.raises(hf.NotSupported, match="use ResizePool"):
                await top.ask(call)
        with pytest.raises(hf.SpecError, match="use ResizePool"):
            await top.ask(hf.ChangeSupervisor(children=[]))
        await top.ask(hf.ChangeSupervisor(flags=hf.Flags(intensity=7)))


async def test_following_a_router_and_the_end_of_that_leave_it_working() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system)
        with await system.trace(pool) as trace:
            assert await names(pool, 2) == "0 1"
            assert [event for event in trace.take() if isinstance(event, hf.MessageIn)]
        assert await names(pool, 2) == "2 0"
