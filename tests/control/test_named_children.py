"""A child whose spec gives it a name has it in each of its lives, wherever it lives."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from tests.control.conftest import WAYS
from tests.control.players import Account, Add, Total

NEAR = {way: options for way, options in WAYS.items() if "subtree" not in way}
EVERYWHERE: dict[str, dict[str, Any]] = {**NEAR, "protected": {"mechanism": hf.ftm.PBR()}}


def named(way: str = "task", id: str = "one", **options: Any) -> hf.ChildSpec[Account]:
    return hf.child(id, hf.start(Account), register="bank", **{**EVERYWHERE[way], **options})


async def by_name(system: hf.ActorSystem) -> str:
    """Who has the name, once somebody has it: between two lives nobody does."""
    async with asyncio.timeout(30.0):
        while True:
            try:
                ref = system.whereis("bank")
                await ref.ask(Total(), 20)
            except (hf.errors.NoSuchActor, hf.ActorStopped, hf.AskFailed):
                await asyncio.sleep(0.005)
            else:
                return ref.path


@pytest.mark.parametrize("way", EVERYWHERE)
async def test_the_name_is_there_again_after_each_restart(system: hf.ActorSystem, way: str) -> None:
    one = await system.start(named(way))
    for _ in range(3):
        assert system.whereis("bank") == one
        one.kill()
        await one.ask(Add(1), 20)
    assert await by_name(system) == one.path


@pytest.mark.parametrize("way", NEAR)
async def test_it_has_the_name_when_it_starts(system: hf.ActorSystem, way: str) -> None:
    """As in Erlang: whoever is told of the start by the actor itself finds it."""
    system.spawn(hf.start(Waits, "bank"), "waits")
    await system.start(hf.child("one", hf.start(Early, "/app/waits"), register="bank", **NEAR[way]))
    assert await system.ref("/app/waits", Waits).ask(Found()) == "/app/one"


class Found(hf.Message[str]): ...


class Here(hf.Message): ...


class Waits(hf.Actor):
    """Notes who has the name when it is told to."""

    def __init__(self, name: str) -> None:
        self._name, self.found = name, ""

    @hf.on(Here)
    def here(self, message: Here) -> None:
        self.found = self.ctx._cell.node.names[self._name].path

    @hf.on(Found)
    def tell(self, message: Found) -> str:
        return self.found


class Early(hf.Actor):
    def __init__(self, told: str) -> None:
        self._told = told

    async def on_start(self, restored: bool) -> None:
        ref = self.ctx.find(self._told, Waits)
        ref.tell(Here())
        await ref.ask(Found())


@pytest.mark.parametrize("way", NEAR)
async def test_who_is_stopped_frees_it_and_has_it_again_when_started(system: hf.ActorSystem, way: str) -> None:
    await system.start(hf.supervisor("top", children=[named(way)]))
    top = system.ref("/app/top", hf.Supervisor)
    await top.ask(hf.TerminateChild("one"))
    with pytest.raises(hf.errors.NoSuchActor):
        system.whereis("bank")
    await top.ask(hf.RestartChild("one"))
    assert system.whereis("bank").path == "/app/top/one"
    top.kill()
    assert await by_name(system) == "/app/top/one"


async def test_a_start_with_a_name_that_is_taken_fails_and_says_who_has_it(system: hf.ActorSystem) -> None:
    holder = await system.start(named())
    with pytest.raises(hf.StartFailed, match="/app/one is registered as 'bank' already; free the name, or say another"):
        await system.start(named(id="two"))
    with pytest.raises(hf.errors.NameTaken):
        system.register("bank", await system.start(hf.child("three", hf.start(Account))))
    assert system.whereis("bank") == holder
    assert "/app/two" not in system.tree()
    system.unregister("bank")
    assert (await system.start(named(id="two"))).path == "/app/two"
    holder.kill()  # Its next lives find the name taken: it is tried again, and counts, as any start that fails.
    with system.events() as events:
        async for event in events:
            if isinstance(event, hf.events.ChildStartFailed):
                assert "/app/two is registered as 'bank' already" in event.reason
                break
    assert system.whereis("bank").path == "/app/two"


@pytest.mark.parametrize("way", NEAR)
async def test_a_start_that_fails_leaves_the_name_free(system: hf.ActorSystem, way: str) -> None:
    for kind in (Fails, FailsLater):
        with pytest.raises(hf.StartFailed):
            await system.start(hf.child("bad", hf.start(kind), register="bank", **NEAR[way]))
        with pytest.raises(hf.errors.NoSuchActor):
            system.whereis("bank")
    assert (await system.start(named(way))).path == system.whereis("bank").path


class Fails(hf.Actor):
    def __init__(self) -> None:
        raise ValueError("no")


class FailsLater(hf.Actor):
    async def on_start(self, restored: bool) -> None:
        raise ValueError("no")


@pytest.mark.parametrize("way", NEAR)
async def test_the_name_outlives_moves(system: hf.ActorSystem, way: str) -> None:
    one = await system.start(named(way))
    await system.start(hf.supervisor("top", intensity=1000))
    await system.set_isolation(one, "task" if "process" in way else "process")
    assert await by_name(system) == "/app/one"
    one.kill()
    assert await one.ask(Add(1), 20)
    assert await by_name(system) == "/app/one"
    async with system.transaction() as change:
        change.move("/app/one", "/app/top")
    assert system.whereis("bank").path == "/app/top/one"
    system.whereis("bank").kill()
    assert await by_name(system) == "/app/top/one"


async def is_refused(system: hf.ActorSystem, why: str, *steps: Callable[[hf.system.Change], object]) -> None:
    async def change_all() -> None:
        async with system.transaction() as change:
            for step in steps:
                step(change)

    with pytest.raises(hf.TransactionRefused, match=why):
        await change_all()


async def test_transactions_know_of_it(system: hf.ActorSystem) -> None:
    async with system.transaction() as change:
        change.add("/app", named())
    assert "named 'bank'" in change.describe()
    assert system.whereis("bank").path == "/app/one"
    await system.start(hf.child("three", hf.start(Account)))
    new = named(id="two")
    await is_refused(system, "bank exists already", lambda change: change.register("bank", "/app/three"))
    await is_refused(system, "bank exists already", lambda change: change.add("/app", new))
    # It would be started before the other one goes.
    await is_refused(
        system, "bank exists already", lambda change: change.remove("/app/one"), lambda change: change.add("/app", new)
    )
    four, five = (hf.child(name, hf.start(Account), register="house") for name in ("four", "five"))
    await is_refused(
        system, "house exists already", lambda change: change.add("/app", four), lambda change: change.add("/app", five)
    )
    assert system.whereis("bank").path == "/app/one"


@pytest.mark.parametrize("wrong", ["", "/app/bank", 5])
def test_what_is_no_name_is_refused(wrong: Any) -> None:
    with pytest.raises(hf.SpecError, match="child 'one': register must be text without control characters"):
        hf.child("one", hf.start(Account), register=wrong)
