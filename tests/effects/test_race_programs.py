"""Random programs of races while their lives and the whole program are killed: each later life goes the same way.

`HOLDFAST_RACES=1000` has so many seeds of each kind; `HOLDFAST_SEED` is the first one.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import re
from collections import Counter
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, simulate
from tests.effects.race_player import WORLD, Helper, Play, Player, Ring, Told

FIRST = int(os.environ.get("HOLDFAST_SEED", "1"))
RACES = int(os.environ.get("HOLDFAST_RACES", "5"))
SEEDS = range(FIRST, FIRST + RACES)
NUMBERS = 6
STRIKES = 8
PAUSES = (0.0, 0.01, 0.02, 0.05, 0.3)
IN_TIME = 100.0
"""Virtual seconds in which all is done."""
METHOD = hf.hybrid(interval=0.05, max_deliveries=1000)


class Show:
    """One player, who plays one program after another; who rings; and who kills.

    Args:
        system: where it plays.
        simulation: of it.
        seed: draws the programs, and what befalls them.
        isolation: where the player lives.
    """

    def __init__(self, system: GuardedSystem, simulation: Simulation, seed: int, isolation: Any) -> None:
        self.system: hf.ActorSystem = system
        self.simulation, self.seed, self.isolation = simulation, seed, isolation
        self.draw = random.Random(f"show {seed}")
        self.answers: dict[int, list[str]] = {}
        self.accepted: set[int] = set()
        self.unsure: set[int] = set()
        self.is_over = False

    async def plant(self) -> None:
        """Give the program its tree."""
        for name in ("helper", "ledger"):
            await self.system.start(hf.child(name, hf.start(Helper), recovery=METHOD))
        bindings = {"helper": "/app/helper", "ledger": "/app/ledger"}
        player = hf.start(Player, self.seed)
        spec = hf.child("player", player, recovery=METHOD, isolation=self.isolation, bindings=bindings)
        self.player = await self.system.start(spec)

    async def play(self) -> None:
        """Have all programs played; one that nobody answers is asked for again."""
        for n in range(NUMBERS):
            while n not in self.answers:
                try:
                    self.answers[n] = await self.player.ask(Play(n), timeout=IN_TIME)
                except hf.HoldfastError:
                    await asyncio.sleep(0.02)
        self.is_over = True

    async def ring(self) -> None:
        """Ring now and then; each ring has a number."""
        number = 0
        while not self.is_over:
            number += 1
            try:
                await self.player.send(Ring(number))
                self.accepted.add(number)
            except hf.HoldfastError:
                self.unsure.add(number)
            await asyncio.sleep(self.draw.choice(PAUSES))

    async def strike(self) -> None:
        """Kill the player, restart it in good order or have it live elsewhere, and now and then kill the program."""
        for _ in range(STRIKES):
            await asyncio.sleep(self.draw.choice(PAUSES))
            if self.is_over:
                return
            how = self.draw.choice(("kill", "kill", "crash") if self.seed % 2 else ("kill", "restart", "move", "crash"))
            if how == "kill":
                self.player.kill()
            elif how == "crash":
                self.system = await self.simulation.crash_root()
                await self.plant()
            else:
                with contextlib.suppress(hf.HoldfastError):  # It is being restarted, or the turn does not end in time.
                    await self.change(how)

    async def change(self, how: str) -> None:
        """Restart the player in good order, or have it live in a process or as a task."""
        if how == "restart":
            await self.system.ref("/app", hf.Supervisor).ask(hf.RestartChild("player", running=True), timeout=5.0)
        else:
            place: Any = self.draw.choice(("task", "process"))
            await self.system.set_isolation(self.player, place, timeout=2.0)

    async def judge(self) -> None:
        """Compare what was said to everybody, and to whom which ring went."""
        told = await self.player.ask(Told(), timeout=IN_TIME)
        steps = (await self.system.ref("/app/ledger", Helper).ask(Told(), timeout=IN_TIME))["steps"]
        done = [(n, said) for n, said in told["done"]]
        assert dict(done) == self.answers
        written: dict[int, list[str]] = {}
        for n, index, said in steps:
            written.setdefault(n, []).append(said)
            assert len(written[n]) == index + 1, f"step {index} of {n} is lost or there twice"
        assert [*written] == [n for n, _ in done]
        for n, said in done:
            assert said[: len(written[n])] == written[n]
        words = " ".join(word for _, said in done for word in said)
        rings = Counter([int(number) for number in re.findall(r"ring (\d+)", words)] + told["rang"])
        assert max(rings.values(), default=1) == 1, f"heard twice: {rings}"
        assert self.accepted <= rings.keys() <= self.accepted | self.unsure, f"lost: {self.accepted - rings.keys()}"
        assert all(WORLD[effect] for effect in re.findall(r"e[\d.]+", words))


def race(seed: int, isolation: str, schedule: dict[str, Any]) -> None:
    """One show under one schedule."""

    @simulate(store="simulated", durability="fsync", sync=(0.0, 0.01), intensity=10_000, **schedule)
    async def show(system: GuardedSystem, simulation: Simulation) -> None:
        system.expect_crashes()
        system.expect_exceptions()  # A wait that is left behind may end in WaitTimeout.
        WORLD.clear()
        one = Show(system, simulation, seed, isolation)
        await one.plant()
        async with asyncio.timeout(IN_TIME):
            await asyncio.gather(one.play(), one.ring(), one.strike())
        await one.judge()

    show()


@pytest.mark.parametrize("isolation", ["task", "process"])
def test_every_life_goes_the_same_way(isolation: str) -> None:
    for seed in SEEDS:
        race(seed, isolation, {"replay": f"seed={seed}"})


@pytest.mark.parametrize("isolation", ["task", "process"])
def test_so_it_does_in_any_order_of_steps(isolation: str) -> None:
    for seed in SEEDS:
        race(seed, isolation, {"seed": seed})
