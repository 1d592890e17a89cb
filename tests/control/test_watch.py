"""Turns that occupy the event loop are seen, and so is a loop that lags (T33)."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from typing import TypeVar

import pytest

import holdfast as hf

LIMIT = 0.08
E = TypeVar("E", bound=hf.events.Event)


class Spin(hf.Message):
    seconds: float


class Later(hf.Message):
    """As Spin, after a wait."""

    seconds: float


class Breathe(hf.Message):
    """Never wait for long, never stop."""

    seconds: float


class Quick(hf.Message): ...


class Crowd(hf.Message[float]):
    """As Spin, and what is due behind the turn occupies the loop twice as long; the reply is when the turn ended."""

    seconds: float


class Spinner(hf.Actor):
    @hf.on(Spin)
    def spin(self, message: Spin) -> None:
        time.sleep(message.seconds)

    @hf.on(Later)
    async def later(self, message: Later) -> None:
        await asyncio.sleep(0)
        time.sleep(message.seconds)

    @hf.on(Breathe)
    async def breathe(self, message: Breathe) -> None:
        end = time.monotonic() + message.seconds
        while time.monotonic() < end:
            time.sleep(0.0005)
            await asyncio.sleep(0)

    @hf.on(Crowd)
    def crowd(self, message: Crowd) -> float:
        asyncio.get_running_loop().call_soon(time.sleep, message.seconds * 2)
        time.sleep(message.seconds)
        return time.monotonic()

    @hf.on(Quick)
    def quick(self, message: Quick) -> None:
        time.sleep(0.001)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, watch_turns=LIMIT, watch_lag=LIMIT) as running:
        yield running


async def event(stream: hf.events.EventStream, kind: type[E]) -> E:
    async with asyncio.timeout(30.0):
        async for one in stream:
            if isinstance(one, kind):
                return one
    raise AssertionError(f"no {kind.__name__}")


@pytest.mark.parametrize("kind", [Spin, Later])
async def test_a_turn_that_occupies_the_loop_is_told_of(system: hf.ActorSystem, kind: type[Spin]) -> None:
    one = system.spawn(hf.start(Spinner), "one")
    with system.events() as stream:
        one.tell(kind(LIMIT * 4))
        slow = await event(stream, hf.events.TurnSlow)
    assert slow.address == "/app/one"
    assert slow.message.endswith(kind.__name__)
    assert LIMIT <= slow.seconds < LIMIT * 40


async def test_what_comes_behind_a_turn_is_not_counted_to_it(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(Spinner), "one")
    before = time.monotonic()
    with system.events() as stream:
        ends = await one.ask(Crowd(LIMIT * 4))
        slow = await event(stream, hf.events.TurnSlow)
    assert LIMIT <= slow.seconds <= ends - before


async def test_a_loop_that_comes_late_is_told_of(system: hf.ActorSystem) -> None:
    with system.events() as stream:
        await asyncio.sleep(0)
        time.sleep(LIMIT * 4)
        lagged = await event(stream, hf.events.LoopLagged)
    assert lagged.address == "/app"
    assert lagged.seconds > LIMIT


async def test_turns_that_let_the_loop_go_are_none_of_it(system: hf.ActorSystem) -> None:
    one = system.spawn(hf.start(Spinner), "one")
    shared = Quick()
    with system.events() as stream:
        await one.ask(Breathe(LIMIT * 5))
        for _ in range(300):
            one.tell(shared)
        await system._node.settled()
        assert not [told for told in stream.take() if isinstance(told, hf.events.TurnSlow)]


async def test_nobody_watches_unless_asked_to() -> None:
    before = threading.active_count()
    async with hf.ActorSystem("app", log=False):
        assert threading.active_count() == before


@pytest.mark.parametrize("name", ["watch_lag", "watch_turns"])
@pytest.mark.parametrize("limit", [0, -1.0])
async def test_a_limit_must_be_more_than_nothing(name: str, limit: float) -> None:
    options: dict[str, float] = {name: limit}
    with pytest.raises(hf.SpecError, match=f"{name} must be a finite number of seconds > 0"):
        async with hf.ActorSystem("app", log=False, **options):  # type: ignore[arg-type]
            pass
