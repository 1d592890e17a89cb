"""What may go wrong while an actor is moved: it lives on in one place."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.migration.move import Move
from tests.control.movers import (
    OTHER,
    Fussy,
    Leaves,
    Work,
    lives_in,
    moved,
)
from tests.control.players import Account, Add, Crash, Total, until_there

pytestmark = pytest.mark.pairs


@pytest.mark.parametrize("how", ["raise", "hang", "exit"])
async def test_if_the_new_life_does_not_come_up_the_old_one_goes_on(
    system: hf.ActorSystem, recovery: Any, here: Any, how: str, tmp_path: Path
) -> None:
    if how == "exit" and here == "process":
        how = "raise"  # The new place is the test itself.
    gate = tmp_path / "gate"
    one = await system.start(hf.child("one", hf.start(Fussy, str(gate), how), recovery=recovery, isolation=here))
    assert await one.ask(Add(5)) == 5
    pid = system.pid_of(one)
    gate.touch()
    moving = asyncio.ensure_future(system.set_isolation(one, OTHER[here], timeout=0.5))
    asks: list[asyncio.Future[int]] = []
    while not moving.done():  # Also while it is at rest.
        asks.append(one.ask(Add(1)))
        await asyncio.sleep(0.0005)
    with pytest.raises(hf.errors.CannotMove):
        await moving
    count = len(asks)
    assert await asyncio.gather(*asks) == list(range(6, 6 + count))
    assert system.pid_of(one) == pid
    status = await system.get_status(one)
    assert (status.life, status.state) == (1, "running")
    gate.unlink()
    await system.set_isolation(one, OTHER[here])
    assert await one.ask(Add(1)) == 6 + count
    assert lives_in(system, one) == OTHER[here]


async def test_moves_of_one_actor_go_one_after_another(system: hf.ActorSystem, recovery: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery))
    with system.events() as stream:
        await asyncio.gather(*(system.set_isolation(one, to) for to in ("process", "task", "process", "process")))
        assert moved(stream) == [("task", "process"), ("process", "task"), ("task", "process")]
    assert await one.ask(Add(1)) == 1
    assert lives_in(system, one) == "process"


async def test_an_actor_that_is_being_restarted_is_moved_in_its_next_life(system: hf.ActorSystem, here: Any) -> None:
    backoff = hf.Backoff(initial=0.2, jitter=0.0)
    one = await system.start(hf.child("one", hf.start(Account), isolation=here, backoff=backoff))
    with pytest.raises(hf.RemoteCrash):
        await one.ask(Crash())
    await system.set_isolation(one, OTHER[here])
    assert lives_in(system, one) == OTHER[here]
    assert (await system.get_status(one)).life == 2


async def test_a_caller_that_gives_up_leaves_no_half_move(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation=here))
    for steps in range(12):
        moving = asyncio.ensure_future(system.set_isolation(one, OTHER[lives_in(system, one)]))
        for _ in range(steps):
            await asyncio.sleep(0)
        moving.cancel()
        assert await one.ask(Add(1)) == steps + 1
    place = OTHER[lives_in(system, one)]
    await system.set_isolation(one, place)
    assert await one.ask(Total()) == 12
    assert lives_in(system, one) == place


async def test_a_system_that_ends_does_not_wait_for_moves(here: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        one = await system.start(hf.child("one", hf.start(Account), isolation=here))
        moving = asyncio.ensure_future(system.set_isolation(one, OTHER[here]))
        await asyncio.sleep(0)
    done, _ = await asyncio.wait((moving,), timeout=30.0)
    assert done
    assert moving.cancelled() or moving.exception() is None or isinstance(moving.exception(), hf.HoldfastError)


async def test_stop_and_kill_reach_an_actor_on_its_way(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    for end in ("stop", "kill"):
        for steps in range(0, 40, 4):
            spec = hf.child(f"{end}-{steps}", hf.start(Account), recovery=recovery, isolation=here, restart="temporary")
            one = await system.start(spec)
            moving = asyncio.ensure_future(system.set_isolation(one, OTHER[here]))
            for _ in range(steps):
                await asyncio.sleep(0)
            gone = one._cell.ended()
            getattr(one, end)()
            async with asyncio.timeout(30.0):
                assert await gone in (hf.SHUTDOWN, hf.KILLED)
            await asyncio.wait((moving,), timeout=30.0)
            assert moving.done()
            moving.exception()


async def test_an_actor_that_stops_itself_in_the_turn_that_is_waited_for_stops(
    system: hf.ActorSystem, recovery: Any, here: Any, tmp_path: Path
) -> None:
    gate = tmp_path / "gate"
    one = await system.start(hf.child("one", hf.start(Leaves), recovery=recovery, isolation=here, restart="temporary"))
    one.tell(Work(str(gate)))
    await until_there(tmp_path / "gate.begun")
    gone = one._cell.ended()
    moving = asyncio.ensure_future(system.set_isolation(one, OTHER[here]))
    await asyncio.wait((moving,), timeout=0.3)  # The order has reached it, and waits for the end of the turn.
    gate.touch()
    async with asyncio.timeout(30.0):
        assert await gone == hf.NORMAL
    with pytest.raises(hf.errors.CannotMove, match="its life has ended"):
        await moving


async def test_control_reaches_an_actor_on_its_way(system: hf.ActorSystem, recovery: Any, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation=here))
    await one.ask(Add(4))
    place = here
    for _ in range(6):
        place = OTHER[place]
        moving = asyncio.ensure_future(system.set_isolation(one, place))
        while not moving.done():
            assert (await system.get_state(one))["total"] == 4
        await moving


async def test_statistics_and_trace_go_on(system: hf.ActorSystem, here: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), isolation=here))
    await system.statistics(one, True)
    with await system.trace(one) as stream:
        await one.ask(Add(1))
        await system.set_isolation(one, OTHER[here])
        await one.ask(Add(1))
        await system.set_isolation(one, here)
        await one.ask(Add(1))
        ends = [event for event in stream.take() if isinstance(event, hf.events.TurnEnded)]
    assert len(ends) == 3
    counts = await system.statistics(one)
    assert counts is not None
    assert (counts.messages_in, counts.restarts) == (3, 0)


async def test_the_old_process_ends_after_a_move(system: hf.ActorSystem, recovery: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation="process"))
    pid = system.pid_of(one)
    await system.set_isolation(one, "task")
    async with asyncio.timeout(30.0):
        while True:
            try:
                os.kill(pid, 0)
            except ProcessLookupError:
                break
            await asyncio.sleep(0.01)
    assert await one.ask(Add(1)) == 1


@pytest.fixture
def given_up_at_rest(monkeypatch: pytest.MonkeyPatch, first: int) -> list[Move]:
    """Attempts; the first ones run out of time at the very instant at which the old life is told to be at rest."""
    attempts: list[Move] = []
    at_rest = Move.at_rest

    def give_up(move: Move) -> None:
        at_rest(move)
        attempts.append(move)
        if len(attempts) <= first:
            move.give_up("the time is over")

    monkeypatch.setattr(Move, "at_rest", give_up)
    return attempts


@pytest.mark.parametrize("first", [1, 2])
@pytest.mark.parametrize("suspended", [False, True])
async def test_an_attempt_right_after_one_that_was_given_up_takes_nothing_of_it(
    system: hf.ActorSystem, recovery: Any, here: Any, suspended: bool, first: int, given_up_at_rest: list[Move]
) -> None:
    """The luggage of the earlier attempt is on its way when the next one begins: what was done since is in neither."""
    one = await system.start(hf.child("one", hf.start(Account), recovery=recovery, isolation=here))
    assert await one.ask(Add(1)) == 1
    asks: list[asyncio.Future[int]] = []
    if suspended:
        await system.suspend(one)
    for _ in range(first):
        with pytest.raises(hf.errors.CannotMove, match="the time is over"):
            await system.set_isolation(one, OTHER[here])
        asks.append(one.ask(Add(10), timeout=30.0))
    await system.set_isolation(one, OTHER[here])
    assert len(given_up_at_rest) == first + 1
    if suspended:
        await system.resume(one)
    assert await asyncio.gather(*asks) == [11, 21][:first]
    assert await one.ask(Total()) == [11, 21][first - 1]
    assert lives_in(system, one) == OTHER[here]


async def test_who_waits_for_a_move_hears_that_the_system_ends(recovery: Any, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    async with hf.ActorSystem("ending", log=False) as system:
        one = await system.start(hf.child("one", hf.start(Fussy, str(gate), "hang"), recovery=recovery))
        gate.touch()  # The next life does not come up.
        moving = asyncio.ensure_future(system.set_isolation(one, "process", timeout=300.0))
        await asyncio.sleep(0)  # It has begun.
    with pytest.raises(hf.errors.CannotMove, match="the system ends"):  # Nobody has cancelled us.
        await moving
