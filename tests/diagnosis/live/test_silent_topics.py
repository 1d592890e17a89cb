"""A quick topic that goes by a clock falls silent: that is seen, whatever has happened to it a moment before."""

import asyncio
import subprocess
import sys
import time
from pathlib import Path

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.observers import Baselines
from holdfast.diagnosis.own_time import OwnTime

PAUSE = 0.05


class Reading(hf.Message):
    number: int


class Boom(hf.Message): ...


class Source(hf.Actor):
    @hf.on(Reading)
    async def read(self, message: Reading) -> None:
        await self.ctx.publish("/t", message)

    @hf.on(Boom)
    def crash(self, message: Boom) -> None:
        raise RuntimeError("boom")


class User(hf.Actor):
    @hf.subscribe("/t")
    @hf.on(Reading)
    def take(self, message: Reading) -> None: ...


class Deafen(hf.Message): ...


class Filter(hf.Actor):
    """Publishes what it hears, and what it is told."""

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe("/t")

    @hf.on(Reading)
    async def take(self, message: Reading) -> None:
        await self.ctx.publish("/out", message)

    @hf.on(Deafen)
    def deafen(self, message: Deafen) -> None:
        self.ctx.unsubscribe("/t")


class OutUser(hf.Actor):
    @hf.subscribe("/out")
    @hf.on(Reading)
    def take(self, message: Reading) -> None: ...


async def feed(source: hf.ActorRef[Source], seconds: float) -> None:
    loop = asyncio.get_running_loop()
    until, number = loop.time() + seconds, 0
    while loop.time() < until:
        source.tell(Reading(number := number + 1))
        await asyncio.sleep(PAUSE)


async def started(system: hf.ActorSystem) -> hf.ActorRef[Source]:
    await system.start(hf.child("user", hf.start(User)))
    return await system.start(hf.child("source", hf.start(Source)))


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize(
    "event", ["nothing", "gap 0.15", "gap 0.5", "gap 0.5, burst", "crash", "crash, gap 0.5", "burst"]
)
async def test_that_a_quick_topic_falls_silent_is_seen_soon_after(event: str) -> None:
    async with hf.ActorSystem("t", log=False, seed=1, intensity=20) as system:
        source = await started(system)
        before = asyncio.create_task(feed(source, 15.0))
        await asyncio.sleep(1.0)
        watching = await diagnosis.watch(system, repair="off")
        await before
        if "crash" in event:
            source.tell(Boom())
            await asyncio.sleep(0.05)
        if "gap" in event:
            await asyncio.sleep(float(event.partition("gap ")[2].partition(",")[0]))
        if "burst" in event:
            for number in range(20):
                source.tell(Reading(number))
        after = asyncio.create_task(feed(source, 13.0))
        while not after.done():
            assert (await watching.diagnosis()).state is not State.FAULTY
            await asyncio.sleep(0.1)
        await asyncio.sleep(6.0)
        assert [one.bad for one in (await watching.diagnosis()).candidates] == [("source",)]


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("goes_on", [False, True])
async def test_who_has_lost_its_input_is_named_and_who_does_without_is_not(goes_on: bool) -> None:
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        source = await started(system)
        outside = await system.start(hf.child("filter", hf.start(Filter)))
        await system.start(hf.child("out", hf.start(OutUser)))
        watching = await diagnosis.watch(system, repair="off")
        for number in range(60):  # In bursts: it goes by no clock.
            for _ in range(1 + number % 7):
                source.tell(Reading(number))
            await asyncio.sleep(0.2 + number % 3)
        outside.tell(Deafen())
        if goes_on:
            await asyncio.sleep(2.0)
            outside.tell(Reading(0))
        for number in range(60):
            source.tell(Reading(number))
            await asyncio.sleep(0.5)
        assert (await watching.diagnosis()).certain == (() if goes_on else ("filter",))


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_time_in_which_the_loop_itself_was_late_is_no_silence_of_a_topic() -> None:
    async with hf.ActorSystem("t", log=False) as system:
        source, baselines = await started(system), Baselines()
        before = asyncio.create_task(feed(source, 3.0))
        await diagnosis.watch(system, repair="off", seconds=0.5, baselines=baselines)
        await before
        time.sleep(1.5)  # Nobody in this process has a turn.
        await feed(source, 1.0)
        assert 0.0 < baselines.of("/t", 0.0).longest_gap < 0.75


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_whoever_asks_first_behind_a_late_loop_is_told_the_time_without_that() -> None:
    own = OwnTime(asyncio.get_running_loop())
    kept = asyncio.create_task(own.keep())
    await asyncio.sleep(0.05)
    before = own.now()
    time.sleep(1.0)
    assert 0.0 <= own.now() - before < 0.5
    kept.cancel()


WATCHED = """
import asyncio, sys, time
import holdfast as hf
from holdfast import diagnosis

class One(hf.Actor): ...

async def main():
    async with hf.ActorSystem("t", log=False) as system:
        await system.start(hf.child("one", hf.start(One)))
        began = time.thread_time(), time.process_time()
        await diagnosis.watch(system, seconds=0.0)
        print((time.thread_time() - began[0]) / (time.process_time() - began[1]))

asyncio.run(main())
"""


def test_watch_computes_beside_the_loop(tmp_path: Path) -> None:
    """The first one in a program reads the language of the actions, which takes some tenths of a second."""
    file = tmp_path / "watched.py"
    file.write_text(WATCHED)
    done = subprocess.run([sys.executable, str(file)], capture_output=True, text=True, check=True, timeout=60.0)
    assert float(done.stdout) < 0.5
