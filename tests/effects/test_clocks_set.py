"""The machine's clock is set while a turn waits: so many seconds stay so many seconds, and a moment is a moment."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.testing import advance
from tests.effects.clerk import IN_TIME

DAY = 86400.0
VIRTUAL = pytest.mark.asyncio(loop_factories=["virtual"])


class Call(hf.Message): ...


class Rest(hf.Message[str]):
    how: str
    seconds: float


class Over(hf.Message[list[str]]): ...


class Rester(hf.Actor):
    def __init__(self) -> None:
        self.over: list[str] = []

    @hf.on(Rest)
    async def rest(self, message: Rest) -> str:
        if message.how == "sleep":
            await self.ctx.sleep(message.seconds)
        elif message.how == "until":
            await self.ctx.sleep_until(self.ctx.now() + message.seconds)
        else:
            with contextlib.suppress(hf.errors.WaitTimeout):
                await self.ctx.wait_for(Call, timeout=message.seconds)
        self.over.append(message.how)
        return message.how

    @hf.on(Call)
    def call(self, message: Call) -> None: ...

    @hf.on(Over)
    def which(self, message: Over) -> list[str]:
        return self.over


def rester() -> hf.ChildSpec[Rester]:
    return hf.child("rester", hf.start(Rester), recovery=hf.hybrid(interval=1000.0))


async def rests(system: hf.ActorSystem) -> None:
    """Wait until the turn rests, and its home knows."""
    async with asyncio.timeout(IN_TIME):
        while not ((home := switch_of(system._node.cell_at("/app/rester"))) and home.calls.rests.is_busy):
            await asyncio.sleep(0.001)


def set_clock(monkeypatch: pytest.MonkeyPatch, system: hf.ActorSystem, by: float) -> None:
    """Set the clock that says what time it is; no other clock notices."""
    wall = system._node.clock.wall
    monkeypatch.setattr(system._node.clock, "wall", lambda: wall() + by)


@VIRTUAL
@pytest.mark.parametrize("by", [-DAY, DAY])
@pytest.mark.parametrize("how", ["sleep", "wait"])
@pytest.mark.parametrize("is_killed", [False, True])
async def test_so_many_seconds_last_as_long_whatever_the_clock_is_set_to(
    monkeypatch: pytest.MonkeyPatch, by: float, how: str, is_killed: bool
) -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(rester())
        asked = asyncio.ensure_future(ref.ask(Rest(how, 20_000.0), timeout=10 * DAY))
        await rests(system)
        set_clock(monkeypatch, system, by)
        await advance(5_000.0)
        if is_killed:
            ref.kill()
        await advance(14_000.0)
        assert not asked.done(), "it is over early"
        await advance(1_100.0)
        assert asked.done(), "it is over late"
        assert await asked == how


@VIRTUAL
async def test_a_moment_comes_when_the_clock_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(rester())
        asked = asyncio.ensure_future(ref.ask(Rest("until", 20_000.0), timeout=10 * DAY))
        await rests(system)
        set_clock(monkeypatch, system, -DAY)
        await advance(21_000.0)
        assert not asked.done()
        await advance(DAY)
        assert await asked == "until"


@pytest.mark.parametrize("how", ["sleep", "wait"])
async def test_the_next_program_waits_no_longer_than_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", log=False, store=store) as system:
        asked = asyncio.ensure_future((await system.start(rester())).ask(Rest(how, 0.5), timeout=IN_TIME))
        await rests(system)
        asked.cancel()
    async with hf.ActorSystem("app", log=False, store=store) as system:
        set_clock(monkeypatch, system, -DAY)
        ref = await system.start(rester())
        assert await ref.ask(Over(), timeout=IN_TIME) == [how]
