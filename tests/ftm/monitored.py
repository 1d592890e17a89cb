"""What the tests of the monitoring engine share: one monitored address in a running system."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import holdfast as hf
from holdfast.actors.events import Event
from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import FaultClasses, Resources
from holdfast.ftm.monitoring.adaptations import (
    AdaptationDecided,
    AdaptationDone,
    AdaptationFailed,
    AdaptationHeld,
    AdaptationWithdrawn,
    MonitoringBlind,
    NothingValid,
)
from holdfast.ftm.monitoring.judge import Judge, Readings, Settings
from holdfast.ftm.monitoring.monitor import ChangeStack, MechanismWatch, Monitored, MonitoringEngine, Report
from tests.ftm.declarations import EIGHT

APP = Application("Account", state_bytes=10_000, request_bytes=100, rate=100)
WIDE, NARROW = Readings(bandwidth=1e9, units=2), Readings(bandwidth=1e5, units=2)
SETTINGS = Settings(required=FaultClasses.of("crash"), smoothing=1, confirm=3, dwell=60, urgent_dwell=10)
OURS = (
    AdaptationDecided,
    AdaptationDone,
    AdaptationFailed,
    AdaptationHeld,
    AdaptationWithdrawn,
    MonitoringBlind,
    NothingValid,
)


class World:
    """One monitored address in a running system."""

    def __init__(self, system: hf.ActorSystem, watch: MechanismWatch, orders: list[ChangeStack]) -> None:
        self.system, self.watch, self.orders = system, watch, orders
        self.events = system.events()
        self.ref: hf.ActorRef[MonitoringEngine]

    def told(self) -> list[Event]:
        return [event for event in self.events.take() if isinstance(event, OURS)]

    def names(self) -> list[str]:
        return [type(event).__name__ for event in self.told()]

    async def begin(self) -> None:
        self.ref = await self.system.start(hf.child("monitor", hf.start(MonitoringEngine, self.watch)))

    async def kill(self) -> None:
        """It dies, and its supervisor starts it again."""
        life = (await self.system.get_status(self.ref)).life
        await self.system.terminate(self.ref, hf.Crash("ValueError", "boom"))
        while (await self.system.get_status(self.ref)).life == life:
            await asyncio.sleep(0)

    async def report(self) -> Monitored:
        return await self.ref.ask(Report())


Play = Callable[[World], Awaitable[None]]


async def in_world(
    play: Play,
    settings: Settings = SETTINGS,
    current: tuple[str, ...] = ("pbr",),
    resources: Resources | None = None,
    application: Application = APP,
    **options: Any,
) -> None:
    orders: list[ChangeStack] = []
    options.setdefault("trigger", orders.append)
    options.setdefault("probe", None)
    judged = Judge(settings, application, current, EIGHT, resources or Resources(units=2))
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        watch = MechanismWatch("/app/alice", judged, **options)
        world = World(system, watch, orders)
        await world.begin()
        try:
            await play(world)
        finally:
            world.events.close()
            watch.close()
