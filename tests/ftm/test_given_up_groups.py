"""A group that is given up, as when the system ends: its last steps are not taken behind that end."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import Cell
from holdfast.ftm.group.group_place import GroupPlace
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.accounts import Counter

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
