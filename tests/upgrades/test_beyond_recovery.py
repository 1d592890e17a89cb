"""A child that cannot be recovered by its code: what a change of its code does, and what is said of it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Literal

import pytest

import holdfast as hf

Place = Literal["task", "process"]


class Add(hf.Message[int]): ...


class Old(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.count += 1
        return self.count


@hf.renamed("tests.upgrades.test_beyond_recovery:Old")
class New(Old):
    schema_version = 2

    def __init__(self) -> None:
        super().__init__()
        self.extra = 5

    @classmethod
    def migrate(cls, state: dict[str, int], from_version: int) -> dict[str, int]:
        return {**state, "extra": 6}


class Stranger(Old): ...


def to_old(state: dict[str, int]) -> dict[str, int]:
    return {"count": state["count"]}


def template(kind: type[Old], place: Place = "task", seconds: float = 60.0) -> hf.ChildSpec:
    backoff = hf.Backoff(initial=seconds, maximum=60.0, jitter=0.0)
    return hf.child(None, hf.start(kind), isolation=place, recovery=hf.hybrid(), backoff=backoff)


def counters(template: hf.ChildSpec, supervised: Place = "task", *, intensity: int = 0) -> hf.ChildSpec:
    return hf.dynamic("counters", template=template, journal=True, intensity=intensity, isolation=supervised)


@asynccontextmanager
async def program(store: Path, spec: hf.ChildSpec) -> AsyncGenerator[tuple[hf.ActorSystem, hf.ActorRef[hf.Supervisor]]]:
    async with hf.ActorSystem("app", store=f"sqlite:{store}/app.db", log=False) as system:
        yield system, await system.start(spec)


async def recorded_by(kind: type[Old], store: Path) -> None:
    """A program in which a child has counted to 2."""
    async with program(store, counters(template(kind))) as (_, supervisor):
        child = await supervisor.ask(hf.StartChild(id="p"))
        assert [await child.ask(Add()) for _ in range(2)] == [1, 2]


async def is_beyond(supervisor: hf.ActorRef[hf.Supervisor]) -> None:
    """Wait until the first attempt to bring the child back has failed, and it waits for the next one."""
    async with asyncio.timeout(30):
        while True:
            try:
                await supervisor.ask(hf.StartChild(id="p"))
            except hf.errors.AlreadyStarted as known:
                if "cannot be recovered: /app/counters/p could not be started: what is recorded" in str(known):
                    return
            await asyncio.sleep(0.01)


async def replace(system: hf.ActorSystem, kind: type[Old], *changes: object) -> None:
    async with system.transaction() as change:
        change.replace_code("/app/counters/p", kind, *changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("place", ["task", "process"])
async def test_a_class_that_fits_is_tried_and_lasts(tmp_path: Path, place: Place) -> None:
    """The attempt does not count: any restart that does would end this supervisor."""
    await recorded_by(New, tmp_path)
    async with program(tmp_path, counters(template(Old, place))) as (system, supervisor):
        await is_beyond(supervisor)
        await replace(system, New)
        assert await system.ref("/app/counters/p", New).ask(Add()) == 3
    async with program(tmp_path, counters(template(Old, place))) as (system, supervisor):
        async with asyncio.timeout(30):
            assert await system.ref("/app/counters/p", New).ask(Add()) == 4
        await replace(system, Old, to_old)
        assert await system.ref("/app/counters/p", Old).ask(Add()) == 5


@pytest.mark.parametrize("supervised", ["task", "process"])
async def test_what_cannot_be_tried_fails_at_once_and_says_why(tmp_path: Path, supervised: Place) -> None:
    await recorded_by(New, tmp_path)
    async with program(tmp_path, counters(template(Old), supervised)) as (system, supervisor):
        await is_beyond(supervisor)
        began = time.monotonic()
        with pytest.raises(hf.TransactionFailed, match=r"it cannot be recovered: what is recorded.*by .*:New"):
            await replace(system, Old, to_old)
        with pytest.raises(hf.TransactionFailed, match=r"it cannot be recovered: what is recorded.*as .*:Stranger|Old"):
            await replace(system, Stranger)
        assert time.monotonic() - began < 5.0
        await supervisor.ask(hf.supervision.ChangeSupervisor(children=[template(New)]))
        await supervisor.ask(hf.TerminateChild("p"))
        child = await supervisor.ask(hf.StartChild(id="p"))
        assert await child.ask(Add()) == 3


async def states_of(supervisor: hf.ActorRef[hf.Supervisor]) -> dict[str, str]:
    """The children, as soon as none of them is about to begin."""
    async with asyncio.timeout(30):
        while True:
            states = {one.id: one.state for one in await supervisor.ask(hf.WhichChildren())}
            if "starting" not in states.values():
                return states
            await asyncio.sleep(0.01)


async def test_a_way_back_that_was_cut_short_is_finished_by_the_new_release(tmp_path: Path) -> None:
    names = ("p", "q")
    async with program(tmp_path, counters(template(New))) as (system, supervisor):
        children = [await supervisor.ask(hf.StartChild(id=name)) for name in names]
        assert [await child.ask(Add()) for child in children] == [1, 1]
        await supervisor.ask(hf.supervision.ChangeSupervisor(children=[template(Old)]))
        await replace(system, Old, to_old)
    async with program(tmp_path, counters(template(Old))) as (_, supervisor):
        assert await states_of(supervisor) == {"p": "running", "q": "restarting"}
    async with program(tmp_path, counters(template(New))) as (system, supervisor):
        assert await states_of(supervisor) == {"p": "running", "q": "running"}
        await supervisor.ask(hf.supervision.ChangeSupervisor(children=[template(Old)]))
        for one in await supervisor.ask(hf.WhichChildren()):
            if (await system.get_status(one.path)).kind.endswith("New"):
                async with system.transaction() as change:
                    change.replace_code(one.path, Old, to_old)
    async with program(tmp_path, counters(template(Old))) as (system, supervisor):
        assert await states_of(supervisor) == {"p": "running", "q": "running"}
        assert [await system.ref(f"/app/counters/{name}", Old).ask(Add()) for name in names] == [2, 2]


class Broken(hf.Actor):
    def on_start(self, restored: bool) -> None:
        raise OSError("no such device")


async def replace_and_fail(system: hf.ActorSystem) -> None:
    async with system.transaction() as change:
        change.replace_code("/app/counters/p", New)
        change.add("/app", hf.child("broken", hf.start(Broken)))


@pytest.mark.parametrize("place", ["task", "process"])
async def test_what_was_tried_is_taken_back_with_the_transaction(tmp_path: Path, place: Place) -> None:
    await recorded_by(New, tmp_path)
    async with program(tmp_path, counters(template(Old, place, seconds=0.05), intensity=1000)) as (system, supervisor):
        await is_beyond(supervisor)
        with pytest.raises(hf.TransactionFailed, match="no such device"):
            await replace_and_fail(system)
        await is_beyond(supervisor)
        await replace(system, New)
        assert await system.ref("/app/counters/p", New).ask(Add()) == 3
