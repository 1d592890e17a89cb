"""Pools: how they grow and shrink, with workers in processes of their own, and what is refused."""

from __future__ import annotations

import asyncio
import os
import signal
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from tests.actors.process.waiting import next_event, until
from tests.supervision.pools import (
    Boom,
    Gate,
    Job,
    Pid,
    Stranger,
    Via,
    Worker,
    begin,
    names,
    one,
    settled,
)

# -- size ----------------------------------------------------------------------------------------------------------


async def test_it_grows_and_shrinks_while_it_works() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, size=2)
        assert await top.ask(hf.supervision.ResizePool(5)) == 2
        assert await names(pool, 5) == "0 1 2 3 4"
        assert await top.ask(hf.supervision.ResizePool(1)) == 5
        assert await names(pool, 3) == "0 0 0"
        assert [info.id for info in await top.ask(hf.WhichChildren())] == ["0", "router"]
        assert await top.ask(hf.supervision.ResizePool(2)) == 1
        assert [info.id for info in await top.ask(hf.WhichChildren())] == ["0", "1", "router"], "the router stays last"
        for wrong in (hf.supervision.ResizePool(-1), hf.supervision.ResizePool(1, -1.0)):
            with pytest.raises(hf.SpecError, match="must be >= 0"):
                await top.ask(wrong)


async def test_who_goes_handles_what_it_has_and_gets_nothing_new() -> None:
    gate = Gate()
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, hf.start(Worker, gate), size=2)
        asks = [pool.ask(Job(waits=True), 30) for _ in range(6)]
        await settled(system)
        resizing = top.ask(hf.supervision.ResizePool(1, 20.0), 30)
        await until(lambda: one(system, 1)._cell.admit.__name__ == "admit_closing")
        status = await top.ask(hf.supervision.PoolInfo())
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
        assert await top.ask(hf.supervision.ResizePool(1, 3.0), 30) == 2
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
        resizing = top.ask(hf.supervision.ResizePool(1, 20.0), 30)
        await until(lambda: one(system, 1)._cell.admit.__name__ == "admit_closing")
        one(system, 1).kill()
        gate.event.set()
        told = Counter(type(outcome) for outcome in await asyncio.gather(*asks, return_exceptions=True))
        assert told == {str: 5, hf.AskFailed: 1}, "but for the one it was at"
        assert await resizing == 2


async def test_a_pool_of_nobody_waits_until_there_is_somebody() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system)
        await top.ask(hf.supervision.ResizePool(0))
        ask = pool.ask(Job())
        await settled(system)
        assert not ask.done()
        await top.ask(hf.supervision.ResizePool(1))
        assert await ask == "0"


async def test_workers_that_end_for_good_are_none_any_more() -> None:
    async with hf.ActorSystem(log=False) as system:
        top, pool = await begin(system, hf.child(None, hf.start(Worker), restart="temporary"))
        one(system, 1).tell(Boom())
        await settled(system)
        assert (await top.ask(hf.supervision.PoolInfo())).size == 2
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
            await next_event(events, hf.events.ChildRestarted)
        await until(lambda: len(system.tree()) == 5)
        assert await pool.ask(Pid()) != os.getpid()
        assert await top.ask(hf.supervision.ResizePool(3)) == 2
        assert await pool.ask(Via(1), 30) in {f"{a} {b}" for a in "012" for b in "012" if a != b}


async def test_a_pool_below_a_supervisor_with_a_process_of_its_own() -> None:
    async with hf.ActorSystem(log=False) as system:
        spec = hf.supervision.pool("w", hf.start(Worker), 2, routing="hash", key="key")
        top = await system.start(hf.supervisor("top", children=[spec], isolation="process"))
        pool = hf.supervision.pool_of(system, "/app/top/w", Worker)
        assert await names(pool, 10, str) == " ".join(
            str(hf.supervision.partition_of(str(number), 2)) for number in range(10)
        )
        with pytest.raises(hf.UnknownMessage):
            await pool.ask(Stranger())
        with pytest.raises(hf.errors.NoRoute):
            await pool.ask(Pid())
        workers = system.ref("/app/top/w", hf.supervision.PoolSupervisor)
        assert await workers.ask(hf.supervision.ResizePool(3)) == 2
        assert await workers.ask(hf.supervision.PoolInfo()) == hf.supervision.PoolStatus(3, 3, 0, 0)
        with system.events() as events:
            os.kill(system.pid_of(top), signal.SIGKILL)
            await next_event(events, hf.events.ActorStarted, lambda event: event.address == pool.path)
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
        hf.supervision.pool("w", hf.start(Worker), **options)


async def test_children_cannot_be_added_or_taken_away_by_hand() -> None:
    with pytest.raises(hf.SpecError, match="a supervisor is none"):
        hf.supervision.pool("w", hf.supervisor("top"))
    with pytest.raises(hf.SpecError, match="the worker must come from start"):
        hf.supervision.pool("w", 3)  # type: ignore[arg-type]
    async with hf.ActorSystem(log=False) as system:
        top, _ = await begin(system)
        for call in (hf.StartChild(hf.child("x", hf.start(Worker))), hf.DeleteChild("0")):
            with pytest.raises(hf.errors.NotSupported, match="use ResizePool"):
                await top.ask(call)
        side = await system.start(hf.supervisor("side"))
        changes: tuple[Callable[[hf.system.Change], object], ...] = (
            lambda change: change.add(top, hf.child("x", hf.start(Worker))),
            lambda change: change.remove(f"{top.path}/0"),
            lambda change: change.move(f"{top.path}/0", side),
        )
        for collect in changes:
            with pytest.raises(hf.TransactionRefused, match="use ResizePool"):
                async with system.transaction() as change:
                    collect(change)
        with pytest.raises(hf.SpecError, match="use ResizePool"):
            await top.ask(hf.supervision.ChangeSupervisor(children=[]))
        await top.ask(hf.supervision.ChangeSupervisor(flags=hf.supervision.Flags(intensity=7)))


async def test_following_a_router_and_the_end_of_that_leave_it_working() -> None:
    async with hf.ActorSystem(log=False) as system:
        _, pool = await begin(system)
        with await system.trace(pool) as trace:
            assert await names(pool, 2) == "0 1"
            assert [event for event in trace.take() if isinstance(event, hf.events.MessageIn)]
        assert await names(pool, 2) == "2 0"
