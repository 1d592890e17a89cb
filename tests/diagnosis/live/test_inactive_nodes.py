"""A node that was switched off by order is silent, and no fault; switched on again, its silence is one."""

import asyncio

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Switch(hf.Message[None]):
    is_active: bool


class Break(hf.Message): ...


class Frame(hf.Message): ...


class Renew(hf.Message): ...


class Camera(hf.Actor):
    """Says, while it is inactive, that its topic is silent by order, if it is `polite`."""

    def __init__(self, polite: bool) -> None:
        self.is_active, self.is_broken, self._polite = True, False, polite

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.1, Frame())
        self.ctx.every(1.0, Renew())

    @hf.on(Switch)
    async def switch(self, message: Switch) -> None:
        self.is_active = message.is_active
        await self.renew(Renew())

    @hf.on(Break)
    def break_down(self, message: Break) -> None:
        self.is_broken = True

    @hf.on(Renew)
    async def renew(self, message: Renew) -> None:
        if self._polite and not self.is_active:
            await self.ctx.publish(diagnosis.GRACE, diagnosis.Grace(("/frames",), 3.0))

    @hf.on(Frame)
    async def take(self, message: Frame) -> None:
        if self.is_active and not self.is_broken:
            await self.ctx.publish("/frames", message)


class Detector(hf.Actor):
    @hf.subscribe("/frames")
    @hf.on(Frame)
    async def detect(self, message: Frame) -> None:
        await self.ctx.publish("/fruits", message)


class Picker(hf.Actor):
    @hf.subscribe("/fruits")
    @hf.on(Frame)
    def pick(self, message: Frame) -> None: ...


@pytest.mark.parametrize("polite", [True, False])
async def test_an_inactive_node_is_silent_by_order_and_an_active_one_is_not(polite: bool) -> None:
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        camera = await system.start(hf.child("camera", hf.start(Camera, polite)))
        await system.start(hf.child("detector", hf.start(Detector)))
        await system.start(hf.child("picker", hf.start(Picker)))
        watching = await diagnosis.watch(system, repair="off")

        async def named(seconds: float) -> set[str]:
            found = set[str]()
            for _ in range(int(seconds / 0.5)):
                found.update((await watching.diagnosis()).suspects)
                await asyncio.sleep(0.5)
            return found

        assert await named(15.0) == set()
        await camera.ask(Switch(False))
        assert await named(30.0) == (set() if polite else {"camera"})
        await camera.ask(Switch(True))
        assert await named(10.0) <= (set() if polite else {"camera"})
        assert (await watching.diagnosis()).state is State.HEALTHY
        camera.tell(Break())
        if polite:
            assert await named(15.0) == {"camera"}
