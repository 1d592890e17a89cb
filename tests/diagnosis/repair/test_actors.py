"""A system that is no robot: real actors under a real supervisor; the cause is restarted, not the symptom."""

import asyncio

import pytest

import holdfast as hf
from holdfast.diagnosis.literals import ok, running
from holdfast.diagnosis.messages import OBSERVATIONS
from holdfast.diagnosis.model import Model, System
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.repair import ActionBegan, Policy, Repaired, Repairer, restart_child
from tests.diagnosis.repair.simulated import Doctor, Observe, Secretary

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Freeze(hf.Message):
    """Be of no use from now on, and say nothing of it."""


class IsFresh(hf.Message[bool]):
    """Is what you have of any use?"""


class Feed(hf.Actor):
    def __init__(self) -> None:
        self._frozen = False

    @hf.on(Freeze)
    def _freeze(self, message: Freeze) -> None:
        self._frozen = True

    @hf.on(IsFresh)
    def _is_fresh(self, message: IsFresh) -> bool:
        return not self._frozen


class Watcher(hf.Actor):
    """Sees prices and matches; a match is as fresh as its prices."""

    deterministic = False

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.2, Observe())

    @hf.on(Observe)
    async def _observe(self, message: Observe) -> None:
        fresh = [await self._is_fresh("feed"), await self._is_fresh("matcher")]
        said = [ok("/prices") if fresh[0] else ~ok("/prices"), ok("/matches") if all(fresh) else ~ok("/matches")]
        for literal in (*said, running("feed"), running("matcher")):
            await self.ctx.publish(
                OBSERVATIONS, Observation(literal, asyncio.get_running_loop().time(), "watcher", 2.0)
            )

    async def _is_fresh(self, name: str) -> bool:
        try:
            return await self.ctx.find(f"/t/shop/{name}", Feed).ask(IsFresh(), 5.0)
        except hf.HoldfastError:  # it is being restarted
            return False


@pytest.mark.parametrize("culprit", ["feed", "matcher"])
async def test_the_cause_is_restarted_and_the_symptom_left_alone(culprit: str) -> None:
    shop = System()
    shop.node("feed", out=["/prices"])
    shop.node("matcher", out={"/matches": ["/prices"]})
    addresses = {name: f"/t/shop/{name}" for name in ("feed", "matcher")}
    told, news = list[hf.Message](), asyncio.Event()
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        await system.start(hf.supervisor("shop", children=[hf.child(name, hf.start(Feed)) for name in addresses]))
        model = Model(shop)
        system.spawn(hf.start(Secretary, told, news), name="secretary")
        system.spawn(hf.start(Doctor, model, True), name="doctor")
        policy = Policy(verify=5.0, settle=1.0)
        mend = hf.child("repairer", hf.start(Repairer, model, [restart_child(addresses)], policy, addresses=addresses))
        await system.start(mend)
        system.spawn(hf.start(Watcher), name="watcher")
        lives = {name: system.ref(path, Feed)._cell for name, path in addresses.items()}
        system.ref(addresses[culprit], Feed).tell(Freeze())
        async with asyncio.timeout(100):
            while not any(isinstance(one, Repaired) for one in told):
                news.clear()
                await news.wait()
        assert [str(one.step) for one in told if isinstance(one, ActionBegan)] == [f"restart_child({culprit})"]
        assert await system.ref(addresses[culprit], Feed).ask(IsFresh())
        changed = [name for name, path in addresses.items() if system.ref(path, Feed)._cell is not lives[name]]
        assert changed == [culprit]
