"""What recorded children have accepted waits for somebody, or is told: nothing waits for nobody."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

import holdfast as hf


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
        return self.taken


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
            except hf.NoSuchActor:
                await asyncio.sleep(0)


async def restart(system: hf.ActorSystem, supervisor: hf.ActorRef[hf.Supervisor]) -> None:
    with system.events() as events:
        supervisor.kill()
        async for event in events:
            if isinstance(event, hf.ChildRestarted) and event.address == supervisor.path:
                return


@pytest.mark.parametrize("how", ["supervisor", "root"])
async def test_the_workers_that_a_pool_was_given_come_back_with_what_they_have_accepted(
    tmp_path: Path, how: str
) -> None:
    paths = [f"/app/w/{number}" for number in range(4)]
    spec = hf.pool("w", WORKER, 2, intensity=9)
    store = f"sqlite:{tmp_path / 'app.db'}"

    async def all_taken(system: hf.ActorSystem) -> list[list[int]]:
        return [await (await keeper(system, path)).ask(Taken(), 60) for path in paths]

    expected = [[place * 10 + n for n in range(3)] for place in range(4)]
    async with hf.ActorSystem("app", log=False, store=store) as system:
        pool = await system.start(spec)
        assert await pool.ask(hf.ResizePool(4), 60) == 2
        await fill(system, paths)
        if how == "supervisor":
            await restart(system, pool)
            assert (await pool.ask(hf.PoolInfo(), 60)).size == 4
            assert await all_taken(system) == expected
    async with hf.ActorSystem("app", log=False, store=store) as system:
        pool = await system.start(spec)
        assert (await pool.ask(hf.PoolInfo(), 60)).size == 4
        assert await all_taken(system) == expected
        await pool.ask(hf.ResizePool(1), 60)
        await restart(system, pool)
        assert (await pool.ask(hf.PoolInfo(), 60)).size == 2, "those that were let go do not come back"


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
            dead = [(one.address, one.message) for one in events.take() if isinstance(one, hf.DeadLetter)]
        assert dead == ([] if journal else [(made_up, Item(n)) for n in range(3)])
        if not journal:
            await supervisor.ask(hf.StartChild(id="given"), 60)
        assert await (await keeper(system, given)).ask(Taken(), 60) == [10, 11, 12]
