"""Histories of asks: what is an outcome, what is forgotten, and what nobody knows."""

from __future__ import annotations

import asyncio
import itertools
import math
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import UNKNOWN, GuardedSystem, History, Model, idle, linearizable
from tests.testing.histories.models import counter


class Take(hf.Message[int]):
    amount: int


class Sleep(hf.Message[None]): ...


class Fail(hf.Message[None]): ...


class Empty(hf.Refusal):
    left: int


class Till(hf.Actor):
    def __init__(self, left: int) -> None:
        self.left = left

    @hf.on(Take)
    def take(self, message: Take) -> int:
        if message.amount > self.left:
            raise Empty(self.left)
        self.left -= message.amount
        return self.left

    @hf.on(Sleep)
    async def sleep(self, message: Sleep) -> None:
        await asyncio.sleep(3600.0)

    @hf.on(Fail)
    def fail(self, message: Fail) -> None:
        raise RuntimeError("as it was told")


def step(left: int, message: hf.Message[Any]) -> tuple[int, object]:
    match message:
        case Take(amount):
            if amount > left:
                raise Empty(left)
            return left - amount, left - amount
        case _:
            return left, None


def test_a_history_is_written_down_as_it_happens() -> None:
    history = History()
    first = history.begin("a", ("add", 1))
    second = history.begin("b", ("add", 1))
    history.end(second, 1)
    refused = history.begin("b", ("add", 5))
    history.forget(refused)
    history.begin("c", ("add", 10))  # and nobody knows
    history.end(first, 2)
    last = history.begin("a", ("read",))
    history.end(last, 12)
    found = linearizable(history, counter())
    assert found
    assert [one.told() for one in found.order] == [
        "('add', 1) -> 1", "('add', 1) -> 2", "('add', 10) -> ?", "('read',) -> 12",
    ]  # fmt: skip
    assert not linearizable(history, counter(1))
    assert str(history).splitlines()[2] == "c: ('add', 10) -> ?"


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_replies_and_refusals_are_outcomes_and_each_client_has_a_name(actor_system: GuardedSystem) -> None:
    till = actor_system.spawn(hf.start(Till, 10), "till")
    history = History()
    assert await history.ask(till, Take(4), client="one") == 6
    with pytest.raises(Empty):
        await history.ask(till, Take(7), client="other")
    history.tell(till, Take(1))
    await idle(actor_system)
    await asyncio.sleep(2.5)
    assert await asyncio.create_task(_take(history, till), name="third") == 2
    told = [(one.client, one.outcome) for one in history.operations if one.outcome is not UNKNOWN]
    assert told[0] == ("one", 6)
    assert told[1][0] == "other"
    assert isinstance(told[1][1], Empty)
    assert told[2] == ("third", 2)
    assert [one.at for one in history.operations] == [0.0, 0.0, 0.0, 2.5]
    assert {one.to for one in history.operations} == {"/app/till"}
    assert linearizable(history, Model(10, step))
    assert not linearizable(history, Model(11, step))


async def _take(history: History, till: hf.ActorRef[Till]) -> int:
    return await history.ask(till, Take(3))


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.holdfast(crashes=True)
async def test_what_was_surely_not_handled_is_forgotten_and_what_may_have_been_is_unknown(
    actor_system: GuardedSystem,
) -> None:
    till = actor_system.spawn(hf.start(Till, 10), "till")
    history = History()
    slow = history.ask(till, Sleep(), timeout=1.0)
    behind = history.ask(till, Take(1), timeout=0.5)
    for late in (slow, behind):
        with pytest.raises(hf.AskTimeout):
            await late
    assert [(one.message, one.outcome, one.end) for one in history.operations] == [(Sleep(), UNKNOWN, math.inf)]
    till.kill()
    other = actor_system.spawn(hf.start(Till, 10), "other")
    with pytest.raises(hf.RemoteCrash):
        await history.ask(other, Fail())
    assert [one.message for one in history.operations] == [Sleep(), Fail()]
    with pytest.raises(hf.ActorStopped):
        await history.ask(till, Take(1))
    with pytest.raises(hf.UnknownMessage):
        history.ask(till, Never())
    assert [one.message for one in history.operations] == [Sleep(), Fail()]


class Never(hf.Message[None]): ...


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_wait_that_was_cancelled_leaves_the_operation_unknown(actor_system: GuardedSystem) -> None:
    till = actor_system.spawn(hf.start(Till, 10), "till")
    history = History()
    asked = history.ask(till, Sleep())
    await idle(actor_system)
    asked.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asked
    assert await history.ask(till, Take(2), timeout=7200.0) == 8
    assert [one.outcome for one in history.operations] == [UNKNOWN, 8]
    assert linearizable(history, Model(10, step))


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_an_operation_ends_before_its_client_goes_on(actor_system: GuardedSystem) -> None:
    """Else two asks of one client would overlap, and a stale reply could pass."""
    till = actor_system.spawn(hf.start(Till, 100), "till")
    history = History()

    async def client() -> None:
        for _ in range(5):
            await history.ask(till, Take(1))

    await asyncio.gather(*(asyncio.create_task(client(), name=f"client {n}") for n in range(3)))
    for name in ("client 0", "client 1", "client 2"):
        own = [one for one in history.operations if one.client == name]
        assert len(own) == 5
        assert all(one.end < other.start for one, other in itertools.pairwise(own))
