"""A child that is stopped for good while others are restarted is not started with them."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from tests.system.trees import Boom, Counter


class Late(Counter):
    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(0.05)

    async def on_stop(self, reason: hf.ExitReason) -> None:
        await asyncio.sleep(0.05)


TICKS = 40


async def ticked(ticks: int) -> None:
    for _ in range(ticks):
        await asyncio.sleep(0)


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("strategy", ["one_for_one", "one_for_all", "rest_for_one"])
@pytest.mark.parametrize("name", ["a", "late", "b"])
@pytest.mark.parametrize("first", ["crash", "stop"])
async def test_a_child_that_is_stopped_stays_so_whenever_its_group_is_restarted(
    strategy: Any, name: str, first: str
) -> None:
    for ticks in range(TICKS):
        async with hf.ActorSystem("app", log=False, intensity=99) as system:
            names = {"a": Counter, "late": Late, "b": Counter}
            children = [hf.child(one, hf.start(kind)) for one, kind in names.items()]
            top = await system.start(hf.supervisor("top", strategy=strategy, intensity=99, children=children))
            crashing = "a" if name != "a" else "late"
            found = system._node.find(f"/app/top/{name}")
            assert found is not None
            if first == "crash":
                system.ref(f"/app/top/{crashing}", hf.Actor).tell(Boom())
                await ticked(ticks)
                await system.stop(found.ref)
            else:
                stopping = asyncio.ensure_future(system.stop(found.ref))
                await ticked(ticks)
                system.ref(f"/app/top/{crashing}", hf.Actor).tell(Boom())
                await stopping
            await asyncio.sleep(1.0)
            assert [info.id for info in await top.ask(hf.WhichChildren())] == [one for one in names if one != name]
            assert system._node.find(f"/app/top/{name}") is None
