"""The fork server is killed again and again under load, beside everything else that has processes.

HOLDFAST_FORK_KILLS=30: so many kills (2 if left out), at moments drawn by HOLDFAST_SEED; each second one of three is
followed by another one at once, that strikes while processes are being started.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections import Counter
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import ChildRestarted, MessageQuarantined, SupervisorGaveUp
from tests.actors.process.fork_players import Effecting, Taken, Tally, Tallying
from tests.actors.process.waiting import until

KILLS = int(os.environ.get("HOLDFAST_FORK_KILLS", "2"))
SEED = int(os.environ.get("HOLDFAST_SEED", "1"))
ACTORS = 20
PERIOD = 5.0
"""Seconds in which the supervisors allow three restarts: two kills in a row, and one before."""


class Load:
    """Clients that ask one after another, and what they were answered."""

    def __init__(self) -> None:
        self.is_on = True
        self.counts = Counter[str]()
        self.last: dict[str, int] = {}
        self.failed: list[str] = []

    async def ask(self, ref: hf.ActorRef[hf.Actor]) -> None:
        number = 0
        while self.is_on:
            number += 1
            assert await ref.ask(Tally(number), timeout=60.0) == number, f"{ref.path}: lost or doubled"
            self.counts["answered"] += 1
            self.last[ref.path] = number

    async def begin(self, top: hf.ActorRef[hf.Supervisor], worker: int) -> None:
        """Start children in processes, and stop them: a first start may meet the end of the fork server."""
        number = 0
        while self.is_on:
            name, number = f"w{worker}-{number}", number + 1
            try:
                ref = await top.ask(
                    hf.StartChild(hf.child(name, hf.start(Tallying), isolation="process", recovery=hf.hybrid())),
                    timeout=60.0,
                )
                assert await ref.ask(Tally(1), timeout=60.0) == 1
                await top.ask(hf.TerminateChild(name), timeout=60.0)
            except hf.StartFailed as error:
                self.counts["a first start failed"] += 1
                self.failed.append(str(error))
            else:
                self.counts["started and stopped"] += 1


@pytest.mark.asyncio(loop_factories=["uvloop", "asyncio"] if KILLS > 2 else ["uvloop"])
async def test_nothing_is_lost_and_nobody_gives_up() -> None:
    draw, load = random.Random(SEED), Load()
    method = hf.hybrid()
    async with hf.ActorSystem("app", log=False, period=PERIOD) as system:
        refs: list[hf.ActorRef[Any]] = [
            await system.start(hf.child(f"a{n}", hf.start(Tallying), isolation="process", recovery=method))
            for n in range(ACTORS)
        ]
        refs += [
            await system.start(hf.child(f"g{n}", hf.start(Tallying), mechanism=hf.ftm.PBR(), recovery=method))
            for n in range(2)
        ]
        refs += [
            await system.start(hf.child(f"e{n}", hf.start(Effecting), isolation="process", recovery=method))
            for n in range(2)
        ]
        for n in range(2):
            below = [hf.child(f"s{m}", hf.start(Tallying), recovery=method) for m in range(4)]
            await system.start(hf.supervisor(f"t{n}", isolation="process", children=below))
            refs += [system.ref(f"/app/t{n}/s{m}", Tallying) for m in range(4)]
        top = await system.start(hf.dynamic("come", intensity=3, period=PERIOD))
        with system.events() as events:
            tasks = [asyncio.ensure_future(load.ask(ref)) for ref in refs]
            tasks += [asyncio.ensure_future(load.begin(top, n)) for n in range(2)]
            for kill in range(KILLS):
                before, server = load.counts["answered"], system._workers._server
                assert server is not None
                os.kill(server.pid, signal.SIGKILL)
                if kill % 3 == 1:
                    await until(lambda known=server: system._workers._server not in (None, known))  # type: ignore[misc]
                    again = system._workers._server
                    assert again is not None
                    await asyncio.sleep(draw.uniform(0.0, 0.2))
                    os.kill(again.pid, signal.SIGKILL)
                pause = PERIOD if kill % 3 == 1 else 0.8 * PERIOD
                await asyncio.sleep(draw.uniform(pause, pause + 2.0))
                await until(lambda before=before: load.counts["answered"] > before)  # type: ignore[misc]
                assert system._workers._server is not None
            load.is_on = False
            await asyncio.gather(*tasks)
            seen = events.take()
        for ref in refs:
            assert await ref.ask(Taken(), timeout=60.0) == list(range(1, load.last[ref.path] + 1)), ref.path
    assert not [event for event in seen if isinstance(event, (SupervisorGaveUp, MessageQuarantined))]
    assert all("fork server" in why for why in load.failed), load.failed
    restarts = Counter(str(event.reason).partition(" (")[0] for event in seen if isinstance(event, ChildRestarted))
    print(f"{KILLS} kills, seed {SEED}: {dict(load.counts)}, restarts: {dict(restarts)}")
