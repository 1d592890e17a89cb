"""A state is saved between two turns, never in the middle of one that was cut off (T9, R27)."""

from __future__ import annotations

import asyncio

import pytest

import holdfast as hf


class Add(hf.Message[int]):
    n: int
    end: str


class Look(hf.Message[list[int]]): ...


class Adder(hf.Actor):
    """Asks for a snapshot of itself to be taken as soon as its turn is over, and ends that turn early."""

    def __init__(self) -> None:
        self.items: list[int] = []

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        if self.ctx._cell.life > 1:
            self.items.append(message.n)
            return len(self.items)
        loop = asyncio.get_running_loop()
        self.items.append(-1)
        try:
            if message.end == "kill":
                loop.call_soon(self.ctx._cell.kill)
                await asyncio.Event().wait()
            await asyncio.sleep(0)
        finally:  # It comes behind this turn and ahead of the actor's next slice.
            loop.call_soon(self.ctx.recorded.want_snapshot)  # type: ignore[attr-defined]
        raise RuntimeError("boom")

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> list[int]:
        return list(self.items)


@pytest.mark.parametrize("end", ["kill", "crash"])
async def test_a_snapshot_that_is_wanted_when_a_turn_is_cut_off_does_not_save_half_of_it(end: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        recovery = hf.hybrid(interval=3600.0)
        ref: hf.ActorRef[Adder] = await system.start(hf.child("adder", hf.start(Adder), recovery=recovery))
        ref.tell(Add(1, end))
        ref.tell(Add(2, ""))
        left = [1, 2] if end == "kill" else [2]  # A killed turn is handled again; what crashed is not.
        assert await ref.ask(Look(), timeout=10.0) == left
        await system.checkpoint(ref)
        ref.kill()
        assert await ref.ask(Look(), timeout=10.0) == left
