"""Faults of whole processes, in real time: one that is stopped by a signal, and one whose loop is blocked by computing.

`python -m tests.diagnosis.foreign.processes 3` runs so many rounds. A trial takes half a minute, most of it in sleep.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import os
import random
import signal
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import holdfast as hf
from holdfast import diagnosis
from tests.diagnosis.foreign.systems import PATIENCE, Item, Wanted
from tests.diagnosis.foreign.trials import Listener

USUAL = 15.0
"""Seconds of usual traffic."""
WITHIN = 20.0
"""Seconds in which a fault is to be named."""


class Spin(hf.Message): ...


class Read(hf.Message): ...


class Alone(hf.Actor):
    """Lives in a process of its own."""

    @hf.on(Spin)
    def spin(self, message: Spin) -> None:
        while True:
            pass


class Oracle(Alone):
    @hf.on(Wanted)
    def answer(self, message: Wanted) -> int:
        return message.number


class Sensor(Alone):
    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.2, Read())

    @hf.on(Read)
    async def read(self, message: Read) -> None:
        await self.ctx.publish("/readings", Item(0))


class Filter(Alone):
    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe("/readings")

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        await self.ctx.publish("/filtered", message)


class Asker(hf.Actor):
    @hf.subscribe("/filtered")
    @hf.on(Item)
    async def take(self, message: Item) -> None:
        await self.ctx.find("/app/all/oracle", Oracle).ask(Wanted(message.number), timeout=PATIENCE)
        await self.ctx.publish("/answers", message)


class Sink(hf.Actor):
    @hf.subscribe("/answers")
    @hf.on(Item)
    def take(self, message: Item) -> None: ...


ALONE: dict[str, type[Alone]] = {"oracle": Oracle, "sensor": Sensor, "filter": Filter}


class ProcessTrial(NamedTuple):
    """Whose process is struck by what, and who was named first after how many seconds; "": nobody in time."""

    who: str
    kind: str
    first: tuple[str, ...] = ()
    seconds: float = float("inf")
    is_alarm: bool = False


async def strike(who: str, kind: str, seed: int) -> ProcessTrial:
    """Let the system run, and strike one of its processes."""
    said: list[tuple[float, Any]] = []
    loop, rng = asyncio.get_running_loop(), random.Random(seed)
    children: list[hf.ChildSpec] = [
        hf.child(name, hf.start(alone), isolation="process") for name, alone in ALONE.items()
    ]
    children += [hf.child("asker", hf.start(Asker)), hf.child("sink", hf.start(Sink))]
    async with hf.ActorSystem("app", log=False, seed=seed) as system:
        await system.start(hf.supervisor("all", children=children, intensity=1000, period=5.0))
        system.spawn(hf.start(Listener, said))
        await diagnosis.watch(system, seconds=3.0)
        await asyncio.sleep(USUAL + rng.random())
        is_alarm, began = bool(said), loop.time()
        said.clear()
        struck = system.ref(f"/app/all/{who}", ALONE[who])
        pid = (await system.get_status(struck)).pid
        if kind == "stopped":
            os.kill(pid, signal.SIGSTOP)
        else:
            struck.tell(Spin())
        while not said and loop.time() < began + WITHIN:
            await asyncio.sleep(0.05)
        os.kill(pid, signal.SIGKILL)
    if not said:
        return ProcessTrial(who, kind, is_alarm=is_alarm)
    at, first = said[0]
    names = tuple(name.rpartition("/")[2] for name in first.candidates[0].bad)
    return ProcessTrial(who, kind, names, at - began, is_alarm)


def struck(who: str, kind: str, seed: int) -> ProcessTrial:
    """Run one trial in a loop of its own."""
    return asyncio.run(strike(who, kind, seed))


def main(arguments: list[str] | None = None) -> int:
    """Run the rounds that were asked for. Returns the exit status."""
    parser = argparse.ArgumentParser(description="faults of whole processes, in real time")
    parser.add_argument("rounds", type=int)
    parser.add_argument("--jobs", type=int, default=2, help="systems at a time")
    options = parser.parse_args(arguments)
    cases = list(itertools.product(ALONE, ("stopped", "spins"), range(options.rounds)))
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        done = list(pool.map(struck, *zip(*cases, strict=True)))
    right = [one for one in done if one.first == (one.who,) and not one.is_alarm]
    print(*done, f"{len(done)} faults, {len(right)} named first", sep="\n")
    return 0 if len(right) >= 0.95 * len(done) else 1


if __name__ == "__main__":
    sys.exit(main())
