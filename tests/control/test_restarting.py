"""An ask to an actor that is being restarted waits, or fails at once if the asker says so (W6)."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import pytest

import holdfast as hf
from tests.control.conftest import Starter
from tests.control.players import Account, Add, Crash

SLOW = hf.Backoff(initial=60.0, maximum=60.0, jitter=0.0)


class Asks(hf.Message[str]):
    whom: hf.ActorRef[Any]


class Asker(hf.Actor):
    @hf.on(Asks)
    async def ask(self, message: Asks) -> str:
        try:
            return str(await message.whom.ask(Add(1), timeout=30.0, restarting="fail"))
        except hf.errors.ActorRestarting as error:
            return f"restarting {error.actor}"


async def crashed(ref: hf.ActorRef[Any]) -> None:
    gone = ref._cell.ended()
    ref.kill()
    await gone


async def test_an_ask_to_an_actor_that_is_up_is_made(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    assert await one.ask(Add(1), restarting="fail") == 1
    with pytest.raises(hf.RemoteCrash):
        await one.ask(Crash(), restarting="fail")


@pytest.mark.parametrize("way", ["task", "process", "recorded task", "recorded process"])
async def test_an_ask_fails_at_once_between_two_lives(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account), backoff=SLOW)
    await crashed(one)
    with pytest.raises(hf.errors.ActorRestarting, match="/app/one is being restarted"):
        await one.ask(Add(1), restarting="fail")
    asker = await system.start(hf.child("asker", hf.start(Asker)))
    assert await asker.ask(Asks(one)) == "restarting /app/one"
    waits = one.ask(Add(1), timeout=0.05)
    with pytest.raises(hf.AskTimeout):
        await waits


@pytest.mark.parametrize("way", ["recorded process", "process"])
async def test_an_ask_fails_while_the_next_life_comes_up(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    assert await one.ask(Add(1)) == 1
    await crashed(one)
    failed = one.ask(Add(1), restarting="fail")
    assert await one.ask(Add(2), timeout=30.0) in (2, 3)
    with pytest.raises(hf.errors.ActorRestarting):
        await failed
    assert await one.ask(Add(0), restarting="fail") in (2, 3)


async def test_a_recorded_asker_waits_all_the_same(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account), backoff=hf.Backoff(initial=0.05, jitter=0.0)))
    asker = await system.start(hf.child("asker", hf.start(Asker), recovery=hf.hybrid()))
    await crashed(one)
    assert await asker.ask(Asks(one), timeout=30.0) == "1"


async def test_an_actor_that_is_gone_is_not_restarting(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(Account))
    await system.stop(one)
    with pytest.raises(hf.ActorStopped):
        await one.ask(Add(1), restarting="fail")


async def test_another_word_is_refused(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(Account))
    with pytest.raises(hf.SpecError, match="restarting must be 'wait' or 'fail', not 'maybe'"):
        one.ask(Add(1), restarting="maybe")  # type: ignore[arg-type]
    await asyncio.sleep(0)


@pytest.mark.parametrize("way", ["process", "recorded process", "process in a subtree"])
async def test_an_order_to_an_actor_that_comes_back_is_not_told_that_nobody_lives_there(
    system: hf.ActorSystem, start_one: Starter
) -> None:
    """Its process knows first that its life is over, and it is not what says whether another one follows."""
    one = await start_one(hf.start(Account))
    errors: list[Exception] = []

    async def looks() -> None:
        try:
            await system.get_state(one, timeout=30.0)
        except hf.HoldfastError as error:
            errors.append(error)

    for _ in range(3):
        crashing = asyncio.ensure_future(one.ask(Crash(), timeout=30.0))
        looking: list[asyncio.Task[None]] = []
        while not crashing.done():
            looking.append(asyncio.create_task(looks()))
            await asyncio.sleep(0)
        with pytest.raises(hf.RemoteCrash):
            await crashing
        await asyncio.wait(looking)
    assert all(isinstance(error, hf.errors.AskFailed) for error in errors), errors


def other_place(way: str) -> Any:
    return "task" if "process" in way else "process"


async def test_an_actor_that_is_being_restarted_is_moved_in_its_next_life(
    system: hf.ActorSystem, start_one: Starter, way: str
) -> None:
    one = await start_one(hf.start(Account), backoff=hf.Backoff(initial=1.0, jitter=0.0))
    with system.events() as events:
        one.tell(Crash())
        await events.until(hf.events.ActorCrashed)
        await system.set_isolation(one, other_place(way), timeout=30.0)
        [moved] = [event for event in events.take() if isinstance(event, hf.events.Moved)]
        assert moved.to == other_place(way)
    assert await one.ask(Add(1), timeout=30.0) == 1


async def test_an_actor_that_crashes_before_it_is_at_rest_is_moved_in_its_next_life(
    system: hf.ActorSystem, start_one: Starter, way: str
) -> None:
    one = await start_one(hf.start(Account), backoff=hf.Backoff(initial=0.01, jitter=0.0))
    for _ in range(3):
        one.tell(Crash())
        to: Any = "process" if system.pid_of(one) == parent_of(system, way) else "task"
        await system.set_isolation(one, to, timeout=30.0)
    assert await one.ask(Add(1), timeout=30.0) == 1


def parent_of(system: hf.ActorSystem, way: str) -> int:
    """The process in which it lives as a task."""
    return system.pid_of(system.ref("/app/top", hf.Actor)) if "subtree" in way else os.getpid()
