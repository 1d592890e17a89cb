"""Actors are moved while recorded ones send all the time: the move comes to its end, and all comes once, in order."""

from __future__ import annotations

import asyncio
import itertools
import os
import random
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import CannotMove
from holdfast.actors.kernel.cell import Cell
from holdfast.actors.migration.move import CommitGate
from holdfast.system.live_moves import Moves

IN_TIME = 30.0
SEED = int(os.environ.get("HOLDFAST_SEED", "20261128"))
ROUNDS = int(os.environ.get("HOLDFAST_LOADED_MOVES", "3"))


class Count(hf.Message):
    sender: str
    n: int


class Got(hf.Message[dict[str, list[int]]]): ...


class Tick(hf.Message): ...


class Quiet(hf.Message[int]): ...


class Counted(hf.Actor):
    def __init__(self) -> None:
        self.got: dict[str, list[int]] = {}

    @hf.on(Count)
    def count(self, message: Count) -> None:
        self.got.setdefault(message.sender, []).append(message.n)

    @hf.on(Got, readonly=True)
    def read(self, message: Got) -> dict[str, list[int]]:
        return self.got


class Load(hf.Actor):
    """Tells somebody a number at each tick."""

    to: hf.Binding[Counted]

    def __init__(self, name: str, every: float) -> None:
        self.name, self.every, self.n, self.is_quiet = name, every, 0, False

    def on_start(self, restored: bool) -> None:
        if not restored:
            self.ctx.every(self.every, Tick())

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        if not self.is_quiet:
            self.n += 1
            self.to.tell(Count(self.name, self.n))

    @hf.on(Quiet)
    def be_quiet(self, message: Quiet) -> int:
        self.is_quiet = True
        return self.n


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False, intensity=100_000) as running:
        yield running


def load(name: str, every: float, **options: Any) -> hf.ChildSpec:
    recipe = hf.start(Load, name, every)
    return hf.child(name, recipe, recovery=hf.hybrid(interval=60.0), bindings={"to": "/app/north/a"}, **options)


async def sides(system: hf.ActorSystem, recovery: Any = None, **options: Any) -> None:
    """`a` and `b` below `north`, and nobody below `south`."""
    own: dict[str, Any] = {"recovery": recovery, **options} if recovery is not None else options
    children = [hf.child(name, hf.start(Counted), **own) for name in ("a", "b")]
    await system.start(hf.supervisor("north", children=children, intensity=100_000))
    await system.start(hf.supervisor("south", intensity=100_000))


async def sends(system: hf.ActorSystem, path: str, name: str, before: int = 0) -> int:
    """How many have come, when more than so many have."""
    async with asyncio.timeout(IN_TIME):
        while True:
            numbers = (await system.ref(path, Counted).ask(Got(), timeout=IN_TIME)).get(name, [])
            if len(numbers) > before:
                return len(numbers)
            await asyncio.sleep(0.01)


async def judge(system: hf.ActorSystem, path: str, senders: list[str]) -> None:
    """All that was said has come in order, once."""
    for name in senders:
        last = await system.ref(f"/app/{name}", Load).ask(Quiet(), timeout=IN_TIME)
        async with asyncio.timeout(IN_TIME):
            while True:
                numbers = (await system.ref(path, Counted).ask(Got(), timeout=IN_TIME)).get(name, [])
                if last in numbers:
                    break
                await asyncio.sleep(0.01)
        assert numbers == list(range(1, last + 1))


@pytest.mark.parametrize("who", ["a", "b"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=60.0)], ids=["plain", "recorded"])
@pytest.mark.parametrize(
    "options",
    [{}, {"isolation": "process"}, {"mechanism": hf.ftm.PBR()}, {"mechanism": hf.ftm.LFR()}],
    ids=["task", "process", "pbr", "lfr"],
)
async def test_a_move_comes_to_its_end_while_a_recorded_actor_sends(
    system: hf.ActorSystem, options: dict[str, Any], recovery: Any, who: str
) -> None:
    """Also of somebody to whom it has never said anything."""
    await sides(system, recovery)
    await system.start(load("load", 0.005, **options))
    await sends(system, "/app/north/a", "load")
    for old, new in itertools.islice(itertools.cycle([("north", "south"), ("south", "north")]), 3):
        async with system.transaction(timeout=IN_TIME) as change:
            change.move(f"/app/{old}/{who}", f"/app/{new}")
    await judge(system, "/app/south/a" if who == "a" else "/app/north/a", ["load"])


async def test_one_that_did_not_come_to_rest_in_time_is_tried_again(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It sends all the time, so it has to stand still, and there is no moment without."""
    await sides(system, hf.hybrid())
    await system.start(load("load", 0.001))
    await sends(system, "/app/north/a", "load")
    pause, late = Moves.pause, list[str]()

    async def late_at_first(moves: Moves, cell: Cell, timeout: float, gate: CommitGate) -> None:
        if cell.path == "/app/load" and not late:
            late.append(cell.path)
            given_up: asyncio.Future[str] = asyncio.get_running_loop().create_future()
            gate.on_closed(given_up.set_result)
            raise CannotMove(cell.path, await given_up)
        await pause(moves, cell, timeout, gate)

    monkeypatch.setattr(Moves, "pause", late_at_first)
    async with system.transaction(timeout=IN_TIME) as change:
        change.move("/app/north/a", "/app/south")
    assert late == ["/app/load"]
    await judge(system, "/app/south/a", ["load"])


async def test_two_moves_of_one_transaction_share_the_senders(system: hf.ActorSystem) -> None:
    await sides(system, hf.hybrid(interval=60.0))
    names = [f"load{n}" for n in range(20)]
    for name in names:
        await system.start(load(name, 0.01))
        await sends(system, "/app/north/a", name)
    async with system.transaction(timeout=IN_TIME) as change:
        change.move("/app/north/a", "/app/south")
        change.move("/app/north/b", "/app/south")
    await judge(system, "/app/south/a", names)


class Never(hf.Actor):
    async def on_start(self, restored: bool) -> None:
        await asyncio.Event().wait()


async def test_senders_go_on_after_a_move_that_is_given_up(system: hf.ActorSystem) -> None:
    await sides(system, hf.hybrid(interval=60.0))
    await system.start(load("load", 0.005))
    await sends(system, "/app/north/a", "load")

    async def change_all() -> None:
        async with system.transaction(timeout=1.0) as change:
            change.move("/app/north/a", "/app/south")
            change.add("/app/south", hf.child("never", hf.start(Never), shutdown="brutal_kill"))

    with pytest.raises(hf.TransactionFailed):
        await change_all()
    before = await sends(system, "/app/north/a", "load")
    assert await sends(system, "/app/north/a", "load", before) > before
    await judge(system, "/app/north/a", ["load"])


@pytest.mark.parametrize("number", range(ROUNDS))
async def test_moves_and_kills_under_load_lose_and_reorder_nothing(system: hf.ActorSystem, number: int) -> None:
    print(f"HOLDFAST_SEED={SEED + number}")
    draw = random.Random(SEED + number)
    place: list[dict[str, Any]] = [{}, {"isolation": "process"}, {"mechanism": hf.ftm.PBR()}]
    await sides(system, hf.hybrid(interval=0.1), **draw.choice(place))
    names = [f"load{n}" for n in range(draw.randint(1, 4))]
    for name in names:
        await system.start(load(name, draw.choice([0.003, 0.01, 0.03]), **draw.choice(place)))
        await sends(system, "/app/north/a", name)
    at = "north"

    async def strike() -> None:
        while True:
            await asyncio.sleep(0.3 * draw.random())
            target = draw.choice([f"/app/{one}" for one in names] + ["/app/north/a", "/app/south/a"])
            try:
                system.ref(target).kill()
            except (hf.ActorStopped, hf.errors.NoSuchActor):
                pass

    strikes = asyncio.ensure_future(strike())
    moved = 0
    for _ in range(12):
        to = "south" if at == "north" else "north"
        try:
            async with system.transaction(timeout=draw.choice([0.05, 5.0, 5.0])) as change:
                change.move(f"/app/{at}/a", f"/app/{to}")
            at, moved = to, moved + 1
        except (hf.TransactionFailed, hf.TransactionRefused):
            pass
    strikes.cancel()
    await asyncio.wait((strikes,))
    assert moved
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(f"/app/{at}/a", f"/app/{'south' if at == 'north' else 'north'}")
    await judge(system, f"/app/{'south' if at == 'north' else 'north'}/a", names)
