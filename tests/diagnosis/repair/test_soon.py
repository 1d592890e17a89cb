"""Repair acts as soon as it is certain: what has stood when it is told need not stand once more."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.literals import ok
from holdfast.diagnosis.model import System
from holdfast.diagnosis.observers import Manner, Observer
from holdfast.diagnosis.repair import ActionBegan, Caution, Policy
from tests.diagnosis.repair.simulated import Secretary

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

NAMES = ("feed", "matcher")


class Fail(hf.Message):
    """Be of no use from now on."""


class End(hf.Message):
    """End, and hang in that."""


class Crash(hf.Message): ...


class Tick(hf.Message): ...


class Price(hf.Message): ...


class Quote(hf.Message[int]): ...


class Part(hf.Actor):
    fails = False

    @hf.on(Fail)
    def _fail(self, message: Fail) -> None:
        self.fails = True

    @hf.on(End)
    def _end(self, message: End) -> None:
        self.ctx.stop()

    @hf.on(Crash)
    def _crash(self, message: Crash) -> None:
        raise RuntimeError("as it was told")

    async def on_stop(self, reason: Any) -> None:
        if reason == hf.NORMAL:
            await asyncio.Event().wait()


class Feed(Part):
    """When it is started again, that takes three seconds."""

    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(3.0 * (self.ctx.life > 1))
        self.ctx.every(0.2, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        if not self.fails:
            await self.ctx.publish("/prices", Price())


class Matcher(Part):
    @hf.subscribe("/prices")
    @hf.on(Price)
    async def _match(self, message: Price) -> None:
        if not self.fails:
            await self.ctx.publish("/matches", message)


class Cache(Part):
    """Answers, or owes all its answers."""

    @hf.on(Quote)
    def _quote(self, message: Quote) -> "int | hf.ReplyHandle[int]":
        return self.ctx.reply_handle() if self.fails else 1


class Asker(hf.Actor):
    """Crashes when it gets no answer."""

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.3, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        await self.ctx.find("/t/all/cache", Cache).ask(Quote(), timeout=1.0)


class Gauge(Observer):
    """Says what it is told, and since when that is so."""

    def __init__(self, says: dict[str, tuple[bool, float | None]]) -> None:
        super().__init__(manner=Manner(every=0.1, time_to_live=1.0))
        self._says = says

    def look(self) -> None:
        for topic, (holds, since) in self._says.items():
            self.verdict(ok(topic), holds, since)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        kinds = {"feed": Feed, "matcher": Matcher, "cache": Cache, "asker": Asker}
        children = [hf.child(name, hf.start(kind)) for name, kind in kinds.items()]
        await system.start(hf.supervisor("all", children=children, intensity=1000))
        yield system


async def acted(system: hf.ActorSystem, name: str, message: hf.Message[Any], within: float) -> list[tuple[str, float]]:
    """Watch, with repair on; the actions behind this message, each with the seconds after which it has begun."""
    told = list[hf.Message[Any]]()
    system.spawn(hf.start(Secretary, told, [], asyncio.Event()))
    await diagnosis.watch(system, repair="on")
    await asyncio.sleep(20.0)
    began = asyncio.get_running_loop().time()
    system.ref(f"/t/all/{name}", Part).tell(message)
    await asyncio.sleep(within)
    return [(str(one.step), one.time - began) for one in told if isinstance(one, ActionBegan)]


async def struck(system: hf.ActorSystem, name: str, message: hf.Message[Any], within: float) -> tuple[str, float]:
    """The first of them."""
    return (await acted(system, name, message, within))[0]


async def test_who_falls_silent_is_restarted_when_that_is_seen(system: hf.ActorSystem) -> None:
    """The silence has stood for two seconds by then."""
    step, seconds = await struck(system, "feed", Fail(), 20.0)
    assert (step, seconds < 2.7) == ("restart_child(all/feed)", True), seconds


async def test_that_those_who_ask_are_started_again_delays_nobody(system: hf.ActorSystem) -> None:
    step, seconds = await struck(system, "cache", Fail(), 20.0)
    assert (step, seconds < 2.7) == ("restart_child(all/cache)", True), seconds


async def test_who_hangs_in_its_end_is_given_no_time_to_begin(system: hf.ActorSystem) -> None:
    """Its supervisor has five seconds for that end, and begins nothing."""
    step, seconds = await struck(system, "feed", End(), 20.0)
    assert (step, seconds < 6.3) == ("restart_child(all/feed)", True), seconds


async def test_who_was_started_just_now_is_given_time_to_begin(system: hf.ActorSystem) -> None:
    """While it started it was silent: what was seen then says nothing of the life that has begun."""
    assert await acted(system, "feed", Crash(), 20.0) == []


@pytest.mark.parametrize(
    ("prices", "since", "is_soon"),
    [(True, -60.0, True), (True, None, False), (None, -60.0, False)],
    ids=["it has stood", "that is not known", "another one may be faulty"],
)
async def test_what_shows_it_must_have_stood_or_the_diagnosis_stands(
    system: hf.ActorSystem, prices: bool | None, since: float | None, is_soon: bool
) -> None:
    model = System()
    model.node("feed", out=["/prices"])
    model.node("matcher", out={"/matches": ["/prices"]})
    says: dict[str, tuple[bool, float | None]] = {"/matches": (True, None), "/prices": (True, None)}
    told = list[hf.Message[Any]]()
    system.spawn(hf.start(Secretary, told, [], asyncio.Event()))
    policy = Policy(caution=Caution(confirm=5.0))
    gauge = diagnosis.observer("gauge", hf.start(Gauge, says))
    where = {name: f"/t/all/{name}" for name in NAMES}
    await diagnosis.watch(system, model, [gauge], addresses=where, repair="on", policy=policy)
    await asyncio.sleep(5.0)
    now = asyncio.get_running_loop().time()
    if prices is None:
        del says["/prices"]
        await asyncio.sleep(2.0)
    says["/matches"] = (False, None if since is None else now + since)
    await asyncio.sleep(3.0)
    assert any(isinstance(one, ActionBegan) for one in told) is is_soon
    await asyncio.sleep(6.0)
    assert any(isinstance(one, ActionBegan) for one in told)
