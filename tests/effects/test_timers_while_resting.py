"""Timers that hooks set anew at each life, and that turns cancel: a life finds those that there were at its state."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm import LFR, PBR
from holdfast.testing import advance
from tests.checkpoint.test_engines import killed
from tests.effects.clerk import IN_TIME
from tests.effects.test_effects_protected import leader_dies, whole
from tests.effects.test_long_waits import DAY, VIRTUAL, end_of, waits


class Tick(hf.Message): ...


class Call(hf.Message): ...


class Cancel(hf.Message[int]):
    """Cancel the timer, set the next one if there is to be one, and wait for a call, if that is wanted."""

    sets: bool = False
    waits: bool = False


class Ticks(hf.Message[int]): ...


class Alarm(hf.Actor):
    """Its first timer, or the one that there is, is set by its start."""

    def __init__(self) -> None:
        self.ticks = 0

    def on_start(self, restored: bool) -> None:
        self.set()

    @property
    def due(self) -> Any:
        return self._due

    def set(self) -> None:
        self._due = self.ctx.tell_after(DAY, Tick())

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.ticks += 1

    @hf.on(Cancel)
    async def cancel(self, message: Cancel) -> int:
        self.due.cancel()
        if message.sets:
            self.set()
        if message.waits:
            await self.ctx.wait_for(Call)
        return self.ticks

    @hf.on(Call)
    def call(self, message: Call) -> None: ...

    @hf.on(Ticks)
    def read(self, message: Ticks) -> int:
        return self.ticks


class Late(Alarm):
    """The same, when it has caught up; it keeps what it has of it."""

    def __init__(self) -> None:
        super().__init__()
        self.kept: Any = None

    @property
    def due(self) -> Any:
        return self.kept

    def set(self) -> None:
        self.kept = self.ctx.tell_after(DAY, Tick())

    def on_start(self, restored: bool) -> None:
        if not restored:
            self.set()

    def on_recovered(self) -> None:
        self.set()


def alarm(kind: type[Alarm] = Alarm, **more: Any) -> hf.ChildSpec[Alarm]:
    return hf.child("patient", hf.start(kind), recovery=hf.hybrid(interval=1e9), **more)


def store_in(folder: Path) -> str:
    folder.mkdir()
    return f"sqlite:{folder}/app.db"


async def left_by(system: hf.ActorSystem, folder: Path) -> str:
    """The store as it lies there if its root dies now."""
    await system._homes.settled()
    return f"sqlite:{killed(system._homes.journal.engine, folder)}/app.db"


@VIRTUAL
@pytest.mark.parametrize("kind", [Alarm, Late])
@pytest.mark.parametrize("sets", [True, False], ids=["exchanged", "cancelled"])
@pytest.mark.parametrize("saved", [True, False], ids=["snapshot", "no snapshot"])
async def test_a_turn_that_cancels_a_timer_and_waits_is_handled_again_by_any_number_of_lives(
    kind: type[Alarm], sets: bool, saved: bool
) -> None:
    """Each life takes a snapshot of the state behind which that turn has begun: its timer is gone, and known."""
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(alarm(kind))
        with system.events() as stream:
            await advance(DAY / 2)
            if saved:
                await system.checkpoint(ref)
            asked = ref.ask(Cancel(sets, waits=True), 9 * DAY)
            for _ in range(4):
                await waits(system)
                await end_of(system, "task")
                await advance(60.0)
            ref.tell(Call())
            assert await asked == 0
            if sets:
                await advance(DAY)
            assert await ref.ask(Ticks()) == sets
            await end_of(system, "task")
            assert await ref.ask(Ticks()) == sets
            assert not [event for event in stream.take() if isinstance(event, hf.events.RecoveryFailed)]


@VIRTUAL
@pytest.mark.parametrize("how", ["it was cancelled", "it has come"])
async def test_a_timer_that_is_over_since_the_snapshot_does_not_come_again(how: str) -> None:
    """The start of the next life wants it, and what has come of it is handled again."""
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(alarm())
        await system.checkpoint(ref)
        if how == "it has come":
            await advance(DAY + 1.0)
        else:
            await ref.ask(Cancel())
        ticks = await ref.ask(Ticks())
        assert ticks == (how == "it has come")
        await end_of(system, "task")
        await advance(3 * DAY)
        assert await ref.ask(Ticks()) == ticks
        await system.checkpoint(ref)
        await end_of(system, "task")
        assert await ref.ask(Ticks()) == ticks


@pytest.mark.parametrize("sets", [True, False], ids=["exchanged", "cancelled"])
@pytest.mark.parametrize("lives", [1, 2])
async def test_the_next_root_finds_the_timers_that_there_were(tmp_path: Path, sets: bool, lives: int) -> None:
    """Of a turn that has ended behind the snapshot, and of one that has begun and waits."""
    first = tmp_path / "1"
    async with hf.ActorSystem("app", log=False, store=store_in(first), intensity=99) as system:
        ref = await system.start(alarm())
        await system.checkpoint(ref)
        await ref.ask(Cancel(sets=True), IN_TIME)
        ref.ask(Cancel(sets, waits=True), IN_TIME).add_done_callback(lambda done: done.exception())
        for _ in range(lives):
            await waits(system)
            await end_of(system, "task")
        await waits(system)
        store = await left_by(system, first)
    async with hf.ActorSystem("app", log=False, store=store, intensity=99) as system:
        ref = await system.start(alarm())
        home = system._homes.at(ref.path)
        assert home is not None
        for _ in range(2):
            await waits(system)
            assert len(home.timers.saved()) == sets
            await end_of(system, "task")
        ref.tell(Call())
        assert await ref.ask(Ticks(), IN_TIME) == 0
        assert len(home.timers.saved()) == sets


async def test_a_group_goes_back_to_the_timers_that_there_were() -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(alarm())
        await system.checkpoint(ref)
        for _ in range(2):
            await ref.ask(Cancel(sets=True), IN_TIME)
        await system.checkpoint_group([ref], name="before")
        await ref.ask(Cancel(), IN_TIME)
        await system.restore_group("before")
        assert await ref.ask(Ticks(), IN_TIME) == 0
        home = system._homes.at(ref.path)
        assert home is not None
        assert len(home.timers.saved()) == 1
        await end_of(system, "task")
        assert await ref.ask(Cancel(sets=True), IN_TIME) == 0


@pytest.mark.parametrize("mechanism", [PBR(), LFR()], ids=["pbr", "lfr"])
async def test_whoever_leads_next_finds_the_timers_that_there_were(mechanism: Any) -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(alarm(mechanism=mechanism))
        await whole(system, ref)
        asked = ref.ask(Cancel(sets=True, waits=True), IN_TIME)
        for _ in range(3):
            await waits(system)
            await leader_dies(system, ref)
            await whole(system, ref)
        ref.tell(Call())
        assert await asked == 0
        assert await ref.ask(Cancel(), IN_TIME) == 0
        home = system._homes.at(ref.path)
        assert home is not None
        assert not home.timers.saved()


class Watcher(hf.Actor):
    """Watches somebody in a turn that waits then."""

    def __init__(self) -> None:
        self.downs = 0

    @hf.on(Cancel)
    async def watch_it(self, message: Cancel) -> int:
        self.ctx.monitor(self.ctx.find("/app/other", Alarm))
        await self.ctx.wait_for(Call)
        return self.downs

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.downs += 1

    @hf.on(Call)
    def call(self, message: Call) -> None: ...

    @hf.on(Ticks)
    def read(self, message: Ticks) -> int:
        return self.downs


async def test_the_next_root_ties_once_what_a_turn_has_tied_that_waits(tmp_path: Path) -> None:
    first = tmp_path / "1"
    specs = [
        hf.child("other", hf.start(Alarm), recovery=hf.hybrid(), restart="temporary"),
        hf.child("patient", hf.start(Watcher), recovery=hf.hybrid(interval=1e9)),
    ]
    async with hf.ActorSystem("app", log=False, store=store_in(first), intensity=99) as system:
        _, ref = [await system.start(spec) for spec in specs]
        assert await ref.ask(Ticks(), IN_TIME) == 0
        ref.ask(Cancel(), IN_TIME).add_done_callback(lambda done: done.exception())
        await waits(system)
        await end_of(system, "task")
        await waits(system)
        await system._homes.settled()
        store = await left_by(system, first)
    async with hf.ActorSystem("app", log=False, store=store, intensity=99) as system:
        _, ref = [await system.start(spec) for spec in specs]
        await waits(system)
        ref.tell(Call())
        assert await ref.ask(Ticks(), IN_TIME) == 0
        await system.stop(system.ref("/app/other", Alarm))
        async with asyncio.timeout(IN_TIME):
            while not await ref.ask(Ticks(), IN_TIME):
                await asyncio.sleep(0.01)
        assert [await ref.ask(Ticks(), IN_TIME) for _ in range(3)] == [1, 1, 1]
