"""Random turns that wait behind every mechanism, with more asks behind them, while replicas die and mechanisms change.

`HOLDFAST_WAITS=1000` has so many seeds of each kind; `HOLDFAST_FIRST` is the first one. (`HOLDFAST_SEED` is that of all
schedules, as everywhere.)
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
from collections import Counter
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm import AD, LFR, NVP, PBR, RB, TMR, TR
from holdfast.testing import GuardedSystem, Simulation, simulate
from tests.effects.patient import Call, Count, Go
from tests.effects.race_player import WORLD, act

FIRST = int(os.environ.get("HOLDFAST_FIRST", "1"))
WAITS = int(os.environ.get("HOLDFAST_WAITS", "2"))
SEEDS = range(FIRST, FIRST + WAITS)
ASKS = 10
STRIKES = 6
PAUSES = (0.0, 0.0, 0.01, 0.05, 0.3)
IN_TIME = 300.0
"""Virtual seconds in which all is done."""
BAD = (
    hf.events.RecoveryFailed,
    hf.events.MessageQuarantined,
    hf.events.SupervisorGaveUp,
    hf.events.RequestsDropped,
    hf.events.Diverged,
)


class Peek(hf.Message[int]):
    """Look at how many turns have ended; nothing is changed by it."""


class Tale(hf.Message[dict[str, list[Any]]]):
    """Tell all that has happened."""


class Walker(hf.Actor):
    """Its turns sleep, wait and have effects, and count their steps in its state."""

    def __init__(self) -> None:
        self.steps = 0
        self.done: list[str] = []
        self.missed: list[str] = []

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        said: list[str] = []
        for index, step in enumerate(message.steps):
            match step:
                case "sleep":
                    await self.ctx.sleep(0.02)
                case "wait":
                    said.append(f"call {(await self.ctx.wait_for(Call)).word}")
                case _:
                    said.append(await self.ctx.effect(act, f"{message.file}.{index}", 0.02, key=f"{index}"))
            self.steps += 1
        self.done.append(f"{message.file}: {', '.join(said)}")
        return self.done[-1]

    @hf.on(Call)
    def call(self, message: Call) -> None:
        self.missed.append(message.word)

    @hf.on(Count)
    def count(self, message: Count) -> int:
        self.done.append(f"{len(self.done)} before")
        return len(self.done)

    @hf.on(Peek, readonly=True)
    def peek(self, message: Peek) -> int:
        return len(self.done)

    @hf.on(Tale)
    def tale(self, message: Tale) -> dict[str, list[Any]]:
        return {"done": self.done, "missed": self.missed, "steps": [self.steps]}


class Runner(Walker):
    """Another version of it."""


def is_accepted(reply: object) -> bool:
    return reply is not None


STACKS: dict[str, tuple[Any, ...] | None] = {
    "none": None,
    "pbr": (PBR(),),
    "lfr": (LFR(),),
    "tmr": (TMR(),),
    "tr": (TR(),),
    "rb": (RB(alternates=(Runner,), test=(is_accepted,)),),
    "nvp": (NVP(versions=(Runner, Runner)),),
    "ad + pbr": (AD(assertions=(is_accepted,)), PBR()),
    "ad + lfr": (AD(assertions=(is_accepted,)), LFR()),
    "pbr + tr": (PBR(), TR()),
    "lfr + tr": (LFR(), TR()),
}

LASTING = [name for name in STACKS if name.partition(" ")[0] in ("pbr", "lfr", "tmr", "ad")]
"""Those with more than one replica: they keep an actor without recovery."""


class Stroll:
    """One walker, who is asked more than it can do at once; who calls it; and what befalls it.

    Args:
        system: where it walks.
        simulation: of it.
        seed: draws what it is asked, and what befalls it.
        stack: the mechanisms that it has first.
        recovery: of it.
    """

    def __init__(self, system: GuardedSystem, simulation: Simulation, seed: str, stack: str, recovery: Any) -> None:
        self.system, self.simulation, self.stack, self.recovery = system, simulation, stack, recovery
        self.draw = random.Random(seed)
        self.asked: list[tuple[Any, asyncio.Future[Any]]] = []
        self.accepted: list[str] = []
        self.is_over = False

    async def start(self) -> None:
        spec = hf.child("walker", hf.start(Walker), recovery=self.recovery, mechanism=STACKS[self.stack])
        self.walker = await self.system.start(spec)

    async def ask(self) -> None:
        """Ask one thing after the other, and wait for no answer before the last one."""
        for number in range(ASKS):
            message: Any = self.draw.choice((Count(), Peek(), None, None))
            if message is None:
                steps: list[str] = self.draw.choices(("sleep", "wait", "effect"), k=self.draw.randint(1, 5))
                message = Go(steps, f"walk {number}")
            self.asked.append((message, asyncio.ensure_future(self.walker.ask(message, IN_TIME))))
            await asyncio.sleep(self.draw.choice(PAUSES))
        await asyncio.gather(*(answer for _, answer in self.asked))
        self.is_over = True

    async def call(self) -> None:
        """Call now and then; each call has a number."""
        while not self.is_over:
            await asyncio.sleep(self.draw.choice(PAUSES) + 0.1)
            self.accepted.append(str(len(self.accepted)))
            await self.walker.send(Call(self.accepted[-1]))

    async def strike(self) -> None:
        """Let something befall it, a few times."""
        for _ in range(STRIKES):
            await asyncio.sleep(self.draw.choice(PAUSES))
            if self.is_over:
                return
            match self.draw.choice(("leader", "follower", "change", "change", "suspend")):
                case "change":
                    self.stack = self.draw.choice(LASTING if self.recovery is None else [*STACKS])
                    with contextlib.suppress(hf.TransactionFailed):  # An effect may keep it waiting too long.
                        async with self.system.transaction(timeout=self.draw.choice((0.1, 20.0))) as changes:
                            changes.protect(self.walker, STACKS[self.stack])
                case "suspend":
                    await self.system.suspend(self.walker)
                    await asyncio.sleep(self.draw.choice(PAUSES))
                    await self.system.resume(self.walker)
                case which:
                    await self.kill(leads=which == "leader")

    async def kill(self, *, leads: bool) -> None:
        """Kill a replica, if another one could go on, or what it has is kept."""
        now = await self.system.protection(self.walker)
        others = [one for one in now.replicas if one != now.leader]
        if now.is_whole and (others or (leads and self.recovery is not None)) and now.leader is not None:
            name = now.leader if leads else self.draw.choice(others)
            self.simulation.kill_process(self.system.ref(f"{self.walker.path}/ftm/{name}", hf.Actor))
            while (await self.system.protection(self.walker)).is_whole:  # Its death is not known yet.
                await asyncio.sleep(0.001)

    async def judge(self) -> None:
        """Each turn has come once, and in order; each call was heard once; all that was said was done."""
        tale = await self.walker.ask(Tale(), IN_TIME)
        turns, before = list[str](), 0
        for message, answer in self.asked:
            if isinstance(message, Peek):
                assert 0 <= answer.result() <= before, "it has seen a turn that had not come yet"
                continue
            before += 1
            turns.append(f"{before - 1} before" if isinstance(message, Count) else answer.result())
            assert isinstance(message, Go) or answer.result() == before
        assert tale["done"] == turns, f"{tale['done']} is not {turns}"
        walks = [message for message, _ in self.asked if isinstance(message, Go)]
        assert tale["steps"] == [sum(len(one.steps) for one in walks)], "a turn has counted more than once, or less"
        words = [word for turn in turns if ": " in turn for word in turn.partition(": ")[2].split(", ") if word]
        calls = [word.removeprefix("call ") for word in words if word.startswith("call ")]
        heard = Counter(calls + tale["missed"])
        assert heard == Counter(self.accepted), f"a call is lost, or was heard twice: {heard}"
        effects = [f"{one.file}.{k}" for one in walks for k, step in enumerate(one.steps) if step == "effect"]
        assert [word for word in words if not word.startswith("call ")] == effects
        assert all(WORLD[effect] for effect in effects)


def stroll(seed: int, stack: str, recovery: Any, *, schedule: int | None = None) -> None:
    """One walk under one schedule, that of the same seed if no other one is given."""

    @simulate(latency=(0.0, 0.005), intensity=10_000, seed=seed if schedule is None else schedule)
    async def walk(system: GuardedSystem, simulation: Simulation) -> None:
        system.expect_crashes()
        system.expect_exceptions()  # Of asks between the parts of a group, one of which was killed.
        system.expect_dead_letters()  # They are such asks, too.
        WORLD.clear()
        one = Stroll(system, simulation, f"{stack} {seed}", stack, recovery)
        await one.start()
        with system.events() as stream:
            async with asyncio.timeout(IN_TIME):
                await asyncio.gather(one.ask(), one.call(), one.strike())
            await one.judge()
            found = [str(event) for event in stream.take() if isinstance(event, BAD)]
            assert not found, found

    walk()


@pytest.mark.parametrize("stack", STACKS)
def test_all_that_is_asked_comes_in_order(stack: str) -> None:
    for seed in SEEDS:
        stroll(seed, stack, hf.hybrid(interval=0.05, max_deliveries=1000))


FOUND = (("ad + pbr", 3), ("pbr + tr", 3), ("lfr + tr", 6), ("tr", 10), ("nvp", 15), ("ad + lfr", 29))
"""A follower did not get again what it had left; or the home gave up what a turn that had moved away waited for; or
what was said before the mechanisms changed was refused behind that, and an outcome waited for it for ever.
"""


@pytest.mark.parametrize(("stack", "seed"), FOUND)
def test_what_was_found_comes_in_order(stack: str, seed: int) -> None:
    stroll(seed, stack, hf.hybrid(interval=0.05, max_deliveries=1000))


@pytest.mark.parametrize("stack", LASTING)
def test_so_it_does_without_recovery(stack: str) -> None:
    for seed in SEEDS:
        stroll(seed, stack, None)


@pytest.mark.parametrize("stack", STACKS)
def test_who_rests_is_stopped_at_once_and_rests_on_in_its_next_life(stack: str) -> None:
    @simulate(latency=(0.0, 0.005), seed=FIRST)
    async def rest(system: GuardedSystem, simulation: Simulation) -> None:
        recovery = hf.hybrid(interval=0.05)
        spec = hf.child("walker", hf.start(Walker), recovery=recovery, mechanism=STACKS[stack], shutdown=600.0)
        walker = await system.start(spec)
        await walker.send(Go(["sleep", "wait", "effect"], "walk"))
        await walker.send(Count())
        await asyncio.sleep(1.0)
        for _ in range(3):
            begun = asyncio.get_running_loop().time()
            await system.ref("/app", hf.Supervisor).ask(hf.RestartChild("walker", running=True), IN_TIME)
            assert asyncio.get_running_loop().time() - begun < 60.0, "it has waited for a turn that rests"
        await walker.send(Call("back"))
        tale = await walker.ask(Tale(), IN_TIME)
        assert tale == {"done": ["walk: call back, walk.2", "1 before"], "missed": [], "steps": [3]}

    rest()


def test_what_was_said_before_the_mechanisms_changed_is_waited_for_by_nobody() -> None:
    """The brick that had said it had ended, and what it had begun with it: whoever waited for that was cancelled."""
    stroll(48, "lfr", None, schedule=37)
