"""Bounded mailboxes hold for actors in processes too: what is queued at the home counts, and what is sent, not begun.

A message counts until its turn begins, as in a task (T15, DESIGN 3). Every test runs with both, recorded or not.
"""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import DeadLetter
from holdfast.actors.kernel.mailbox import Bound
from holdfast.checkpoint.home.capacity import HomeBound
from holdfast.checkpoint.home.recorded_home import switch_of
from tests.actors.process.observers import Observer, Publish, Send
from tests.actors.process.players import Add, Block, Note, Notes, Slow, Total, Worker
from tests.actors.process.waiting import until

pytestmark = pytest.mark.pairs

Busy = Callable[..., Awaitable[hf.ActorRef[Any]]]


@pytest.fixture(params=["task", "process", "recorded task", "recorded process", "recorded subtree"])
def isolation(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    return tmp_path / "gate"


@pytest.fixture
def busy(system: hf.ActorSystem, isolation: str, gate: Path) -> Busy:
    """An actor in the middle of a turn, with nothing in its mailbox."""

    async def busy(capacity: int, overflow: Any = "block", kind: type[hf.Actor] = Worker) -> hf.ActorRef[Any]:
        mailbox = hf.bounded(capacity, overflow=overflow)
        recovery = hf.hybrid() if isolation.startswith("recorded") else None
        where: Any = isolation.removeprefix("recorded ")
        own: Any = "task" if where == "subtree" else where
        spec = hf.child("busy", hf.start(kind), isolation=own, mailbox=mailbox, recovery=recovery, shutdown=0.2)
        if where == "subtree":
            await system.start(hf.supervisor("team", children=[spec], isolation="process"))
            ref: hf.ActorRef[Any] = system.ref("/app/team/busy", kind)
        else:
            ref = await system.start(spec)
        ref.tell(Block(str(gate)))
        await until(lambda: bound_of(ref).count == 0)
        return ref

    return busy


def bound_of(ref: hf.ActorRef[Any]) -> Bound | HomeBound:
    home = switch_of(ref._cell)
    bound: Any = home.intake.bound if home is not None else ref._cell.extra().bound
    assert bound is not None
    return bound


async def test_tell_is_refused_when_it_is_full(busy: Busy, gate: Path) -> None:
    ref = await busy(3)
    for _ in range(3):
        ref.tell(Add(1))
    with pytest.raises(hf.MailboxFull):
        ref.tell(Add(1))
    gate.touch()
    assert await ref.ask(Total()) == 4


@pytest.mark.parametrize("overflow", ["reject", "block"])
async def test_ask_is_refused_or_waits(busy: Busy, gate: Path, overflow: str) -> None:
    ref = await busy(2, overflow)
    asks = [ref.ask(Add(1)) for _ in range(5)]
    gate.touch()
    outcomes = await asyncio.gather(*asks, return_exceptions=True)
    if overflow == "block":
        assert outcomes == [2, 3, 4, 5, 6]
    else:
        assert outcomes[:2] == [2, 3]
        assert {type(outcome) for outcome in outcomes[2:]} == {hf.MailboxFull}


async def test_asks_that_wait_are_let_in_one_for_each_that_leaves(busy: Busy, gate: Path) -> None:
    ref = await busy(1)
    asks = [ref.ask(Add(1)) for _ in range(20)]
    gate.touch()
    for number, ask in enumerate(asks):
        assert await ask == number + 2
        assert bound_of(ref).count <= 1


async def test_an_ask_that_waits_for_room_expires(busy: Busy, gate: Path) -> None:
    ref = await busy(1)
    ref.tell(Add(1))
    with pytest.raises(hf.AskTimeout) as late:
        await ref.ask(Add(1), timeout=0.05)
    assert late.value.handled is False
    gate.touch()
    assert await ref.ask(Total()) == 2


async def test_send_waits_for_room(busy: Busy, gate: Path) -> None:
    ref = await busy(2)

    async def send_all() -> None:
        for _ in range(100):
            await ref.send(Add(1))

    sending = asyncio.ensure_future(send_all())
    await until(lambda: bound_of(ref).count == 2)
    assert not sending.done()
    gate.touch()
    await sending
    assert bound_of(ref).count <= 2
    assert await ref.ask(Total()) == 101


@pytest.mark.parametrize(
    ("overflow", "kept"), [("drop_oldest", ["3", "4"]), ("latest", ["4"]), ("drop_newest", ["0", "1"])]
)
async def test_what_is_dropped(system: hf.ActorSystem, busy: Busy, gate: Path, overflow: str, kept: list[str]) -> None:
    ref = await busy(2, overflow, Slow)
    with system.events() as events:
        for number in range(5):
            ref.tell(Note(str(number)))
        lost = [event.message.text for event in events.take() if isinstance(event, DeadLetter)]
    assert sorted([*lost, *kept]) == ["0", "1", "2", "3", "4"]
    gate.touch()
    await until(lambda: bound_of(ref).count == 0)
    assert await ref.ask(Notes()) == kept


@pytest.mark.parametrize("overflow", ["drop_oldest", "latest", "drop_newest"])
async def test_who_asks_hears_that_it_was_dropped(busy: Busy, gate: Path, overflow: str) -> None:
    ref = await busy(1, overflow)
    first, second = ref.ask(Add(1), timeout=60.0), ref.ask(Add(10), timeout=60.0)
    loser, winner = (second, first) if overflow == "drop_newest" else (first, second)
    with pytest.raises(hf.MailboxFull):
        await loser
    gate.touch()
    assert await winner == (2 if winner is first else 11)


async def test_many_messages_flow_through_a_small_mailbox(busy: Busy, gate: Path) -> None:
    ref = await busy(1)
    gate.touch()
    for number in range(300):
        await ref.send(Add(1))
        assert bound_of(ref).count <= 1, number
    assert await ref.ask(Total()) == 301


async def test_one_ask_after_the_other_is_never_too_many(busy: Busy, gate: Path) -> None:
    """The reply may be here before the word that there is room again."""
    ref = await busy(1, "reject")
    gate.touch()
    await ref.ask(Total())
    assert [await ref.ask(Add(1)) for _ in range(200)] == list(range(2, 202))


async def test_a_sender_in_a_process_waits_too(system: hf.ActorSystem, busy: Busy, gate: Path) -> None:
    """DESIGN 3: `await ref.send(m)` returns on acceptance, which is at the receiver's home."""
    ref = await busy(2, kind=Slow)
    sender = await system.start(hf.child("sender", hf.start(Observer), isolation="process"))
    sending = sender.ask(Send(ref, 20), timeout=20)
    await until(lambda: bool(bound_of(ref).senders))  # the third waits at the receiver's home
    assert bound_of(ref).count == 2
    assert not sending.done()
    gate.touch()
    assert await sending == "20 sent"
    assert await ref.ask(Notes()) == [str(number) for number in range(20)]


async def test_a_sender_in_a_process_hears_that_it_is_full_or_gone(
    system: hf.ActorSystem, busy: Busy, gate: Path
) -> None:
    ref = await busy(2, "reject", kind=Slow)
    sender = await system.start(hf.child("sender", hf.start(Observer), isolation="process"))
    assert await sender.ask(Send(ref, 5)) == "2 MailboxFull"
    gate.touch()
    await system.stop(ref)
    assert await sender.ask(Send(ref, 5)) == "0 ActorStopped"


async def test_publish_from_a_process_waits_for_bounded_subscribers(
    system: hf.ActorSystem, busy: Busy, gate: Path
) -> None:
    ref = await busy(1, kind=Slow)
    publisher = await system.start(hf.child("publisher", hf.start(Observer), isolation="process"))
    publishing = publisher.ask(Publish("/news", ["a", "b", "c"]), timeout=20)
    await until(lambda: bool(bound_of(ref).senders))
    assert not publishing.done()
    gate.touch()
    await publishing
    assert await ref.ask(Notes()) == ["a", "b", "c"]


async def test_the_bound_holds_over_a_death(system: hf.ActorSystem, gate: Path) -> None:
    spec = hf.child("busy", hf.start(Worker), isolation="process", mailbox=hf.bounded(3))
    ref = await system.start(spec)
    bound = bound_of(ref)
    running = ref.ask(Block(str(gate)))
    await until(lambda: bound.count == 0)
    asks = [ref.ask(Add(1)) for _ in range(10)]  # three are in, seven wait for room
    assert bound.count == 3
    os.kill(system.pid_of(ref), signal.SIGKILL)
    with pytest.raises(hf.AskFailed):
        await running
    assert await asyncio.gather(*asks) == list(range(1, 11))
    await until(lambda: bound.count == 0)
    assert not bound.waiting


async def test_senders_are_released_when_the_actor_is_gone(system: hf.ActorSystem, busy: Busy) -> None:
    ref = await busy(1)
    ref.tell(Add(1))
    sending = asyncio.ensure_future(ref.send(Add(1)))
    waiting = [ref.ask(Add(1)) for _ in range(2)]
    await until(lambda: bool(bound_of(ref).senders))
    await system.stop(ref)  # The turn in hand never ends: it is killed.
    everybody: list[Awaitable[Any]] = [*waiting, sending]
    for one in everybody:
        with pytest.raises(hf.ActorStopped):
            await one
