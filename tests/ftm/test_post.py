"""Letters between replicas: lost, doubled, or out of order on their way, and handled once, in order, all the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.envelope import AskHandle, ReplyHandle
from holdfast.ftm.alarms import Diverged
from holdfast.ftm.bricks.letters import Letter, Sheet
from holdfast.ftm.bricks.peer_channel import Inbox, Where
from holdfast.ftm.bricks.request_protocol import RequestProtocol
from holdfast.ftm.mechanisms.lfr import LFR, Comparing, Handling
from holdfast.ftm.mechanisms.pbr import PBR, StateUpdate
from holdfast.ftm.mechanisms.tmr import TMR, ComputingAlong
from tests.ftm.replicated import Add, Fetch, Read, Total, pair

Handler = Callable[[Any, Any], Any]
Fault = Callable[[Handler, Any, Any], Any]


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.ftm.bricks.peer_channel.PATIENCE", 0.05)


def lose(handler: Handler, actor: Any, item: Any) -> Any:
    """It never comes."""
    return actor.ctx.reply_handle()


async def lose_answer(handler: Handler, actor: Any, item: Any) -> Any:
    """It is handled, and nobody hears of it."""
    found = handler(actor, item)
    if not isinstance(found, ReplyHandle) and hasattr(found, "__await__"):
        await found
    return actor.ctx.reply_handle()


def double(handler: Handler, actor: Any, item: Any) -> Any:
    """It comes once more."""
    actor.ctx._cell.ref.ask(item, timeout=10.0).add_done_callback(lambda done: done.cancelled() or done.exception())
    return handler(actor, item)


def late(handler: Handler, actor: Any, item: Any) -> Any:
    """Others overtake it."""
    handle: ReplyHandle[Any] = actor.ctx.reply_handle()

    def later() -> None:
        actor.ctx._cell.ref.ask(item, timeout=10.0).add_done_callback(
            lambda done: None if done.cancelled() or done.exception() else handle.reply(done.result())
        )

    actor.ctx._cell.node.loop.call_later(0.02, later)
    return handle


def strike(
    monkeypatch: pytest.MonkeyPatch, kind: Any, message: Any, fault: Fault, *, each: int, most: int = 1000
) -> list[int]:
    """Have each so-manieth message of this type come to harm; returns how many have."""
    handler, seen, struck = kind._table[message], [0], [0]

    def struck_or_not(actor: Any, item: Any) -> Any:
        seen[0] += 1
        if seen[0] % each or struck[0] >= most:
            return handler(actor, item)
        struck[0] += 1
        return fault(handler, actor, item)

    monkeypatch.setitem(kind._table, message, struck_or_not)
    return struck


@pytest.mark.parametrize("fault", [lose, lose_answer, double, late])
@pytest.mark.parametrize(
    ("layer", "kinds"), [(PBR(), [StateUpdate]), (LFR(), [Handling, Comparing])], ids=["pbr", "lfr"]
)
async def test_what_comes_to_harm_between_replicas_is_said_again(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, fault: Fault, layer: Any, kinds: list[Any]
) -> None:
    driver = await pair(system, Total, layer)
    struck = [strike(monkeypatch, kind, Letter, fault, each=3) for kind in kinds]
    with system.events() as events:
        keys = [key for n in range(12) for key in driver.send(Add(n), Fetch(1) if n % 6 == 5 else Add(0))]
        for key in keys:
            await driver.reply(key)
        seen = await driver.ask(Read())
        await driver.stop_replica("r1")
        await driver.fail_over("r2")
        assert await driver.ask(Read()) == seen
        assert not any(isinstance(one, Diverged) for one in events.take())
    assert all(count[0] > 0 for count in struck)
    assert driver.doubled == []


async def test_a_vote_goes_on_when_an_order_to_compute_is_lost(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = await pair(system, Total, TMR(), others=("r2", "r3"))
    struck = strike(monkeypatch, ComputingAlong, Letter, lose, each=2, most=4)
    for n in range(5):
        await driver.ask(Add(n))
    assert await driver.ask(Read()) == [0, 1, 2, 3, 4]
    assert struck[0] == 4


async def test_a_large_letter_of_which_a_sheet_is_lost_is_sent_again(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.ftm.bricks.letters.LETTER_BYTES", 10)
    driver = await pair(system)
    struck = strike(monkeypatch, StateUpdate, Sheet, lambda handler, actor, item: None, each=3, most=3)
    for n in range(9):
        await driver.ask(Add(n))
    assert struck[0] == 3
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == list(range(9))


@pytest.mark.parametrize("message", [Where, Letter])
async def test_a_replica_joins_when_what_it_is_told_is_lost(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, message: Any
) -> None:
    struck = strike(monkeypatch, RequestProtocol, message, lose, each=1, most=1)
    driver = await pair(system)
    assert struck[0] == 1
    assert await driver.ask(Add(1)) == 1


def letter(number: int, floor: int = 1) -> Letter:
    return Letter(0, 0, "x", b"", 0, 0, 7, number, floor)


def test_letters_are_taken_in_order_once() -> None:
    inbox, taken = Inbox(), list[int]()
    for number in (2, 1, 2, 3, 1, 5, 5, 4):
        inbox.take(letter(number), b"", AskHandle(None))
        while (one := inbox.pop()) is not None:
            taken.append(one[0].number)
    assert taken == [1, 2, 3, 4, 5]
    assert inbox.recall(6) is None


def test_letters_that_nobody_asks_for_again_are_not_waited_for() -> None:
    inbox = Inbox()
    inbox.take(letter(4, floor=3), b"", AskHandle(None))
    assert inbox.pop() is None
    inbox.take(letter(5, floor=4), b"", AskHandle(None))
    taken = [inbox.pop(), inbox.pop()]
    assert [one[0].number for one in taken if one is not None] == [4, 5]
    inbox.take(letter(6, floor=6), b"", AskHandle(None))
    assert inbox.recall(5) is None, "its answer was heard"
