"""A system that is no robot: real actors under a real supervisor; the cause is restarted, not the symptom."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.actors.errors import NoSuchActor
from holdfast.actors.events import DeadLetter
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.literals import Literal, ok, running
from holdfast.diagnosis.model import System
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import GeneralObserver, Limits, Manner, NodeObserver, Property
from holdfast.diagnosis.repair import (
    ActionBegan,
    ApprovalWanted,
    Deny,
    GaveUp,
    Planned,
    Policy,
    Repaired,
    Repairer,
    RepairTold,
)
from tests.diagnosis.repair.simulated import M, Secretary

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

POLICY = Policy(verify=8.0, settle=1.0, allow=frozenset({"restart_subtree"}))
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


class Hang(hf.Message):
    """Do not come back."""


class Quote(hf.Message[int]):
    """Say what is known."""


class Cache(hf.Actor):
    @hf.on(Hang)
    async def _hang(self, message: Hang) -> None:
        await asyncio.Event().wait()

    @hf.on(Quote)
    def _quote(self, message: Quote) -> int:
        return 1


class Clerk(hf.Actor):
    @hf.on(Hang)
    async def _rest(self, message: Hang) -> None:
        await self.ctx.sleep(3600.0)


class Asker(hf.Actor):
    cache: hf.Binding[Cache]

    def on_start(self, restored: bool) -> None:
        self.ctx.every(0.3, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        await self.cache.ask(Quote(), timeout=1.0)


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
    watching = await diagnosis.watch(shop.system, repair="on", policy=POLICY)
    assert set(watching.addresses) == {"shop/feed", "shop/matcher", "desk"}
    await asyncio.sleep(20.0)  # rates are learned
    assert (await watching.diagnosis()).state is State.HEALTHY
    lives = {name: shop.part(name)._cell.life for name in NAMES}
    shop.part(culprit).tell(Freeze())
    await shop.hear(Repaired)
    assert shop.done() == [f"restart_child(shop/{culprit})"]
    assert [name for name in NAMES if shop.part(name)._cell.life != lives[name]] == [culprit]
    assert str(await watching.diagnosis()) == "healthy"


async def test_a_system_is_watched_by_a_model_of_ones_own(shop: Shop) -> None:
    model = System()
    model.node("feed", out=["/prices"])
    model.node("matcher", out={"/matches": ["/prices"]})
    rates = [diagnosis.observer(topic[1:], hf.start(GeneralObserver, topic, 5.0)) for topic in ("/prices", "/matches")]
    addresses = {name: f"/t/shop/{name}" for name in NAMES}
    watching = await diagnosis.watch(shop.system, model, rates, addresses=addresses, repair="on", policy=POLICY)
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
    assert "ok(shop/feed.restarts)" in set(map(str, (await watching.observed()).negative))
    assert str(found) == "faulty: shop/feed"


async def test_what_a_restart_does_not_help_is_restarted_with_its_supervisor_and_then_given_up(shop: Shop) -> None:
    # T62: the cheapest first.
    model = System()
    model.node("feed", out=["/news"])  # nobody publishes that
    model.external("/prices")
    rate = diagnosis.observer("news", hf.start(GeneralObserver, "/news", 5.0))
    await diagnosis.watch(shop.system, model, [rate], addresses={"feed": "/t/shop/feed"}, repair="on", policy=POLICY)
    over = await shop.hear(GaveUp)
    assert over.components == ("feed",)
    assert shop.done() == ["restart_child(feed)", "restart_subtree(feed)"]


@pytest.mark.parametrize("says", ["no", "nothing"])
async def test_what_is_not_allowed_is_not_done_in_another_way(shop: Shop, says: str) -> None:
    policy = Policy(verify=8.0, settle=1.0, dangerous=frozenset({"restart_child"}), approval=20.0)
    watching = await diagnosis.watch(shop.system, repair="on", policy=policy)
    await asyncio.sleep(20.0)
    shop.part("feed").tell(Freeze())
    wanted = await shop.hear(ApprovalWanted)
    repairer = shop.system.ref(f"{watching.tree.path}/repairer", Repairer)
    if says == "no":
        await repairer.ask(Deny(wanted.case, "we look at it"))
    over = await shop.hear(GaveUp)
    assert over.components == ("shop/feed",)
    assert ("we look at it" if says == "no" else "nobody has approved") in over.why
    await asyncio.sleep(100.0)
    assert shop.done() == []


@pytest.mark.parametrize("how", ["by its supervisor", "by the system"])
async def test_what_an_operator_stops_is_not_repaired_before_an_operator_starts_it(shop: Shop, how: str) -> None:
    await diagnosis.watch(shop.system, repair="on", policy=POLICY)
    await asyncio.sleep(20.0)
    keeper = shop.system.ref("/t/shop", hf.Supervisor)
    if how == "by the system":
        await shop.system.stop(shop.part("feed"))
    else:
        await keeper.ask(hf.TerminateChild("feed"))
    await asyncio.sleep(100.0)
    assert shop.done() == []
    if how == "by the system":  # It has forgotten the spec, too.
        await keeper.ask(hf.StartChild(hf.child("feed", hf.start(Feed))))
    else:
        await keeper.ask(hf.RestartChild("feed"))
    await asyncio.sleep(20.0)
    shop.part("feed").tell(Freeze())
    await shop.hear(Repaired)
    assert shop.done() == ["restart_child(shop/feed)"]


async def test_who_was_restarted_by_its_supervisor_is_not_restarted_by_repair(shop: Shop) -> None:
    # T51, T63: for a window after each crash the rates are too low, which says nothing of the life that has begun.
    model = System()
    model.node("feed", out=["/prices"])
    model.node("matcher", out={"/matches": ["/prices"]})
    manner = Manner(every=0.1, time_to_live=2.0)
    rates = [
        diagnosis.observer(topic[1:], hf.start(GeneralObserver, topic, 5.0, 1.5, window=1.0, manner=manner))
        for topic in ("/prices", "/matches")
    ]
    slow = hf.Backoff(initial=0.45, maximum=0.45, jitter=0.0)
    keeper = shop.system.ref("/t/shop", hf.Supervisor)
    for name, kind in (("feed", Feed), ("matcher", Matcher)):
        await keeper.ask(hf.TerminateChild(name))
        await keeper.ask(hf.DeleteChild(name))
        await keeper.ask(hf.StartChild(hf.child(name, hf.start(kind), backoff=slow)))
    addresses = {name: f"/t/shop/{name}" for name in NAMES}
    policy = Policy(verify=8.0, settle=0.2, look=0.0)
    nodes = hf.start(NodeObserver, addresses, settling=2.0, manner=manner)
    watching = await diagnosis.watch(
        shop.system,
        model,
        [*rates, diagnosis.observer("lives", nodes)],
        addresses=addresses,
        repair="on",
        policy=policy,
        manner=manner,
    )
    await asyncio.sleep(10.0)
    for _ in range(5):
        shop.part("feed").tell(Fall())
        await asyncio.sleep(12.0)
        assert (await watching.diagnosis()).state is State.HEALTHY
    assert shop.done() == []
    assert shop.part("feed")._cell.life == 6
    shop.told.clear()
    shop.part("feed").tell(Freeze())
    await shop.hear(Repaired)
    assert shop.done() == ["restart_child(feed)"]


async def test_who_is_asked_in_vain_is_repaired(shop: Shop) -> None:
    keeper = shop.system.ref("/t/shop", hf.Supervisor)
    await keeper.ask(hf.StartChild(hf.child("cache", hf.start(Cache))))
    asker = hf.child("asker", hf.start(Asker), bindings={"cache": "/t/shop/cache"})
    await keeper.ask(hf.StartChild(asker))
    await diagnosis.watch(shop.system, repair="on", policy=POLICY, hung_after=2.0)
    await asyncio.sleep(20.0)
    shop.system.ref("/t/shop/cache", Cache).tell(Hang())
    await shop.hear(Repaired)
    assert "restart_child(shop/cache)" in shop.done()
    assert await shop.system.ref("/t/shop/cache", Cache).ask(Quote()) == 1


async def nobody_looks(shop: Shop) -> None:
    """End all observers for good: only the liar is left."""
    keeper = shop.system.ref("/t/diagnosis/observers", hf.Supervisor)
    for one in await keeper.ask(hf.WhichChildren()):
        await keeper.ask(hf.TerminateChild(one.id))


async def test_an_observer_that_lies_about_who_runs_costs_no_restart(shop: Shop) -> None:
    # The ping sees it: the feed runs and answers, whatever is said of it.
    await diagnosis.watch(shop.system, repair="on", policy=POLICY)
    await asyncio.sleep(20.0)
    await nobody_looks(shop)
    lie = Observation(~running("shop/feed"), shop.system._node.loop.time(), "liar", 1000.0)
    await shop.system.publish(diagnosis.OBSERVATIONS, lie)
    over = await shop.hear(GaveUp)
    assert over.why == "shop/feed runs and answers, although it is said not to run"
    assert "look whether liar is right to say not running(shop/feed)" in over.plan
    await asyncio.sleep(60.0)
    assert shop.done() == []


async def lie(shop: Shop, about: Literal) -> None:
    """Say for a long time that something does not hold."""
    word = Observation(~about, shop.system._node.loop.time(), "liar", 1000.0)
    await shop.system.publish(diagnosis.OBSERVATIONS, word)


async def test_who_rests_is_not_restarted_because_somebody_says_that_it_does_not_run(shop: Shop) -> None:
    keeper = shop.system.ref("/t/shop", hf.Supervisor)
    await keeper.ask(hf.StartChild(hf.child("clerk", hf.start(Clerk), recovery=hf.hybrid())))
    await diagnosis.watch(shop.system, repair="on", policy=POLICY)
    await asyncio.sleep(20.0)
    await nobody_looks(shop)
    shop.system.ref("/t/shop/clerk", Clerk).tell(Hang())
    await lie(shop, running("shop/clerk"))
    over = await shop.hear(GaveUp)
    assert over.why == "shop/clerk runs and answers, although it is said not to run"
    await asyncio.sleep(60.0)
    assert shop.done() == []


@pytest.mark.parametrize("where", ["elsewhere", "below the same supervisor"])
async def test_what_is_harmless_does_not_wait_for_the_approval_of_what_is_not(shop: Shop, where: str) -> None:
    office = "/t/shop" if where == "below the same supervisor" else "/t/office"
    spec = hf.child("clerk", hf.start(Clerk))
    if office == "/t/office":
        await shop.system.start(hf.supervisor("office", children=[spec]))
    else:
        await shop.system.ref(office, hf.Supervisor).ask(hf.StartChild(spec))
    model = System()
    model.node("clerk", out=["/news"])
    model.node("feed", out=["/prices"])
    addresses = {"clerk": f"{office}/clerk", "feed": "/t/shop/feed"}
    rate = diagnosis.observer("prices", hf.start(GeneralObserver, "/prices", 5.0))
    policy = Policy(verify=8.0, settle=1.0, approval=300.0)
    await diagnosis.watch(shop.system, model, [rate], addresses=addresses, repair="on", policy=policy)
    await asyncio.sleep(20.0)
    await lie(shop, ok("/news"))
    first = await shop.hear(ApprovalWanted)
    assert (shop.done(), [str(step) for step in first.steps]) == (["restart_child(clerk)"], ["restart_subtree(clerk)"])
    shop.part("feed").tell(Freeze())
    await asyncio.sleep(40.0)
    last = [one for one in shop.told if isinstance(one, ApprovalWanted)][-1]
    if office == "/t/shop":  # The restart of the supervisor is one of the feed, too.
        assert shop.done() == ["restart_child(clerk)"]
        assert {str(step) for step in last.steps} == {"restart_child(feed)", "restart_subtree(clerk)"}
    else:
        assert shop.done() == ["restart_child(clerk)", "restart_child(feed)"]
        assert [str(step) for step in last.steps] == ["restart_subtree(clerk)"]
        assert shop.part("feed")._cell.life == 2


async def test_an_observer_that_lies_about_an_output_costs_one_restart_and_no_second(shop: Shop) -> None:
    watching = await diagnosis.watch(shop.system, repair="on", policy=Policy(verify=8.0))
    await asyncio.sleep(20.0)
    await nobody_looks(shop)
    lie = Observation(~ok("/prices"), shop.system._node.loop.time(), "liar", 1000.0)
    await shop.system.publish(diagnosis.OBSERVATIONS, lie)
    over = await shop.hear(GaveUp)
    assert "look whether liar is right to say not ok(/prices)" in over.plan
    await asyncio.sleep(100.0)
    assert shop.done() == ["restart_child(shop/feed)"]
    status = await watching.repair_status()
    assert (status.useless, status.given_up) == (1, ("shop/feed",))


async def test_by_default_repair_only_advises_and_the_program_can_switch_it_on(shop: Shop) -> None:
    watching = await diagnosis.watch(shop.system, policy=POLICY)
    await asyncio.sleep(20.0)
    shop.part("feed").tell(Freeze())
    plan = await shop.hear(Planned)
    await asyncio.sleep(30.0)
    assert (plan.is_dry, shop.done()) == (True, [])
    await watching.set_repair("on")
    await shop.hear(Repaired)
    assert shop.done() == ["restart_child(shop/feed)"]


async def test_with_repair_off_there_is_nobody_to_repair(shop: Shop) -> None:
    watching = await diagnosis.watch(shop.system, repair="off", seconds=0.0)
    with pytest.raises(NoSuchActor):
        await watching.repair_status()


async def test_a_stance_that_there_is_not_is_refused_before_anything_is_started(shop: Shop) -> None:
    with pytest.raises(ValueError, match="'advise'"):
        await diagnosis.watch(shop.system, repair="true")  # type: ignore[arg-type]
    assert shop.system._node.find("/t/diagnosis") is None


@pytest.mark.parametrize("says", [True, False, "not before noon", RuntimeError("no network")])
async def test_a_callable_of_the_program_approves_or_denies(shop: Shop, says: bool | str | Exception) -> None:
    async def approve(wanted: ApprovalWanted) -> bool | str:
        assert [str(step) for step in wanted.steps] == ["restart_child(shop/feed)"]
        if isinstance(says, Exception):
            raise says
        return says

    watching = await diagnosis.watch(shop.system, repair="ask", policy=POLICY, approve=approve)
    await asyncio.sleep(20.0)
    shop.part("feed").tell(Freeze())
    if says is True:
        await shop.hear(Repaired)
        return
    over = await shop.hear(GaveUp)
    assert (str(says) if says else "the program said no") in over.why
    assert (await watching.repair_status()).denied == ("shop/feed",)
    assert shop.done() == []


async def test_a_denied_restart_of_an_actor_is_no_leave_to_restart_all_around_it(shop: Shop) -> None:
    watching = await diagnosis.watch(shop.system, repair="ask", policy=POLICY)
    await asyncio.sleep(20.0)
    shop.part("feed").tell(Freeze())
    wanted = await shop.hear(ApprovalWanted)
    await watching.repairer.ask(Deny(wanted.case, "we look at it"))
    await shop.hear(GaveUp)
    await watching.set_repair("on")
    keeper = shop.system.ref("/t/shop", hf.Supervisor)
    await keeper.ask(hf.TerminateChild("matcher", parks=False))  # as if it had ended for good by itself
    await asyncio.sleep(60.0)
    assert set(shop.done()) == {"restart_child(shop/matcher)"}


async def test_what_repair_tells_is_no_dead_letter_and_an_event_in_plain_words(shop: Shop) -> None:
    await diagnosis.watch(shop.system, repair="on", policy=POLICY)
    await asyncio.sleep(20.0)
    with shop.system.events() as events:
        shop.part("feed").tell(Freeze())
        await shop.hear(Repaired)
        await asyncio.sleep(5.0)
        told = events.take()
    assert [one for one in told if isinstance(one, DeadLetter)] == []
    sentences = [one.text for one in told if isinstance(one, RepairTold)]
    assert "For shop/feed repair will do restart_child(shop/feed)." in sentences
    assert any(text.startswith("The symptoms went by restart_child(shop/feed)") for text in sentences)


async def test_who_is_suspended_by_order_is_not_restarted(shop: Shop) -> None:
    await diagnosis.watch(shop.system, repair="on", policy=POLICY)
    await asyncio.sleep(20.0)
    await shop.system.suspend(shop.part("feed"))
    over = await shop.hear(GaveUp)
    assert "shop/feed was suspended by order" in over.why
    assert [one for one in over.plan if "feed" in one] == [f"holdfast resume {shop.part('feed').path}"]
    assert "restart_child(shop/feed)" not in shop.done()
