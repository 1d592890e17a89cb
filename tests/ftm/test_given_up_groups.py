"""A group that is given up, as when the system ends: its last steps are not taken behind that end."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import Cell
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.accounts import Add, Counter

lead, dismantle = GroupPlace.lead, GroupPlace.dismantle

WHERE = ("while it starts", "while a start that has failed is undone", "while it works")


class Hesitant(Counter):
    """Its start takes as long as anybody waits."""

    async def on_start(self, restored: bool) -> None:
        await asyncio.Event().wait()


class Failing(Counter):
    def on_start(self, restored: bool) -> None:
        raise ValueError("no")


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("where", WHERE)
async def test_the_end_of_a_system_waits_for_the_end_of_a_group(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The supervisor above dies with its process, so that nobody else waits; the end of the replicas takes its time."""
    begun, order = asyncio.Event(), list[str]()

    async def leads(place: GroupPlace, *args: Any) -> None:
        if where == WHERE[0]:
            begun.set()
        await lead(place, *args)

    async def slow(place: GroupPlace, cell: Cell) -> None:
        begun.set()
        await dismantle(place, cell)
        await asyncio.sleep(0.5)
        order.append("group")

    monkeypatch.setattr(GroupPlace, "lead", leads)
    monkeypatch.setattr(GroupPlace, "dismantle", slow)
    kind = (Hesitant, Failing, Counter)[WHERE.index(where)]
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("c", hf.start(kind), mechanism=PBR())
        top = hf.supervisor("top", children=[spec], isolation="process", shutdown="brutal_kill")
        start = asyncio.ensure_future(system.start(top))
        await asyncio.wait_for(start if where == WHERE[2] else begun.wait(), 30)
    order.append("system")
    assert [task.get_name() for task in asyncio.all_tasks() if "/app/top/c" in task.get_name()] == []
    assert order == ["group", "system"]
    await asyncio.wait((start,))
    assert (start.exception() is None) == (where == WHERE[2])


class Late(Counter):
    """Comes up when it may, and says when it has stopped."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = Path(folder)

    async def on_start(self, restored: bool) -> None:
        while not (self.folder / "may start").exists():
            await asyncio.sleep(0.01)

    async def on_stop(self, reason: hf.ExitReason) -> None:
        (self.folder / "stopped").touch()


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("mechanism", [hf.ftm.PBR, hf.ftm.LFR, hf.ftm.TMR, hf.ftm.TR])
async def test_a_stop_that_comes_while_the_next_life_begins_ends_it_when_it_is_up(
    system: hf.ActorSystem, mechanism: Any, tmp_path: Path
) -> None:
    """In good order, and at once."""
    (tmp_path / "may start").touch()
    spec = hf.child("alice", hf.start(Late, str(tmp_path)), mechanism=mechanism(), recovery=hf.hybrid(), shutdown=20.0)
    ref = await system.start(spec)
    await ref.ask(Add(1))
    (tmp_path / "may start").unlink()
    for path, pid in system._workers.processes().items():
        if path.startswith(f"{ref.path}/"):
            os.kill(pid, signal.SIGKILL)
    place = ref._cell.host.place
    assert isinstance(place, GroupPlace)
    async with asyncio.timeout(10):
        while place._starting is None or place._starting.done():
            await asyncio.sleep(0.005)
        ending = asyncio.ensure_future(system.terminate(ref))
        while place._stop_wanted is None:
            await asyncio.sleep(0.005)
        (tmp_path / "may start").touch()
        await ending
    assert (tmp_path / "stopped").exists()
