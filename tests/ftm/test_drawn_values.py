"""`ctx.random`, `ctx.uuid()` and `ctx.now()` are the same in every run of a turn, whatever compares the runs."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.alarms import Diverged, Masked, Outvoted

REQUESTS = 6


class Draw(hf.Message[float]): ...


class Dice(hf.Actor):
    """What it answers and keeps follows from what it draws."""

    def __init__(self) -> None:
        self.drawn: list[float] = []
        self.names: list[str] = []

    @hf.on(Draw)
    async def draw(self, message: Draw) -> float:
        first = self.ctx.random.random()
        await asyncio.sleep(0)
        self.names.append(str(self.ctx.uuid()))
        self.drawn += [first, self.ctx.now()]
        return first + self.ctx.random.random()


class OtherDice(Dice):
    """Another version."""


def holds(reply: object) -> bool:
    return isinstance(reply, float)


STACKS: dict[str, Any] = {
    "tr": hf.ftm.TR(),
    "pbr_tr": hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()),
    "lfr_tr": hf.ftm.compose(hf.ftm.LFR(), hf.ftm.TR()),
    "tmr_tr": hf.ftm.compose(hf.ftm.TMR(), hf.ftm.TR()),
    "tmr": hf.ftm.TMR(),
    "nvp": hf.ftm.NVP(versions=(OtherDice, OtherDice)),
    "ad_lfr": hf.ftm.compose(hf.ftm.AD(assertions=(holds,)), hf.ftm.LFR()),
}


@pytest.mark.parametrize("stack", sorted(STACKS))
async def test_every_run_of_a_turn_draws_the_same(system: hf.ActorSystem, stack: str) -> None:
    ref = await system.start(hf.child("dice", hf.start(Dice), mechanism=STACKS[stack]))
    with system.events() as events:
        replies = [await ref.ask(Draw()) for _ in range(REQUESTS)]
        assert not [one for one in events.take() if isinstance(one, Masked | Outvoted | Diverged)]
    assert len(set(replies)) == REQUESTS
