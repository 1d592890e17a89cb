"""What recorded children have accepted waits for somebody, or is told: nothing waits for nobody."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.process.fork import forked_process


class Item(hf.Message[None]):
    n: int


class Taken(hf.Message[list[int]]): ...


class Keeper(hf.Actor):
    def __init__(self) -> None:
        self.taken: list[int] = []

    @hf.on(Item)
    def item(self, message: Item) -> None:
        self.taken.append(message.n)

    @hf.on(Taken)
    def all_taken(self, message: Taken) -> list[int]:
        return list(self.taken)


WORKER = hf.child(None, hf.start(Keeper), recovery=hf.hybrid())


async def fill(system: hf.ActorSystem, paths: list[str]) -> None:
    """Three items wait at each, in its journal."""
    for place, path in enumerate(paths):
        worker = system.ref(path, Keeper)
        await system.suspend(worker)
        for n in range(3):
            await worker.send(Item(place * 10 + n))


async def keeper(system: hf.ActorSystem, path: str) -> hf.ActorRef[Keeper]:
    """Whoever lives there, when it is there again: its supervisor answers before its children are up."""
    async with asyncio.timeout(60.0):
        while True:
            try:
                return system.ref(path, Keeper)
            except hf.errors.NoSuchActor:
                await asyncio.sleep(0)


async def restart(system: hf.ActorSystem, supervisor: hf.ActorRef[hf.Supervisor]) -> None:
    with system.events() as events:
        supervisor.kill()
        async for event in events:
            if isinstance(event, hf.events.ChildRestarted) and event.address == supervisor.path:
                return


@pytest.mark.parametrize("how", ["supervisor", "root"])
async def test_the_workers_that_a_pool_was_given_come_back_with_what_they_have_accepted(
    tmp_path: Path, how: str
) -> None:
    paths = [f"/app/w/{number}" for number in range(4)]
    spec = hf.supervision.pool("w", WORKER, 2, intensity=9)
    store = f"sqlite:{tmp_path / 'app.db'}"

    async def all_taken(system: hf.ActorSystem) -> list[list[int]]:
        return [await (await keeper(system, path)).ask(Taken(), 60) for path in paths]

    expected = [[place * 10 + n for n in range(3)] for place in range(4)]
    async with hf.ActorSystem("app", log=False, store=store) as system:
        pool = await system.start(spec)
        assert await pool.ask(hf.supervision.ResizePool(4), 60) == 2
        await fill(system, paths)
        if how == "supervisor":
            await restart(system, pool)
            assert (await pool.ask(hf.supervision.PoolInfo(), 60)).size == 4
            assert await all_taken(system) == expected
    async with hf.ActorSystem("app", log=False, store=store) as system:
        pool = await system.start(spec)
        assert (await pool.ask(hf.supervision.PoolInfo(), 60)).size == 4
        assert await all_taken(system) == expected
        await pool.ask(hf.supervision.ResizePool(1), 60)
        await restart(system, pool)
        assert (await pool.ask(hf.supervision.PoolInfo(), 60)).size == 2, "those that were let go do not come back"


@pytest.mark.parametrize("journal", [False, True])
async def test_what_waits_at_a_made_up_address_is_told_if_nobody_comes_back_there(journal: bool) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        supervisor = await system.start(hf.dynamic("d", template=WORKER, intensity=9, journal=journal))
        made_up = (await supervisor.ask(hf.StartChild(), 60)).path
        given = (await supervisor.ask(hf.StartChild(id="given"), 60)).path
        await fill(system, [made_up, given])
        with system.events() as events:
            await restart(system, supervisor)
            await supervisor.ask(hf.WhichChildren(), 60)
            dead = [(one.address, one.message) for one in events.take() if isinstance(one, hf.events.DeadLetter)]
        assert dead == ([] if journal else [(made_up, Item(n)) for n in range(3)])
        if not journal:
            await supervisor.ask(hf.StartChild(id="given"), 60)
        assert await (await keeper(system, given)).ask(Taken(), 60) == [10, 11, 12]


class Leave(hf.Message[None]):
    to: hf.ActorRef[Keeper]


class Leaver(Keeper):
    """Says something in its last turn."""

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        message.to.tell(Item(len(self.taken)))
        self.ctx.stop()


async def none_left(supervisor: hf.ActorRef[hf.Supervisor], but: int) -> None:
    async with asyncio.timeout(60.0):
        while len(await supervisor.ask(hf.WhichChildren(), 60)) > but:
            await asyncio.sleep(0)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_nothing_stays_of_a_made_up_child_that_has_ended_but_what_it_said(tmp_path: Path, isolation: Any) -> None:
    template = hf.child(None, hf.start(Leaver), recovery=hf.hybrid(), restart="transient")
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", log=False, store=store) as system:
        supervisor = await system.start(hf.dynamic("d", template=template, intensity=9, isolation=isolation))
        given = await supervisor.ask(hf.StartChild(id="given"), 60)
        made_up = [await supervisor.ask(hf.StartChild(), 60) for _ in range(4)]
        for n, child in enumerate(made_up):
            for _ in range(n):
                await child.send(Item(n))
        for child in made_up[:3]:
            child.tell(Leave(given))
        await supervisor.ask(hf.TerminateChild(made_up[3].path.rpartition("/")[2]), 60)
        await none_left(supervisor, 1)
        async with asyncio.timeout(60.0):
            while len(taken := await given.ask(Taken(), 60)) < 3:
                await asyncio.sleep(0)
        assert sorted(taken) == [0, 1, 2]
        await system._homes.settled()
        assert system._homes.known("/app/d") == [given.path]
        with pytest.raises(hf.errors.NoSuchActor):
            system.ref(made_up[0].path, Leaver)
    async with hf.ActorSystem("app", log=False, store=store) as system:
        assert system._homes.known("/app/d") == [given.path]


async def test_a_process_takes_more_recorded_children_in_its_life_than_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forked_process, "PAGE_BYTES", 8 * 8)  # six places
    template = hf.child(None, hf.start(Leaver), recovery=hf.hybrid(), restart="temporary")
    async with hf.ActorSystem("app", log=False) as system:
        supervisor = await system.start(hf.dynamic("d", template=template, isolation="process"))
        given = await supervisor.ask(hf.StartChild(id="given"), 60)
        for round_number in range(4):
            children = [await supervisor.ask(hf.StartChild(), 60) for _ in range(5)]
            with pytest.raises(hf.StartFailed, match="as many recorded actors as it can"):
                await supervisor.ask(hf.StartChild(), 60)
            for child in children:
                child.tell(Leave(given))
            await none_left(supervisor, 1)
            async with asyncio.timeout(60.0):
                while len(await given.ask(Taken(), 60)) < 5 * (round_number + 1):
                    await asyncio.sleep(0)
