"""A start that fails takes nothing from what waits at the actor, nor from the turn that it has in hand."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf


class Order(hf.Message):
    item: str


class Approved(hf.Message): ...


class Look(hf.Message[list[str]]): ...


class Flow(hf.Actor):
    """`how` says what fails when it is started."""

    def __init__(self, how: str) -> None:
        if how == "init":
            raise RuntimeError("no luck in init")
        if how == "state":
            self.other = 0
        else:
            self.log: list[str] = []
        self._how = how

    def on_start(self, restored: bool) -> None:
        if self._how == "on_start":
            raise RuntimeError("no luck in on_start")

    def on_recovered(self) -> None:
        if self._how == "on_recovered":
            raise RuntimeError("no luck in on_recovered")

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> list[str]:
        return list(self.log)

    @hf.on(Approved)
    def late(self, message: Approved) -> None: ...

    @hf.on(Order)
    async def order(self, message: Order) -> None:
        await self.ctx.wait_for(Approved)
        self.log.append(message.item)


async def start(system: hf.ActorSystem, how: str, isolation: Any) -> hf.ActorRef[Flow]:
    recipe, method = hf.start(Flow, how), hf.hybrid(interval=3600.0)
    if isolation != "subtree":
        return await system.start(hf.child("flow", recipe, isolation=isolation, recovery=method))
    child = hf.child("flow", recipe, recovery=method)
    await system.start(hf.supervisor("flows", children=[child], isolation="process"))
    return system.ref("/app/flows/flow", Flow)


async def approve(ref: hf.ActorRef[Flow], system: hf.ActorSystem, count: int) -> None:
    """Approve the order in hand, and wait until so many are done."""
    async with asyncio.timeout(20.0):
        while "wait_for" not in (await system.get_status(ref)).turn_at:
            await asyncio.sleep(0.005)
        ref.tell(Approved())
        while len(await ref.ask(Look(), timeout=30.0)) < count:
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("how", ["init", "state", "on_start", "on_recovered"])
async def test_what_waits_stays(how: str, isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", log=False, store=store) as system:
        ref = await start(system, "well", isolation)
        ref.tell(Order("lamp"))
        await approve(ref, system, 1)
        await system.checkpoint(ref)
        for item in ("chair", "table"):
            ref.tell(Order(item))
        while "wait_for" not in (await system.get_status(ref)).turn_at:
            await asyncio.sleep(0.005)
    async with hf.ActorSystem("app", log=False, store=store) as system:
        with pytest.raises(hf.StartFailed, match="does not fit the code" if how == "state" else f"no luck in {how}"):
            await start(system, how, isolation)
    async with hf.ActorSystem("app", log=False, store=store) as system:
        ref = await start(system, "well", isolation)
        await approve(ref, system, 2)
        await approve(ref, system, 3)
        assert await ref.ask(Look(), timeout=30.0) == ["lamp", "chair", "table"]


@pytest.mark.parametrize("how", ["init", "on_start"])
@pytest.mark.parametrize("place", ["task", "process", "subtree", "process in a subtree", "pbr", "pbr in a subtree"])
async def test_a_first_start_that_fails_is_no_recovery(how: str, place: str) -> None:
    options: dict[str, Any] = {"isolation": "process"} if place.startswith("process") else {}
    if place.startswith("pbr"):
        options = {"mechanism": hf.ftm.PBR()}
    async with hf.ActorSystem("app", log=False) as system:
        above = await system.start(hf.supervisor("above", isolation="process" if "subtree" in place else "task"))
        with system.events() as stream:
            child = hf.child("flow", hf.start(Flow, how), recovery=hf.hybrid(), **options)
            with pytest.raises(hf.StartFailed, match=f"no luck in {how}"):
                await above.ask(hf.StartChild(child), timeout=30.0)
            well = hf.child("flow", hf.start(Flow, "well"), recovery=hf.hybrid(), **options)
            flow = await above.ask(hf.StartChild(well), timeout=30.0)
            flow.kill()
            phases = [await stream.until(hf.events.RecoveryPhase, timeout=30.0)]
            while phases[-1].phase != "release":
                phases.append(await stream.until(hf.events.RecoveryPhase, timeout=30.0))
            assert [(one.recovery, one.phase) for one in phases].count((1, "detect")) == 1
            assert {one.recovery for one in phases} == {1}
