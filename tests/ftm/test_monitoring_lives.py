"""The monitoring engine and itself: what outlives its lives, what it does not count, and the machine it measures."""

import asyncio

import msgspec
import pytest

from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import FaultClasses
from holdfast.ftm.monitoring.adaptations import AdaptationWithdrawn
from holdfast.ftm.monitoring.judge import Readings
from holdfast.ftm.monitoring.monitor import ChangeStack, Measured, Observe, read_machine
from holdfast.testing import advance
from tests.ftm.monitored import NARROW, SETTINGS, World, in_world

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


async def test_what_it_knows_survives_its_death() -> None:
    async def play(world: World) -> None:
        world.ref.tell(Observe("mismatch", 3))
        await advance(1.5)
        await world.kill()
        assert (await world.report()).faults == FaultClasses.of("crash", "transient_value")
        await advance(10)
        assert [order.target for order in world.orders] == [("pbr", "tr")]

    await in_world(play, application=Application("Account"))


async def test_a_decision_in_the_middle_of_which_it_died_is_told_to_have_failed() -> None:
    started: list[ChangeStack] = []

    async def trigger(order: ChangeStack) -> None:
        started.append(order)
        if len(started) == 1:
            await asyncio.Event().wait()

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(6)
        await world.kill()
        assert "AdaptationFailed" in world.names()
        await advance(20)
        assert len(started) == 2
        assert (await world.report()).current == ("lfr",)

    await in_world(play, trigger=trigger)


async def test_an_announcement_does_not_outlive_the_one_who_made_it() -> None:
    settings = msgspec.structs.replace(SETTINGS, notice=10)

    async def play(world: World) -> None:
        world.ref.tell(Measured(NARROW))
        await advance(5)
        await world.kill()
        events = world.told()
        assert [event.reason for event in events if isinstance(event, AdaptationWithdrawn)] == [
            "the monitoring engine was restarted"
        ]
        await advance(20)
        assert len(world.orders) == 1  # it was decided again

    await in_world(play, settings)


async def test_its_own_load_is_no_reason_to_change() -> None:
    """What the present mechanism computes makes the CPU busy; another one could have that time, too."""
    app = Application("Account", rate=100, turn_seconds=0.004)  # 40 % of a unit for each run
    settings = msgspec.structs.replace(SETTINGS, required=FaultClasses.of("transient_value"))

    async def play(world: World) -> None:
        await advance(200)
        assert world.orders == []
        assert (await world.report()).resources.cpu == pytest.approx(0.95)

    await in_world(play, settings, ("tr",), application=app, probe=lambda: Readings(units=1, cpu=0.15))


async def test_this_machine_can_be_measured() -> None:
    readings = read_machine()
    assert readings.units is not None
    assert readings.units >= 1
    assert readings.cpu is not None
    assert 0 <= readings.cpu <= 1
    assert readings.energy is None or 0 <= readings.energy <= 1
