"""What recovery does not bring back: "Limits of recovery" in docs/guarantees.md."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Doer, Note, Seen, Sink, start, until
from tests.checkpoint.strikes import NEVER, strike


class Spawn(hf.Message[str]): ...


class Parent(hf.Actor):
    def __init__(self) -> None:
        self.count = 0

    def on_start(self, restored: bool) -> None:
        self.ctx.spawn(hf.start(Sink), "first")

    @hf.on(Spawn)
    def spawn(self, message: Spawn) -> str:
        self.count += 1
        return self.ctx.spawn(hf.start(Sink), f"child{self.count}").path

    @hf.on(Seen, readonly=True)
    def children(self, message: Seen) -> list[str]:
        return sorted(self.ctx._cell.children or {})


async def recovered(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    life = ref._cell.life
    strike(system, ref)
    await until(lambda: ref._cell.life > life and ref._cell.host.is_up(ref._cell))


async def test_children_spawned_before_the_snapshot_do_not_come_back(isolation: str, store: str | None) -> None:
    """Those of the turns since do, and those of `on_start`."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await start(system, isolation, "parent", hf.start(Parent), recovery=hf.hybrid(interval=NEVER))
        await ref.ask(Spawn(), timeout=30.0)
        await system.checkpoint(ref, timeout=30.0)
        await ref.ask(Spawn(), timeout=30.0)
        assert await ref.ask(Seen(), timeout=30.0) == ["child1", "child2", "first"]
        await recovered(system, ref)
        assert await ref.ask(Seen(), timeout=30.0) == ["child2", "first"]


class Name(hf.Message[str]): ...


class Reborn(hf.Actor):
    """Gives each child the name of the one before, which has ended."""

    @hf.on(Name)
    def spawn(self, message: Name) -> str:
        return self.ctx.spawn(hf.start(Sink), "child").path


async def test_a_turn_that_gives_a_child_the_name_of_one_that_has_ended_cannot_be_replayed() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("reborn", hf.start(Reborn), recovery=hf.hybrid(interval=NEVER))
        await system.start(hf.supervisor("house", children=[spec], restart="temporary"))
        ref = system.ref("/app/house/reborn", Reborn)
        path = await ref.ask(Name(), timeout=30.0)
        await system.terminate(system.ref(path, Sink))
        assert await ref.ask(Name(), timeout=30.0) == path
        ref.kill()
        with pytest.raises(hf.errors.ActorStopped, match=r"diverged at turn 2.*NameTaken"):
            await ref.ask(Name(), timeout=30.0)


async def test_a_suspension_ends_with_the_life(isolation: str, store: str | None) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=NEVER))
        await system.suspend(ref, timeout=30.0)
        held = ref.ask(Note("held"), timeout=60.0)
        await system.checkpoint(ref, timeout=30.0)
        await recovered(system, ref)
        assert await held == 1


async def test_background_work_of_a_turn_holds_up_snapshots(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await start(system, isolation, "worker", hf.start(Waiting), recovery=hf.hybrid(interval=NEVER))
        await ref.ask(Spawn(), timeout=30.0)
        saved = asyncio.ensure_future(system.checkpoint(ref, timeout=60.0))
        await ref.ask(Seen(), timeout=30.0)
        assert not saved.done()
        await ref.ask(Note("go"), timeout=30.0)
        await saved


class Waiting(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[str] = []
        self._gate = asyncio.Event()

    @hf.on(Spawn)
    def begin(self, message: Spawn) -> str:
        self.ctx.pipe_to_self(self._gate.wait(), lambda _: Note("through"))
        return ""

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.seen.append(message.text)
        self._gate.set()
        return len(self.seen)

    @hf.on(Seen, readonly=True)
    def read(self, message: Seen) -> list[str]:
        return list(self.seen)
