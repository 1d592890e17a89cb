"""Transactions at random moments of random races: what is in force is what runs, and a kill changes nothing.

Steps: other code, another state, another place, mechanisms, another binding; several in one transaction. Lives and the
whole program are killed besides. `HOLDFAST_CHANGES=1000` has so many seeds of each kind; `HOLDFAST_FIRST` is the first.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import random
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, simulate
from tests.effects.change_player import GENERATIONS, First, Who, marked
from tests.effects.race_player import WORLD, Helper, Play, Ring, Told

FIRST = int(os.environ.get("HOLDFAST_FIRST", "1"))
CHANGES = int(os.environ.get("HOLDFAST_CHANGES", "4"))
SEEDS = range(FIRST, FIRST + CHANGES)
NUMBERS = 5
STEPS = ("code", "state", "place")
KINDS = (*STEPS, "bind")
FOUND = {
    "turn_ended": (15, "process", KINDS),
    "life_ended": (21, "process", KINDS),
    "state_saved": (19, "process", STEPS),
    "group_ended": (101, "task", KINDS),
}
"""What has gone wrong when a change came to a player: a seed of it, where it lived, and the kinds of steps."""
PAUSES = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.3)
LATENCY = (0.0, 0.02)
"""Seconds that a word to or from a process takes."""
IN_TIME = 100.0
"""Virtual seconds in which an answer comes."""
METHOD = hf.hybrid(interval=0.1, max_deliveries=1000)
PLAYER = "/app/player"
KILLED = "cannot be moved: it is killed"
"""What may become of a move: the next life begins where the spec says."""
BAD = (hf.events.SupervisorGaveUp, hf.events.MessageQuarantined)


class Force:
    """What is in force for the player, as far as transactions have said that it is."""

    def __init__(self, isolation: Any) -> None:
        self.by, self.isolation, self.helper = "first", isolation, "helper"
        self.marks: list[int] = []
        self.is_protected = False

    @property
    def told(self) -> dict[str, Any]:
        return {"by": self.by, "marks": self.marks}


class Show:
    """One player, who plays one program after another; who rings, who kills, and who changes the player.

    Args:
        system: where it plays.
        simulation: of it.
        seed: draws the programs, and what befalls them.
        isolation: where the player lives at first.
        kinds: of steps.
    """

    def __init__(
        self, system: GuardedSystem, simulation: Simulation, seed: int, isolation: Any, kinds: tuple[str, ...]
    ) -> None:
        self.system: hf.ActorSystem = system
        self.simulation, self.seed, self.declared, self.kinds = simulation, seed, isolation, kinds
        self.draw = random.Random(f"changes {seed}")
        self.force = Force(isolation)
        self.may_kill = asyncio.Event()
        self.number = 0
        self.said: list[str] = []
        self.is_over = False

    async def plant(self) -> None:
        """Give the program its tree."""
        for name in ("helper", "other", "ledger"):
            await self.system.start(hf.child(name, hf.start(Helper), recovery=METHOD))
        bindings = {"helper": "/app/helper", "ledger": "/app/ledger"}
        start = hf.start(First, self.seed)
        spec = hf.child("player", start, recovery=METHOD, isolation=self.declared, bindings=bindings)
        self.stream = self.system.events()
        self.player = await self.system.start(spec)

    async def play(self) -> None:
        """Have all programs played; one that nobody answers is asked for again."""
        for n in range(NUMBERS):
            while True:
                try:
                    await self.player.ask(Play(n), timeout=IN_TIME)
                    break
                except hf.HoldfastError:
                    self.look()
                    await asyncio.sleep(0.02)
        self.is_over = True

    async def ring(self) -> None:
        while not self.is_over:
            with contextlib.suppress(hf.HoldfastError):
                self.player.tell(Ring(0))
            await asyncio.sleep(self.draw.choice(PAUSES))

    def look(self) -> list[Any]:
        """What has happened since; nothing of it may be bad."""
        events = self.stream.take()
        bad = [one for one in events if isinstance(one, BAD) or "diverged" in str(one)]
        assert not bad, f"{self.said}: {bad}"
        return events

    # -- changes ------------------------------------------------------------------------------------------------------

    def steps(self) -> list[str]:
        if self.force.is_protected:
            return ["bare"]
        kinds = self.draw.sample(self.kinds, self.draw.choice((1, 1, 2, 3)))
        return ["protect"] if self.draw.random() < 0.15 else kinds

    async def change(self) -> None:
        """Change the player again and again, at random moments of its turns."""
        while not self.is_over:
            await asyncio.sleep(self.draw.choice(PAUSES))
            steps, wanted = self.steps(), Force(self.force.isolation)
            wanted.__dict__.update(self.force.__dict__)
            killer = asyncio.create_task(self.kill()) if self.draw.random() < 0.3 else None
            self.said.append(" ".join(steps) + " killed" * (killer is not None))
            try:
                async with self.system.transaction(timeout=20.0) as change:
                    for step in steps:
                        self.add(change, step, wanted)
            except hf.errors.TransactionFailed:
                self.look()  # Its life has ended, or a turn has not: nothing is changed.
            else:
                self.force = wanted
                committed = [one for one in self.look() if isinstance(one, hf.events.TransactionCommitted)]
                problems = [text for one in committed for text in one.problems if killer is None or KILLED not in text]
                assert not problems, f"{self.said}: {problems}"
            if killer is not None:
                await killer
            if self.draw.random() < 0.5:
                await self.judge()
            if self.draw.random() < 0.2 and not self.force.is_protected:
                await self.crash()

    def add(self, change: Any, step: str, wanted: Force) -> None:
        match step:
            case "code":
                wanted.by = "second" if wanted.by == "first" else "first"
                change.replace_code(PLAYER, GENERATIONS[wanted.by])
            case "state":
                self.number += 1
                wanted.marks = [*wanted.marks, self.number]
                change.replace_state(PLAYER, functools.partial(marked, self.number))
            case "place":
                wanted.isolation = "task" if wanted.isolation == "process" else "process"
                change.isolation(PLAYER, wanted.isolation)
            case "bind":
                wanted.helper = "other" if wanted.helper == "helper" else "helper"
                change.bind(PLAYER, "helper", f"/app/{wanted.helper}")
            case "protect":
                wanted.is_protected = True
                change.protect(PLAYER, hf.ftm.PBR())
            case _:
                wanted.is_protected = False
                change.protect(PLAYER, None)

    async def kill(self) -> None:
        await asyncio.sleep(self.draw.choice(PAUSES))
        self.player.kill()

    async def crash(self) -> None:
        """Kill the program, unless a replay might go through a binding of before (see `docs/guarantees.md`)."""
        if any("bind" in steps for steps in self.said):
            return
        self.said.append("crash")
        self.system = await self.simulation.crash_root()
        await self.plant()

    async def judge(self) -> None:
        """What is in force is what runs, now and in the next life."""
        for is_next in (False, True):
            if is_next:
                self.player.kill()
            told = await self.who()
            del told["done"]
            assert told == self.force.told, f"{self.said}, {'killed' if is_next else 'alive'}"
            status = await self.system.get_status(self.player)
            assert status.kind.endswith(f".{GENERATIONS[self.force.by].__name__}"), f"{self.said}: {status}"
            assert status.bindings["helper"] == f"/app/{self.force.helper}", f"{self.said}: {status}"

    async def who(self) -> dict[str, Any]:
        while True:
            try:
                return await self.player.ask(Who(), timeout=IN_TIME)
            except hf.HoldfastError:
                self.look()
                await asyncio.sleep(0.02)

    async def judge_all(self) -> None:
        """Each program is over once, and has told so as often."""
        await self.judge()
        assert (await self.who())["done"] == list(range(NUMBERS))
        steps = (await self.system.ref("/app/ledger", Helper).ask(Told(), timeout=IN_TIME))["steps"]
        ends = [n for n, _, said in steps if said.startswith("by ")]
        assert ends == list(range(NUMBERS)), f"{self.said}: {steps}"
        self.look()


def change(seed: int, isolation: str, schedule: dict[str, Any], kinds: tuple[str, ...] = KINDS) -> None:
    """One show under one schedule."""
    print(f"HOLDFAST_FIRST={seed} {isolation} {schedule}")

    @simulate(store="simulated", durability="fsync", sync=(0.0, 0.01), latency=LATENCY, intensity=10_000, **schedule)
    async def show(system: GuardedSystem, simulation: Simulation) -> None:
        system.expect_crashes()
        system.expect_exceptions()  # A wait that is left behind may end in WaitTimeout.
        system.expect_dead_letters()  # What a mechanism that is taken away has told itself.
        WORLD.clear()
        one = Show(system, simulation, seed, isolation, kinds)
        await one.plant()
        async with asyncio.timeout(IN_TIME * 10):
            await asyncio.gather(one.play(), one.ring(), one.change())
        await one.judge_all()

    show()


@pytest.mark.parametrize("isolation", ["task", "process"])
def test_what_is_in_force_is_what_runs(isolation: str) -> None:
    for seed in SEEDS:
        change(seed, isolation, {"replay": f"seed={seed}"})


@pytest.mark.parametrize("isolation", ["task", "process"])
def test_so_it_is_in_any_order_of_steps(isolation: str) -> None:
    for seed in SEEDS:
        change(seed, isolation, {"seed": seed})


@pytest.mark.parametrize("what", FOUND)
def test_what_was_found_stays_mended(what: str) -> None:
    seed, isolation, kinds = FOUND[what]
    change(seed, isolation, {"seed": seed}, kinds)
