"""One move, with sides of these tests: if anything fails before the commit, the old life goes on."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_asyncio

import holdfast as hf
from holdfast.actors.kernel.lifecycle import LOCAL
from holdfast.actors.migration.here import FromHere, ToHere
from holdfast.actors.migration.move import Move

STEPS = ["prepare", "quiesce", "begin", "let_go"]


@pytest_asyncio.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app") as system:
        yield system


class Add(hf.Message[int]):
    n: int


class Total(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total


class From(FromHere):
    """Leaves a task, and notes each step."""

    def __init__(self, did: list[str]) -> None:
        super().__init__()
        self.did = did

    async def quiesce(self) -> None:
        self.did.append("quiesce")
        await super().quiesce()

    async def let_go(self) -> None:
        self.did.append("let_go")

    def retire(self) -> None:
        self.did.append("retire")
        super().retire()

    def resume(self) -> None:
        self.did.append("resume")
        super().resume()


class To(ToHere):
    """Enters another task with what it has left there."""

    def __init__(self, did: list[str]) -> None:
        super().__init__(LOCAL)
        self.did = did

    async def prepare(self) -> None:
        self.did.append("prepare")

    def packed(self, actor: hf.Actor) -> None:
        assert isinstance(actor, Total)
        total = actor.total

        def restore(new: Any) -> None:
            new.total = total

        self.move.luggage.restore = restore

    async def begin(self) -> None:
        self.did.append("begin")
        await super().begin()

    def discard(self) -> None:
        self.did.append("discard")
        super().discard()


async def moved(ref: hf.ActorRef[Any]) -> tuple[Move, list[str]]:
    did: list[str] = []
    return Move(ref._cell, From(did), To(did), 10.0), did


async def test_a_move_takes_its_steps_in_order(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("one", hf.start(Total)))
    assert await ref.ask(Add(1)) == 1
    move, did = await moved(ref)
    before = ref._cell.actor
    asked = ref.ask(Add(10))
    await move.run()
    assert did == [*STEPS, "retire"]
    assert ref._cell.actor is not before
    assert await asked == 11
    assert await ref.ask(Add(100)) == 111


@pytest.mark.parametrize("how", ["error", "given up"])
@pytest.mark.parametrize("step", STEPS)
async def test_a_move_that_is_given_up_or_fails_at_any_step_leaves_the_life_where_it_is(
    system: hf.ActorSystem, step: str, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ref = await system.start(hf.child("one", hf.start(Total)))
    assert await ref.ask(Add(1)) == 1
    move, did = await moved(ref)
    before, side = ref._cell.actor, move.entering if step in ("prepare", "begin") else move.leaving
    plain = getattr(side, step)

    async def fails() -> None:
        await plain()
        if how == "error":
            raise hf.errors.CannotMove(ref.path, "it fails")
        move.give_up("it is given up")

    monkeypatch.setattr(side, step, fails)
    asked = ref.ask(Add(10))
    with pytest.raises(hf.errors.CannotMove, match="it fails" if how == "error" else "it is given up"):
        await move.run()
    assert did[-2:] == ["discard", "resume"]
    assert "retire" not in did
    assert ref._cell.actor is before
    assert await asked == 11
    assert await ref.ask(Add(100)) == 111
    again, did = await moved(ref)
    await again.run()
    assert did[-1] == "retire"
    assert await ref.ask(Add(1000)) == 1111
