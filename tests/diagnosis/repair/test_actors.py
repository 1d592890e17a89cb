"""A system that is no robot: real actors under a real supervisor; the cause is restarted, not the symptom."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.model import System
from holdfast.diagnosis.observers import GeneralObserver, Limits, Property
from holdfast.diagnosis.repair import ActionBegan, GaveUp, Policy, Repaired
from tests.diagnosis.repair.simulated import M, Secretary

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

POLICY = Policy(verify=8.0, settle=1.0)
NAMES = ("feed", "matcher")


class Freeze(hf.Message):
    """Be of no use from now on, and say nothing of it."""


class Fall(hf.Message):
    """Crash."""


class Tick(hf.Message):
    """A moment has passed."""


class Price(hf.Message):
    """What something costs."""


class Match(hf.Message):
    """Somebody bought it."""


class Part(hf.Actor):
    def __init__(self) -> None:
        self.is_frozen = False

    @hf.on(Freeze)
    def _freeze(self, message: Freeze) -> None:
        self.is_frozen = True

    @hf.on(Fall)
    def _fall(self, message: Fall) -> None:
        raise RuntimeError("it fell")


class Feed(Part):
    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.2, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        if not self.is_frozen:
            await self.ctx.publish("/prices", Price())


class Matcher(Part):
    @hf.subscribe("/prices")
    @hf.on(Price)
    async def _match(self, message: Price) -> None:
        if not self.is_frozen:
            await self.ctx.publish("/matches", Match())


class Desk(hf.Actor):
    @hf.subscribe("/matches")
    @hf.on(Match)
    def _note(self, message: Match) -> None:
        pass


class Shop:
    """The system, and what repair tells."""

    def __init__(self, system: hf.ActorSystem) -> None:
        self.system = system
        self.told, self.news = list[hf.Message[Any]](), asyncio.Event()
        system.spawn(hf.start(Secretary, self.told, [], self.news), name="secretary")

    def part(self, name: str) -> hf.ActorRef[Part]:
        return self.system.ref(f"/t/shop/{name}", Part)

    async def hear(self, kind: type[M]) -> M:
        async with asyncio.timeout(1000):
            while not (found := [one for one in self.told if isinstance(one, kind)]):
                self.news.clear()
                await self.news.wait()
        return found[0]

    def done(self) -> list[str]:
        return [str(one.step) for one in self.told if isinstance(one, ActionBegan)]


@pytest.fixture
async def shop() -> AsyncIterator[Shop]:
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        children = [hf.child("feed", hf.start(Feed)), hf.child("matcher", hf.start(Matcher))]
        await system.start(hf.supervisor("shop", children=children, intensity=100))
        await system.start(hf.child("desk", hf.start(Desk)))
        yield Shop(system)


@pytest.mark.parametrize("culprit", NAMES)
async def test_any_system_is_watched_and_repaired_in_one_line(shop: Shop, culprit: str) -> None:
    watching = await diagnosis.watch(shop.system, repair=POLICY)
    assert set(watching.addresses) == {"shop/feed", "shop/matcher", "desk"}
    await asyncio.sleep(20.0)  # rates are learned
    assert (await watching.diagnosis()).state is State.HEALTHY
    lives = {name: shop.part(name)._cell for name in NAMES}
    shop.part(culprit).tell(Freeze())
    await shop.hear(Repaired)
    assert shop.done() == [f"restart_child(shop/{culprit})"]
    assert [name for name in NAMES if shop.part(name)._cell is not lives[name]] == [culprit]
    assert str(await watching.diagnosis()) == "healthy"


async def test_a_system_is_watched_by_a_model_of_ones_own(shop: Shop) -> None:
    model = System()
    model.node("feed", out=["/prices"])
    model.node("matcher", out={"/matches": ["/prices"]})
    rates = [diagnosis.observer(topic[1:], hf.start(GeneralObserver, topic, 5.0)) for topic in ("/prices", "/matches")]
    addresses = {name: f"/t/shop/{name}" for name in NAMES}
    watching = await diagnosis.watch(shop.system, model, rates, addresses=addresses, repair=POLICY)
    await asyncio.sleep(5.0)
    shop.part("feed").tell(Freeze())
    await shop.hear(Repaired)
    assert shop.done() == ["restart_child(feed)"]
    assert watching.generated is None


async def test_without_repair_it_only_says_what_is_wrong_and_why(shop: Shop) -> None:
    watching = await diagnosis.watch(shop.system)
    await asyncio.sleep(20.0)
    shop.part("feed").tell(Freeze())
    await asyncio.sleep(10.0)
    assert str(await watching.diagnosis()) == "faulty: shop/feed"
    assert "not ok(/prices): shop/feed is faulty" in (await watching.why()).text
    assert "/prices" in {atom.args[0] for atom in (await watching.observed()).negative}
    assert shop.done() == []


async def test_properties_are_watched_by_their_limits(shop: Shop) -> None:
    # D25: what restarts again and again is faulty, though it runs.
    limits = {"shop/feed": {Property.RESTARTS: Limits(high=3.5)}}
    watching = await diagnosis.watch(shop.system, limits=limits)
    await asyncio.sleep(20.0)
    for _ in range(5):
        shop.part("feed").tell(Fall())
        await asyncio.sleep(1.0)
    await asyncio.sleep(3.0)
    found = await watching.diagnosis()
    assert "not ok(shop/feed.restarts)" in set(map(str, found.symptoms))
    assert str(found) == "faulty: shop/feed"


async def test_what_a_restart_does_not_help_is_restarted_with_its_supervisor_and_then_given_up(shop: Shop) -> None:
    # T62: the cheapest first.
    model = System()
    model.node("feed", out=["/news"])  # nobody publishes that
    model.external("/prices")
    rate = diagnosis.observer("news", hf.start(GeneralObserver, "/news", 5.0))
    await diagnosis.watch(shop.system, model, [rate], addresses={"feed": "/t/shop/feed"}, repair=POLICY)
    over = await shop.hear(GaveUp)
    assert over.components == ("feed",)
    assert shop.done() == ["restart_child(feed)"] * 2 + ["restart_subtree(feed)"] * 2
