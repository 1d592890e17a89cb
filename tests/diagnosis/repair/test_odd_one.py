"""Three sensors of which one is wrong in each of its lives: nobody touches the two that agree."""

import asyncio
from itertools import combinations
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.model import Expectation
from holdfast.diagnosis.observers import Manner, Observer
from holdfast.diagnosis.repair import ActionBegan, ApprovalWanted, GaveUp, Policy
from holdfast.testing import advance
from tests.diagnosis.repair.simulated import Secretary

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

NAMES = ("gyro", "lidar", "wheel")
BROKEN = set[str]()
"""Sensors that are wrong, in whatever life."""


class Tick(hf.Message): ...


class Turned(hf.Message):
    degrees: float


class Sensor(hf.Actor):
    def __init__(self, name: str) -> None:
        self.name = name

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.2, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        await self.ctx.publish(f"/{self.name}", Turned(90.0 if self.name in BROKEN else 5.0))


class Pairs(Observer):
    def __init__(self) -> None:
        super().__init__(*(f"/{name}" for name in NAMES), manner=Manner(every=0.5, time_to_live=2.0))
        self.seen: dict[str, float] = {}

    def hear(self, topic: str, message: Any) -> None:
        self.seen[topic[1:]] = message.degrees

    def look(self) -> None:
        for one, other in combinations(NAMES, 2):
            if one in self.seen and other in self.seen:
                self.verdict(f"ok({one}_{other})", abs(self.seen[one] - self.seen[other]) < 10.0)


async def test_the_two_that_agree_are_never_touched() -> None:
    BROKEN.clear()
    async with hf.ActorSystem("app", log=False) as system:
        sensors = [hf.child(name, hf.start(Sensor, name)) for name in NAMES]
        await system.start(hf.supervisor("s", children=sensors))
        agree = [
            Expectation(f"ok({a}_{b})", (f"s/{a}", f"s/{b}"), (f"ok(/{a})", f"ok(/{b})"))
            for a, b in combinations(NAMES, 2)
        ]
        pairs = diagnosis.observer("pairs", hf.start(Pairs))
        policy = Policy(settle=0.5, verify=3.0, approval=1.0)
        watching = await diagnosis.watch(system, observers=[pairs], expect=agree, policy=policy, repair="on")
        told = list[hf.Message[Any]]()
        system.spawn(hf.start(Secretary, told, [], asyncio.Event()), name="secretary")
        await advance(5.0)
        BROKEN.add("lidar")
        states: list[tuple[State, bool]] = []
        while not any(isinstance(one, GaveUp) for one in told):
            await advance(0.1)
            found = await watching.diagnosis()
            states.append((found.state, bool(found.unknown)))
        states = states[states.index((State.FAULTY, False)) :]
    assert {str(one.step) for one in told if isinstance(one, ActionBegan)} == {"restart_child(s/lidar)"}
    (wanted,) = [one for one in told if isinstance(one, ApprovalWanted)]
    assert "restart_subtree restarts /app/s with all below it" in wanted.reason
    (gave_up,) = [one for one in told if isinstance(one, GaveUp)]
    assert gave_up.components == ("s/lidar",)
    assert gave_up.plan[0] == "restart_subtree(s/lidar); restart_subtree restarts /app/s with all below it"
    assert (State.HEALTHY, False) not in states  # In the grace after a restart nobody knows.
    assert (State.HEALTHY, True) in states
