"""A state that the code does not fit is refused however often, and never exchanged for an older one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf


class Put(hf.Message[int]):
    item: str


class Items(hf.Message[list[str]]): ...


class Cart(hf.Actor):
    def __init__(self) -> None:
        self.items: list[str] = []

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.items = [*self.items, message.item]
        return len(self.items)

    @hf.on(Items, readonly=True)
    def read(self, message: Items) -> list[str]:
        return list(self.items)


@hf.renamed(f"{__name__}:Cart")
class Newer(Cart):
    """The next release, which has forgotten how to migrate."""

    schema_version = 2


def carts(kind: type[Cart], above: Any, own: Any) -> hf.ChildSpec:
    template = hf.child(None, hf.start(kind), recovery=hf.hybrid(on_escalate="older_snapshot"), isolation=own)
    return hf.dynamic("carts", template=template, journal=True, isolation=above, intensity=2)


async def begun_with_other_code(told: list[str], options: dict[str, Any], spec: hf.ChildSpec) -> None:
    async with hf.ActorSystem("app", **options) as system:
        system._node.events.add_sink(lambda event: told.append(str(event)))
        await system.start(spec)
        await asyncio.wait_for(asyncio.Event().wait(), 20.0)


@pytest.mark.parametrize(("above", "own"), [("task", "task"), ("task", "process"), ("process", "task")])
async def test_code_that_does_not_fit_costs_no_acknowledged_message(tmp_path: Path, above: Any, own: Any) -> None:
    """The supervisors end because of it, one after another: each time, an older snapshot would have been taken."""
    options: dict[str, Any] = {"store": f"sqlite:{tmp_path / 'app.db'}", "log": False}
    async with hf.ActorSystem("app", **options) as system:
        supervisor = await system.start(carts(Cart, above, own))
        ann = await supervisor.ask(hf.StartChild(id="ann"))
        for item in "abc":
            await ann.ask(Put(item))
        await system.checkpoint(ann)
        await ann.ask(Put("d"))
    told: list[str] = []
    with pytest.raises((hf.TreeFailed, hf.StartFailed), match=r"gave up|does not fit the code"):
        await begun_with_other_code(told, options, carts(Newer, above, own))
    assert [line for line in told if "does not fit the code" in line]
    assert not [line for line in told if line.startswith("RolledBack")]
    async with hf.ActorSystem("app", **options) as system:
        await system.start(carts(Cart, above, own))
        async with asyncio.timeout(20.0):
            while "/app/carts/ann" not in system.tree():
                await asyncio.sleep(0.005)
        assert await system.ref("/app/carts/ann", Cart).ask(Items(), timeout=20.0) == ["a", "b", "c", "d"]


async def test_a_supervisor_gives_up_at_once_and_who_asks_is_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but other code can help: it is not tried again, however many restarts are allowed."""
    async with hf.ActorSystem("app", log=False) as system:
        cart = hf.child("cart", hf.start(Cart), recovery=hf.hybrid(interval=1000.0))
        await system.start(hf.supervisor("top", intensity=1000, children=[cart], restart="temporary"))
        ref = system.ref("/app/top/cart", Cart)
        await ref.ask(Put("a"))
        await system.checkpoint(ref)
        monkeypatch.setattr(Cart, "schema_version", 2)
        with system.events() as stream:
            ref.kill()
            with pytest.raises(hf.ActorStopped, match=r"does not fit the code: .*has no classmethod migrate"):
                await ref.ask(Items(), timeout=20.0)
            async with asyncio.timeout(20.0):
                told = [event async for event in _until_given_up(stream)]
        assert sum(isinstance(event, hf.events.ChildStartFailed) for event in told) == 1


async def _until_given_up(stream: hf.events.EventStream) -> AsyncIterator[hf.events.Event]:
    async for event in stream:
        yield event
        if isinstance(event, hf.events.SupervisorGaveUp):
            assert "does not fit the code" in str(event.reason)
            return
