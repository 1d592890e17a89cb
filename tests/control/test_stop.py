"""Stopping in good order: the hook, the reason, what is queued (W3, W9; otp.md 1.11 `stop`)."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.control.conftest import Starter
from tests.control.players import Account, Add, Crash, Stops, Total, Wait, until_there

BY_HAND = hf.Shutdown("by hand")


async def test_stop_returns_when_the_hook_has_run_with_the_reason(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    told = tmp_path / "told"
    one = await start_one(hf.start(Stops, str(told)), shutdown=8.0)
    await system.stop(one, BY_HAND)
    assert told.read_text() == str(BY_HAND)
    await system.stop(one, BY_HAND)
    with pytest.raises(hf.ActorStopped):
        await one.ask(Total())


async def test_draining_handles_what_is_queued_and_refuses_what_is_new(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    one, gate = await start_one(hf.start(Account), shutdown=8.0), tmp_path / "gate"
    waiting = one.ask(Wait(str(gate)), timeout=30.0)
    queued = [one.ask(Add(1), timeout=30.0) for _ in range(3)]
    await until_there(tmp_path / "gate.begun")
    stopping = asyncio.create_task(system.stop(one, drain=True, deadline=30.0))
    await asyncio.sleep(0)
    before = system.dead_letters
    with pytest.raises(hf.ActorStopped):
        await one.ask(Add(1))
    with pytest.raises(hf.ActorStopped):
        await one.send(Add(1))
    one.tell(Add(1))
    assert system.dead_letters == before + 1
    gate.touch()
    await stopping
    assert await waiting == "waited"
    assert await asyncio.gather(*queued) == [1, 2, 3]


async def test_without_draining_what_is_queued_is_not_handled(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    one, gate = await start_one(hf.start(Account), shutdown=8.0), tmp_path / "gate"
    waiting = one.ask(Wait(str(gate)), timeout=30.0)
    queued = one.ask(Add(1), timeout=30.0)
    await until_there(tmp_path / "gate.begun")
    stopping = asyncio.create_task(system.stop(one))
    above = system.ref(one.path.rpartition("/")[0], hf.Supervisor)
    for _ in range(5):  # These answers come behind the stop, wherever the supervisor is.
        await asyncio.sleep(0)
        await above.ask(hf.WhichChildren(), 20.0)
        assert (await system.get_status(one)).turn is not None
    gate.touch()
    await stopping
    assert await waiting == "waited"
    with pytest.raises(hf.ActorStopped):
        await queued


async def test_draining_goes_on_over_a_crash(system: hf.ActorSystem, start_one: Starter, way: str) -> None:
    one = await start_one(hf.start(Account), shutdown=8.0)
    first = one.ask(Add(1), timeout=30.0)
    crashed = one.ask(Crash(), timeout=30.0)
    last = one.ask(Add(1), timeout=30.0)
    await system.stop(one, drain=True, deadline=30.0)
    assert await first == 1
    with pytest.raises(hf.RemoteCrash):
        await crashed
    assert await last == (2 if "recorded" in way else 1)


class OnesOwn(hf.Message):
    left: int


class ToItself(Account):
    """Tells itself the next number until none is left, as `{continue, Term}` would."""

    def __init__(self, told: str) -> None:
        super().__init__()
        self.told = told

    @hf.on(OnesOwn)
    async def own(self, message: OnesOwn) -> None:
        if message.left:
            self.ctx.ref.tell(OnesOwn(message.left - 1))
            await self.ctx.ref.send(OnesOwn(0))
        with Path(self.told).open("a") as file:
            file.write(f"{message.left} ")


async def test_what_an_actor_tells_itself_while_it_is_drained_is_handled(
    system: hf.ActorSystem, start_one: Starter, tmp_path: Path
) -> None:
    told, gate = tmp_path / "told", tmp_path / "gate"
    one = await start_one(hf.start(ToItself, str(told)), shutdown=8.0)
    waiting = one.ask(Wait(str(gate)), timeout=30.0)
    one.tell(OnesOwn(3))
    await until_there(tmp_path / "gate.begun")
    stopping = asyncio.create_task(system.stop(one, drain=True, deadline=30.0))
    await asyncio.sleep(0)
    gate.touch()
    await stopping
    assert await waiting == "waited"
    assert sorted(told.read_text().split()) == ["0", "0", "0", "0", "1", "2", "3"]


class Bound(hf.Message):
    path: str


class BoundTo(Account):
    @hf.on(Bound)
    def bind(self, message: Bound) -> None:
        self.ctx.link(self.ctx.find(message.path, hf.Actor))


async def has_ended(one: hf.ActorRef[Any]) -> bool:
    try:
        await one.ask(Total(), timeout=30.0)
    except hf.ActorStopped:
        return True
    return False


async def test_an_untrapped_exit_keeps_its_place(system: hf.ActorSystem, start_one: Starter, tmp_path: Path) -> None:
    """Behind the turn in hand and all that is queued, wherever the actor lives."""
    one, gate = await start_one(hf.start(BoundTo), shutdown=8.0, restart="transient"), tmp_path / "gate"
    other = await system.start(hf.child("other", hf.start(Account), restart="temporary"))
    await one.ask(Bound(other.path))
    waiting = one.ask(Wait(str(gate)), timeout=30.0)
    queued = [one.ask(Add(1), timeout=30.0) for _ in range(3)]
    await until_there(tmp_path / "gate.begun")
    await system.terminate(other, BY_HAND)
    assert (await system.get_status(one)).turn is not None
    gate.touch()
    assert await waiting == "waited"
    assert await asyncio.gather(*queued) == [1, 2, 3]
    while not await has_ended(one):
        pass


async def test_draining_ends_at_its_deadline(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account), shutdown=8.0)
    await system.suspend(one)
    queued = one.ask(Add(1), timeout=30.0)
    await system.stop(one, drain=True, deadline=0.1)
    with pytest.raises(hf.ActorStopped):
        await queued


class Handed(hf.Actor):
    def __init__(self, back: list[Any]) -> None:
        self._back = back

    @hf.on(Add)
    def add(self, message: Add) -> int:
        return message.n

    def on_undelivered(self, message: hf.Message[Any]) -> None:
        self._back.append(message)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_what_is_left_at_the_deadline_is_handed_back(system: hf.ActorSystem) -> None:
    back: list[Any] = []
    one = system.spawn(hf.start(Handed, back))
    await system.suspend(one)
    one.tell(Add(1))
    one.tell(Add(2))
    await system.stop(one, drain=True, deadline=3.0)
    assert back == [Add(1), Add(2)]


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_a_stop_that_is_given_up_while_it_drains_lets_messages_in_again(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account)))
    await system.suspend(one)
    stopping = asyncio.create_task(system.stop(one, drain=True))
    await asyncio.sleep(1.0)
    stopping.cancel()
    await asyncio.wait([stopping])
    await system.resume(one)
    assert await one.ask(Add(1)) == 1


class Leave(hf.Message[str]): ...


class Leaver(hf.Actor):
    """Stops itself through the system, from a handler or from `on_start`."""

    def __init__(self, system: hf.ActorSystem, told: list[Any], at_start: bool = False) -> None:
        self._system, self._told, self._at_start = system, told, at_start

    async def on_start(self, restored: bool) -> None:
        if self._at_start:
            await self._system.stop(self.ctx.ref, BY_HAND)
            self._told.append("started")

    @hf.on(Leave)
    async def leave(self, message: Leave) -> str:
        await self._system.stop(self.ctx.ref, BY_HAND)
        return "leaving"

    def on_stop(self, reason: hf.ExitReason) -> None:
        self._told.append(reason)


@pytest.mark.parametrize("supervised", [True, False])
async def test_an_actor_may_stop_itself_in_a_handler(system: hf.ActorSystem, supervised: bool) -> None:
    told: list[Any] = []
    recipe = hf.start(Leaver, system, told)
    one = await system.start(hf.child("one", recipe)) if supervised else system.spawn(recipe, "one")
    gone = one._cell.ended()
    assert await one.ask(Leave()) == "leaving"
    assert await asyncio.wait_for(gone, 30.0) == BY_HAND
    assert told == [BY_HAND]
    await system.stop(one)  # it may not be gone quite yet; then it is
    assert system.tree() == ["/app"]


@pytest.mark.parametrize("supervised", [True, False])
async def test_an_actor_may_stop_itself_in_on_start(system: hf.ActorSystem, supervised: bool) -> None:
    told: list[Any] = []
    recipe = hf.start(Leaver, system, told, True)
    if supervised:
        with pytest.raises(hf.StartFailed, match="it was stopped while it started"):
            await system.start(hf.child("one", recipe))
    else:
        one = system.spawn(recipe, "one")
        await asyncio.wait_for(asyncio.shield(one._cell.ended()), 30.0)
        await system.stop(one)
    assert told == ["started", BY_HAND]
    async with asyncio.timeout(30.0):
        while system.tree() != ["/app"]:  # It may not be gone quite yet.
            await asyncio.sleep(0)
