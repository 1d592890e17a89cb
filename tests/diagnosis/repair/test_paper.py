"""The paper's two scenarios, closed: from observations over the diagnosis and the plan to what is observed after it."""

from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from holdfast.diagnosis.engine import Diagnosis
from holdfast.diagnosis.model import System
from holdfast.diagnosis.repair import GaveUp, Planned, Policy, Repaired
from tests.diagnosis.repair.simulated import POWER, START, World, scene

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

HARDWARE = ("ja", "hu", "la")
NODES = ("hm", "hn", "in", "jn", "jtn", "jyn", "lac", "lan")


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


def all_off(world: World) -> None:
    world.on.clear()
    world.running = {"rviz"}


def base_off(world: World) -> None:
    world.on.discard("ja")


async def test_power_up_is_two_stages_and_takes_the_devices_own_time(system: hf.ActorSystem) -> None:
    # D52, D53: the paper took 30.2 s.
    here = await scene(system, before=all_off)
    over = await here.hear(Repaired)
    assert here.planned() == [
        [[f"power_up({h})" for h in sorted(HARDWARE)], [f"start_node({n})" for n in sorted(NODES)]],
    ]
    assert sorted(here.done()) == sorted([f"power_up({h})" for h in HARDWARE] + [f"start_node({n})" for n in NODES])
    assert here.world.is_healthy()
    assert here.all(GaveUp) == []
    assert POWER + START <= over.seconds <= POWER + START + 0.5


@pytest.mark.parametrize("ranks", [True, False], ids=["ranked", "not ranked"])
async def test_shut_down_is_a_power_up_and_then_a_restart_of_the_driver(system: hf.ActorSystem, ranks: bool) -> None:
    # D54, O3: after the power-up {ja} and {jn} explain the silence alike. The base is not switched off and on again,
    # even when the diagnoser does not know what was repaired.
    here = await scene(system, ranks=ranks)
    await here.rest(2.0)
    assert here.told == here.told[:1]  # healthy
    here.change(base_off)
    await here.hear(Repaired)
    assert here.done() == ["power_up(ja)", "stop_node(jn)", "start_node(jn)"]
    assert here.planned() == [[["power_up(ja)"]], [["stop_node(jn)"], ["start_node(jn)"]]]
    assert here.world.is_healthy()


async def test_shut_down_in_one_plan(system: hf.ActorSystem) -> None:
    policy = Policy(verify=6.0, settle=1.0, cool_down=0.5, restart_drivers=True)
    here = await scene(system, policy)
    here.change(base_off)
    await here.hear(Repaired)
    assert here.planned() == [[["power_up(ja)", "stop_node(jn)"], ["start_node(jn)"]]]
    assert here.world.is_healthy()


async def test_a_diagnosis_that_did_not_help_is_not_acted_upon_again_before_the_others(
    system: hf.ActorSystem,
) -> None:
    # O3: a base that often fails is listed first each time. "Take the first" would switch it off and on for ever.
    robot = System()
    robot.hardware("ja", prior=0.4)
    robot.driver("jn", on=["ja"], out=["/odom"])
    here = await scene(system, ranks=False, robot=robot)
    here.change(base_off)
    await here.hear(Repaired)
    ambiguous = next(one for one in here.all(Diagnosis) if len(one.candidates) == 2)
    assert [one.bad for one in ambiguous.candidates] == [("ja",), ("jn",)]
    assert [one.bad for one in here.all(Planned)] == [("ja",), ("jn",)]
    assert here.done() == ["power_up(ja)", "stop_node(jn)", "start_node(jn)"]
