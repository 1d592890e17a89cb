"""Timers over the death of the root: they have run on since they were set, or since the snapshot (T22)."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

import holdfast as hf
from tests.checkpoint.test_engines import killed


class Set(hf.Message):
    delay: float
    every: float = 0.0


class Tick(hf.Message): ...


class Ticks(hf.Message[int]): ...


class Alarm(hf.Actor):
    def __init__(self) -> None:
        self.ticks = 0

    @hf.on(Set)
    def set(self, message: Set) -> None:
        if message.every:
            self.ctx.every(message.every, Tick())
        else:
            self.ctx.tell_after(message.delay, Tick())

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.ticks += 1

    @hf.on(Ticks, readonly=True)
    def read(self, message: Ticks) -> int:
        return self.ticks


ALARM = hf.child("alarm", hf.start(Alarm), recovery=hf.hybrid(interval=3600.0))


async def left_behind(folder: Path, setting: Set, *, saved: bool) -> str:
    """The store as it lies there when its root dies now."""
    live = folder / "1"
    live.mkdir()
    async with hf.ActorSystem("app", store=f"sqlite:{live}/app.db", log=False) as system:
        alarm = await system.start(ALARM)
        alarm.tell(setting)
        assert await alarm.ask(Ticks()) == 0
        if saved:
            await system.checkpoint(alarm)
        await system._homes.settled()
        left = killed(system._homes.journal.engine, live)
    return f"sqlite:{left}/app.db"


@pytest.mark.parametrize("saved", [True, False], ids=["in the snapshot", "in the journal"])
@pytest.mark.parametrize("later", [3590.0, -100.0], ids=["an hour later", "clock set back"])
async def test_a_timer_has_run_on_while_the_root_was_away(tmp_path: Path, saved: bool, later: float) -> None:
    store = await left_behind(tmp_path, Set(3600.0), saved=saved)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        system._node.clock.wall = lambda: time.time() + later
        alarm = await system.start(ALARM)
        home = system._homes.at(alarm.path)
        assert home is not None
        ((_, _, left, _),) = home.timers.saved().values()
        assert left == pytest.approx(10.0 if later > 0 else 3600.0, abs=5.0)


@pytest.mark.parametrize("saved", [True, False], ids=["in the snapshot", "in the journal"])
@pytest.mark.parametrize("every", [0.0, 100.0], ids=["once", "again and again"])
async def test_what_was_due_while_the_root_was_away_comes_once_at_once(
    tmp_path: Path, saved: bool, every: float
) -> None:
    store = await left_behind(tmp_path, Set(100.0, every), saved=saved)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        system._node.clock.wall = lambda: time.time() + 1_000.0
        alarm = await system.start(ALARM)
        while not await alarm.ask(Ticks()):
            pass
        assert await alarm.ask(Ticks()) == 1
