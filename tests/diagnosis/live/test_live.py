"""From a running system to its root cause: a model that is generated, observers in a tree, a fault, its name."""

from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from holdfast.diagnosis import DIAGNOSIS, DiagnoserActor, GetDiagnosis, generate, observer, observers_for, tree
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.model import Model
from holdfast.diagnosis.observers import Manner, Observer
from holdfast.testing import advance, probe

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Price(hf.Message):
    cents: int


class Trade(hf.Message):
    cents: int


class Freeze(hf.Message):
    pass


class Tick(hf.Message):
    pass


class Book(hf.Message[int]):
    cents: int


class Feed(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self.timer = self.ctx.every(0.1, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        await self.ctx.publish("/prices", Price(100))

    @hf.on(Freeze)
    def _freeze(self, message: Freeze) -> None:
        self.timer.cancel()


class Ledger(hf.Actor):
    def __init__(self) -> None:
        self.booked = 0

    @hf.on(Book)
    def _book(self, message: Book) -> int:
        self.booked += 1
        return self.booked


class Matcher(hf.Actor):
    ledger: hf.Binding[Ledger]

    @hf.subscribe("/prices")
    @hf.on(Price)
    async def _match(self, message: Price) -> None:
        try:
            await self.ledger.ask(Book(message.cents))
        except hf.HoldfastError:  # There is no trade that is not booked.
            return
        await self.ctx.publish("/trades", Trade(message.cents))


class Gateway(hf.Actor):
    @hf.subscribe("/trades")
    @hf.on(Trade)
    def _tell(self, message: Trade) -> None:
        pass


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("shop", log=False, seed=1) as running:
        ledger = hf.child("ledger", hf.start(Ledger))
        matcher = hf.child("matcher", hf.start(Matcher), bindings={"ledger": "/shop/desk/ledger"})
        await running.start(hf.supervisor("desk", children=[ledger, matcher]))
        await running.start(hf.child("gateway", hf.start(Gateway)))
        await running.start(hf.child("feed", hf.start(Feed), backoff=hf.Backoff(initial=0.7, maximum=0.7, jitter=0.0)))
        yield running


async def diagnosed(system: hf.ActorSystem) -> hf.ActorRef[DiagnoserActor]:
    found = await generate(system)
    await system.start(tree(found.declaration, observers_for(found, window=1.0, manner=Manner(every=0.5))))
    await advance(10.0)
    return system.ref("/shop/diagnosis/diagnoser", DiagnoserActor)


def causes(diagnosis: Diagnosis) -> list[tuple[str, ...]]:
    return [one.bad for one in diagnosis.candidates]


async def test_the_runtime_knows_who_publishes_subscribes_is_bound_and_is_supervised(system: hf.ActorSystem) -> None:
    found = await generate(system)
    assert found.addresses == {
        "desk/ledger": "/shop/desk/ledger",
        "desk/matcher": "/shop/desk/matcher",
        "gateway": "/shop/gateway",
        "feed": "/shop/feed",
    }
    matcher = found.wiring["desk/matcher"]
    assert matcher.publishes == ("/trades",)
    assert matcher.subscribes == ("/prices",)
    assert matcher.bound == {"ledger": "desk/ledger"}
    assert matcher.supervisor == "/shop/desk"
    model = Model(found.declaration)
    assert model.components["desk/matcher"].out["/trades"] == ("/prices", "replies(desk/ledger)")
    assert model.components["feed"].out["/prices"] == ()
    assert not found.left_out


async def test_to_look_leaves_nothing_behind_and_a_second_look_finds_no_diagnosis(system: hf.ActorSystem) -> None:
    await diagnosed(system)
    before = set(system._node.root.children or ())  # type: ignore[union-attr]
    again = await generate(system)
    assert set(again.addresses) == {"desk/ledger", "desk/matcher", "gateway", "feed"}
    assert set(system._node.root.children or ()) == before  # type: ignore[union-attr]


class Mine(Observer):
    """A user's own observer."""


async def test_who_looks_after_the_system_and_who_comes_and_goes_is_no_component(system: hf.ActorSystem) -> None:
    await system.start(observer("mine", hf.start(Mine)))
    await system.start(hf.child("recorded", hf.start(Ledger), recovery=hf.hybrid()))
    await system.start(hf.child("job", hf.start(Ledger), restart="temporary"))
    system.spawn(hf.start(Ledger), "unsupervised")
    found = await generate(system, seconds=0.5, leave_out=["/shop/desk"])
    assert set(found.addresses) == {"gateway", "feed", "recorded"}


async def test_a_restart_is_no_fault(system: hf.ActorSystem) -> None:
    found = await generate(system)
    await system.start(tree(found.declaration, observers_for(found)))
    await advance(15.5)
    heard = probe(system)
    heard.subscribe(DIAGNOSIS)
    for _ in range(2):
        system.ref("/shop/feed", Feed)._cell.kill()
        await advance(10.0)  # it is down when it is looked at, once
    await heard.expect_no_message()
    diagnoser = system.ref("/shop/diagnosis/diagnoser", DiagnoserActor)
    assert (await diagnoser.ask(GetDiagnosis())).state is State.HEALTHY


async def test_a_system_that_works_stays_healthy(system: hf.ActorSystem) -> None:
    diagnoser = await diagnosed(system)
    states = set()
    for _ in range(20):
        states.add((await diagnoser.ask(GetDiagnosis())).state)
        await advance(3.0)
    assert states == {State.HEALTHY}


async def test_a_feed_that_freezes_is_the_cause_and_not_what_depends_on_it(system: hf.ActorSystem) -> None:
    diagnoser = await diagnosed(system)
    system.ref("/shop/feed", Feed).tell(Freeze())
    await advance(5.0)
    found = await diagnoser.ask(GetDiagnosis())
    assert causes(found) == [("feed",)]
    assert set(map(str, found.symptoms)) == {"not ok(/prices)"}


async def test_a_ledger_that_is_gone_is_the_cause(system: hf.ActorSystem) -> None:
    diagnoser = await diagnosed(system)
    await system.stop(system.ref("/shop/desk/ledger", Ledger))
    await advance(5.0)
    assert causes(await diagnoser.ask(GetDiagnosis())) == [("desk/ledger",)]


async def test_a_ledger_that_does_not_answer_is_certain_and_who_asks_it_is_not_suspected(
    system: hf.ActorSystem,
) -> None:
    diagnoser = await diagnosed(system)
    await system.suspend(system.ref("/shop/desk/ledger", Ledger))
    await advance(5.0)
    assert causes(await diagnoser.ask(GetDiagnosis())) == [("desk/ledger",)]
