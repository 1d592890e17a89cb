"""A change does not wait for days: a turn that rests is left, and run again from its start behind the change."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.effects.clerk import IN_TIME, lines
from tests.effects.patient import Call, Count, Go, Look, patient
from tests.effects.test_long_waits import end_of, running, waits

OTHER: dict[str, Any] = {"task": "process", "process": "task"}


@pytest.mark.parametrize("durability", ["memory", "os"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_actor_is_moved_while_its_turn_rests(tmp_path: Path, isolation: str, durability: str) -> None:
    """Nothing is lost, and nothing done twice: there and back, with a kill behind each move."""
    world = str(tmp_path / "world")
    async with running(tmp_path, durability) as system:
        ref = await system.start(patient(isolation))
        asked = asyncio.ensure_future(ref.ask(Go(["e", "c", "e", "s0.01", "c", "e"], world), IN_TIME))
        count = ref.ask(Count(), IN_TIME)
        for word in "ab":
            await waits(system)
            isolation = OTHER[isolation]
            await system.set_isolation(ref, isolation)
            await waits(system)
            await end_of(system, isolation)
            await waits(system)
            await ref.ask(Call(word), IN_TIME)
        assert await asked == "effect 1, call a, effect 2, slept, call b, effect 3"
        assert await count == 1
        await end_of(system, isolation)
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2, slept, call b, effect 3"]
        assert len(lines(world)) == 3


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_comes_while_it_is_moved_is_taken_once(tmp_path: Path, isolation: str) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        for number in range(3):
            asked = ref.ask(Go(["s0.02", "c", "c"]), IN_TIME)
            await waits(system)
            isolation = OTHER[isolation]
            moved = asyncio.ensure_future(system.set_isolation(ref, isolation))
            for step in range(2):
                ref.tell(Call(f"{number}.{step}"))
                await asyncio.sleep(0.01)
            await moved
            assert await asked == f"slept, call {number}.0, call {number}.1"
        assert len(await ref.ask(Look(), IN_TIME)) == 3


class Unready(hf.Message): ...


class Fussy(hf.Actor):
    """It begins in one process only: in its first life."""

    def __init__(self, home: int) -> None:
        if os.getpid() != home:
            raise RuntimeError("not here")
        self.seen: list[str] = []

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        self.seen.append("begun")
        word = (await self.ctx.wait_for(Call)).word
        self.seen.append(word)
        return ", ".join(self.seen)

    @hf.on(Call)
    def call(self, message: Call) -> None: ...


async def test_a_move_that_fails_ends_the_life_whose_turn_was_left(tmp_path: Path) -> None:
    """Its state was that of no turn; the next life, at the old place, goes on as after a kill."""
    async with running(tmp_path) as system:
        spec = hf.child("patient", hf.start(Fussy, os.getpid()), recovery=hf.hybrid(interval=1000.0))
        ref = await system.start(spec)
        asked = ref.ask(Go([]), IN_TIME)
        await waits(system)
        with pytest.raises(hf.HoldfastError, match="not here"):
            await system.set_isolation(ref, "process")
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "begun, a"


async def test_its_process_dies_while_it_leaves(tmp_path: Path) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient("process"))
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        moved = asyncio.ensure_future(system.set_isolation(ref, "task"))
        await asyncio.sleep(0)
        os.kill(system.pid_of(ref), signal.SIGKILL)
        await asyncio.wait((moved,))
        moved.exception()
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "call a"
