"""Those who diagnose and repair are killed themselves: their supervisor brings them back, and the loop goes on."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis import ChangeModel, GetModel, ModelServer
from holdfast.diagnosis.model import Component, Put
from holdfast.diagnosis.repair import ActionBegan, GaveUp, GetRepairStatus, Policy, Repaired, SetMode
from holdfast.supervision.arbiter import arbiter_of
from tests.diagnosis.repair.simulated import Scene, World, scene

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

POLICY = Policy(verify=6.0, settle=1.0, cool_down=0.5)
WHO = (
    "model",
    "diagnoser",
    "observers/nodes",
    "observers/power",
    "observers/rate of odom",
    "observers",
    "repairer",
    "",
)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


def kill(here: Scene, who: str) -> None:
    cell = here.system._node.find("/t/diagnosis" + f"/{who}" * bool(who))
    assert cell is not None
    cell.kill()


@pytest.mark.parametrize("who", WHO)
@pytest.mark.parametrize("steps", [0, 1, 3], ids=["before", "in the first plan", "in the last action"])
async def test_whoever_is_killed_the_robot_is_repaired(system: hf.ActorSystem, who: str, steps: int) -> None:
    # T61; the fault is the paper's: a base that loses its power, and a driver that loses its base (D54).
    here = await scene(system, POLICY)
    await here.rest(3.0)
    if not steps:
        kill(here, who)
    await here.change(lambda world: world.switch("ja", False))
    if steps:
        await here.hear(ActionBegan, steps)
        kill(here, who)
    await here.hear(Repaired)
    await here.rest()
    assert here.world.is_healthy()
    assert here.all(GaveUp) == []
    assert here.touched() == {"ja", "jn"}
    assert arbiter_of(system._node).holder("/t/robot/jn") is None


async def test_a_repairer_that_is_killed_again_and_again_has_no_more_attempts_than_others(
    system: hf.ActorSystem,
) -> None:
    # T62
    def dead(world: World) -> None:
        world.switch("hu", False)
        world.dead.add("hu")

    here = await scene(system, Policy(attempts=3, verify=6.0, settle=1.0, cool_down=0.5))
    await here.change(dead)
    for count in (1, 2, 3):
        await here.hear(ActionBegan, count)
        here.repairer.kill()
    await here.hear(GaveUp)
    await here.rest()
    assert here.done() == ["power_up(hu)"] * 3
    here.repairer.kill()
    await asyncio.sleep(1.0)
    assert (await here.repairer.ask(GetRepairStatus())).given_up == ("hu",)
    await here.rest()
    assert here.done() == ["power_up(hu)"] * 3


async def test_a_mode_outlives_the_repairer(system: hf.ActorSystem) -> None:
    # T65
    here = await scene(system, POLICY)
    await here.repairer.send(SetMode("safe"))
    await here.rest(1.0)
    here.repairer.kill()
    await asyncio.sleep(1.0)
    await here.change(lambda world: world.switch("ja", False))
    await asyncio.sleep(12.0)
    assert here.done() == []
    here.repairer.tell(SetMode("normal"))
    await here.hear(Repaired)


async def test_a_model_that_was_changed_is_the_repairer_s_too_in_its_next_life(system: hf.ActorSystem) -> None:
    # D31
    here = await scene(system, POLICY)
    server = system.ref("/t/diagnosis/model", ModelServer)
    await server.ask(ChangeModel((Put(Component(name="rviz", prior=0.02)),), "rviz fails more often than was thought"))
    await asyncio.sleep(0.1)
    kill(here, "model")
    kill(here, "repairer")
    await asyncio.sleep(1.0)
    assert (await system.ref("/t/diagnosis/model", ModelServer).ask(GetModel())).number == 2
    await here.change(lambda world: world.running.discard("hm"))
    await here.hear(Repaired)
    actor: Any = here.repairer._cell.actor
    assert actor._model.version == 2


async def test_an_observer_that_is_killed_does_not_make_anybody_suspect(system: hf.ActorSystem) -> None:
    # T50: unknown is not "not ok".
    here = await scene(system, POLICY)
    await here.rest(3.0)
    for _ in range(3):
        for name in ("nodes", "power", "rate of odom", "rate of map"):
            kill(here, f"observers/{name}")
        await asyncio.sleep(6.0)
    assert here.suspected() == set()
