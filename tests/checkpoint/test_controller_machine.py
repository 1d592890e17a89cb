"""Recoveries that overlap in any order, with a controller that dies in between, against a naive model (T27)."""

from __future__ import annotations

import asyncio

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

import holdfast as hf
from tests.checkpoint.guards import Wheels, part, words

PATHS = ["/m/one", "/m/two", "/m/three"]
SHARED = {"/m/one": ["/m/wheels"], "/m/two": ["/m/wheels", "/m/arm"], "/m/three": ["/m/arm"]}


class Overlap(RuleBasedStateMachine):
    """The model: a receiver is safe while any of its recoveries is not over, and hears of each change once."""

    def __init__(self) -> None:
        super().__init__()
        self.runner = asyncio.Runner(debug=False)
        self.hurt: set[str] = set()
        self.expected: dict[str, list[str]] = {"/m/wheels": [], "/m/arm": []}
        self.system = hf.ActorSystem("m", log=False, intensity=1_000_000)
        self.runner.run(self.begin())

    async def begin(self) -> None:
        await self.system.__aenter__()
        self.refs = {
            f"/m/{name}": await self.system.start(hf.child(name, hf.start(Wheels))) for name in ("wheels", "arm")
        }
        await self.system.start(hf.child("recorded", hf.start(Wheels), recovery=hf.hybrid()))
        self.recoveries = self.system._homes.recoveries

    def changed(self, path: str, before: set[str], after: set[str]) -> None:
        for receiver, told in self.expected.items():
            was, is_ = (any(receiver in SHARED[one] for one in hurt) for hurt in (before, after))
            if was != is_:
                told.append("safe" if is_ else "free")

    def step(self, ticks: int) -> None:
        async def wait() -> None:
            for _ in range(ticks):
                await asyncio.sleep(0)

        self.runner.run(wait())

    @rule(path=st.sampled_from(PATHS), ticks=st.integers(0, 3))
    def crash(self, path: str, ticks: int) -> None:
        async def do() -> None:
            self.recoveries.crashed(path, hf.hybrid(safe_state=SHARED[path]), None)

        self.settle()  # What is over before the next crash has been told: so the order is known.
        before, self.hurt = self.hurt, self.hurt | {path}
        self.changed(path, before, self.hurt)
        self.runner.run(do())
        self.step(ticks)

    @rule(path=st.sampled_from(PATHS), ticks=st.integers(0, 3))
    def start(self, path: str, ticks: int) -> None:
        async def do() -> None:
            if path in self.hurt:
                self.recoveries.starts(path, hf.hybrid(safe_state=SHARED[path]))

        self.runner.run(do())
        self.step(ticks)

    @precondition(lambda self: self.hurt)
    @rule(which=st.integers(0, 2), ticks=st.integers(0, 3))
    def back(self, which: int, ticks: int) -> None:
        path = sorted(self.hurt)[which % len(self.hurt)]

        async def do() -> None:
            self.recoveries.over(path)

        self.settle()
        before, self.hurt = self.hurt, self.hurt - {path}
        self.changed(path, before, self.hurt)
        self.runner.run(do())
        self.step(ticks)

    @rule(path=st.sampled_from(PATHS))
    def give_up(self, path: str) -> None:
        async def do() -> None:
            self.recoveries.given_up(path, "for good")

        self.runner.run(do())

    @rule(name=st.sampled_from(["", "controller", "switch"]), ticks=st.integers(0, 4))
    def kill(self, name: str, ticks: int) -> None:
        async def do() -> None:
            part(self.system, name).kill()

        self.runner.run(do())
        self.step(ticks)

    @rule()
    def settle(self) -> None:
        async def done() -> None:
            async with asyncio.timeout(10.0):
                while any(False in one.stages.values() for one in self.recoveries.all()):
                    await asyncio.sleep(0.001)

        self.runner.run(done())

    @rule()
    def look(self) -> None:
        self.settle()
        for path, ref in self.refs.items():
            assert self.runner.run(words(ref)) == self.expected[path]
            assert any(path in self.recoveries.safety.holds(one) for one in SHARED) == any(
                path in SHARED[one] for one in self.hurt
            )

    def teardown(self) -> None:
        try:
            self.look()
        finally:
            self.runner.run(self.system.__aexit__(None, None, None))
            self.runner.close()


Overlap.TestCase.settings = settings(max_examples=200, stateful_step_count=40)
TestOverlap = Overlap.TestCase
