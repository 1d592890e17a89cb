"""Children that come after `watch` began, and names of every kind: the model, the observers and repair follow."""

import asyncio
from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.actors.events import ActorCrashed
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.generate import generate
from holdfast.diagnosis.literals import ok, word_for
from holdfast.diagnosis.model import Expectation
from holdfast.diagnosis.observers import Limits, Manner, Observer, Property
from holdfast.testing import advance

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

NAMES = ["left arm", "a (b), c", 'it\'s "q"', "100%", "Köln ☃ 左", "\u3000", "ok(x)", "x" * 200]


class Tick(hf.Message):
    pass


class Item(hf.Message):
    pass


class Freeze(hf.Message):
    pass


class Fall(hf.Message):
    pass


class Talker(hf.Actor):
    """Publishes on a topic of its own name, until it freezes; a new life goes on."""

    def on_start(self, restored: bool) -> None:
        self.timer = self.ctx.every(0.1, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        await self.ctx.publish(f"/{self.ctx.path.rpartition('/')[2]}", Item())

    @hf.on(Freeze)
    def _freeze(self, message: Freeze) -> None:
        self.timer.cancel()

    @hf.on(Fall)
    def _fall(self, message: Fall) -> None:
        raise RuntimeError("as told")


class Ear(hf.Actor):
    """Is there for what is published; topics without subscribers are not listened to."""

    def __init__(self, topic: str) -> None:
        self._topic = topic

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe(self._topic)

    @hf.on(Item)
    def _take(self, message: Item) -> None:
        pass


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running


async def crashes_of_diagnosis(system: hf.ActorSystem, act: float) -> int:
    """Let time pass; the crashes below diagnosis meanwhile."""
    stream = system._node.events.listen()
    await advance(act)
    count = sum(isinstance(event, ActorCrashed) for event in stream.take())
    stream.close()
    return count


async def test_actors_of_any_name_are_diagnosed_and_repaired_whenever_they_come(system: hf.ActorSystem) -> None:
    """Half of them are there at first; each freezes and is restarted, and nobody else is."""
    first, later = NAMES[::2], NAMES[1::2]
    for name in NAMES:
        system.spawn(hf.start(Ear, f"/{name}"))
    keeper = await system.start(hf.supervisor("all", children=[hf.child(name, hf.start(Talker)) for name in first]))
    watching = await diagnosis.watch(system, seconds=2.5, repair="on")
    for name in later:
        await keeper.ask(hf.StartChild(hf.child(name, hf.start(Talker))))
    assert await crashes_of_diagnosis(system, 10.0) == 0
    assert watching.addresses == {f"all/{word_for(name)}": f"/t/all/{name}" for name in NAMES}
    found = await watching.diagnosis()
    assert found.state is State.HEALTHY
    assert set(found.components) == set(watching.addresses)
    for name in NAMES:
        talker = system.ref(f"/t/all/{name}", Talker)
        talker.tell(Freeze())
        await advance(4.5)
        assert (await watching.diagnosis()).certain in {(f"all/{word_for(name)}",), ()}
        async with asyncio.timeout(60.0):
            while (await system.get_status(talker)).life == 1:
                await advance(0.5)
    await advance(5.0)
    assert [(await system.get_status(system.ref(f"/t/all/{name}", Talker))).life for name in NAMES] == [2] * len(NAMES)
    assert [story.entries[-1].what for story in await watching.stories()][-len(NAMES) :] == ["Repaired"] * len(NAMES)


async def test_topics_and_replies_are_named_by_words(system: hf.ActorSystem) -> None:
    await system.start(hf.child("left arm", hf.start(Talker)))
    system.spawn(hf.start(Ear, "/left arm"))
    await advance(0.1)
    found = await generate(system, seconds=0.5)
    assert found.addresses == {"left%20arm": "/t/left arm"}
    assert found.declaration.components[0].out.keys() == {"/left%20arm", "replies(left%20arm)"}


SHORT = {Property.MAILBOX: Limits(high=10.0)}
"""At most so many messages wait."""


async def pair(system: hf.ActorSystem, *names: str) -> list[hf.ActorRef[hf.Supervisor]]:
    """Two supervisors; the first one has talkers of these names."""
    talkers = [hf.child(name, hf.start(Talker)) for name in names]
    return [
        await system.start(hf.supervisor(name, children=some, intensity=100))
        for name, some in (("one", talkers), ("two", []))
    ]


async def pile_up(system: hf.ActorSystem, watching: diagnosis.Watch, path: str) -> set[str]:
    """Have more messages wait for an actor than it may; return what is not ok of properties, and let it go on."""
    talker = system.ref(path, Talker)
    await system.suspend(talker)
    for _ in range(20):
        talker.tell(Tick())
    await advance(5.0)
    seen = {str(atom) for atom in (await watching.observed()).negative if str(atom).endswith(".mailbox)")}
    await system.resume(talker)
    await advance(5.0)
    return seen


async def test_limits_follow_children_that_come_later(system: hf.ActorSystem) -> None:
    one, two = await pair(system, "first")
    watching = await diagnosis.watch(system, seconds=0.5, limits={"one/*": SHORT})
    assert await pile_up(system, watching, "/t/one/first") == {"ok(one/first.mailbox)"}
    await one.ask(hf.StartChild(hf.child("later", hf.start(Talker))))
    await two.ask(hf.StartChild(hf.child("later", hf.start(Talker))))
    await advance(3.0)
    assert await pile_up(system, watching, "/t/one/later") == {"ok(one/later.mailbox)"}
    assert await pile_up(system, watching, "/t/two/later") == set()


async def test_limits_go_with_an_actor_that_is_moved_and_its_name_keeps_them_for_the_next(
    system: hf.ActorSystem,
) -> None:
    one, two = await pair(system, "left", "right")
    watching = await diagnosis.watch(system, seconds=0.5, limits={"one/left": SHORT})
    async with system.transaction() as change:
        change.move("/t/one/left", two)
    await advance(3.0)
    assert await pile_up(system, watching, "/t/two/left") == {"ok(two/left.mailbox)"}
    assert await pile_up(system, watching, "/t/one/right") == set()
    await one.ask(hf.StartChild(hf.child("left", hf.start(Talker))))
    await advance(3.0)
    assert await pile_up(system, watching, "/t/one/left") == {"ok(one/left.mailbox)"}
    assert await pile_up(system, watching, "/t/two/left") == {"ok(two/left.mailbox)"}
    assert await crashes_of_diagnosis(system, 5.0) == 0


async def test_limits_of_a_component_that_there_is_not_are_refused(system: hf.ActorSystem) -> None:
    await pair(system, "left")
    why = "limits are given for 'one/lefd', and no component has that name; did you mean 'one/left'"
    with pytest.raises(ValueError, match=why):
        await diagnosis.watch(system, seconds=0.5, limits={"one/lefd": SHORT})


async def exchange(system: hf.ActorSystem) -> None:
    """Have `/t/one/both` and `/t/two/both` change places at once."""
    aside = await system.start(hf.supervisor("aside"))
    async with system.transaction() as change:
        change.move("/t/one/both", aside)
        change.move("/t/two/both", "/t/one")
        change.move("/t/aside/both", "/t/two")
    await advance(3.0)


async def test_actors_that_change_places_take_their_limits_with_them(system: hf.ActorSystem) -> None:
    """The wiring is as before: that alone tells nobody that they have been exchanged."""
    _, two = await pair(system, "both")
    await two.ask(hf.StartChild(hf.child("both", hf.start(Talker))))
    watching = await diagnosis.watch(system, seconds=0.5, limits={"[o]ne/both": SHORT})
    await exchange(system)
    assert await pile_up(system, watching, "/t/two/both") == {"ok(two/both.mailbox)"}


async def test_lives_of_another_actor_at_the_address_are_no_restarts(system: hf.ActorSystem) -> None:
    _, two = await pair(system, "both")
    await two.ask(hf.StartChild(hf.child("both", hf.start(Talker))))
    for _ in range(5):
        system.ref("/t/one/both", Talker).tell(Fall())
        await advance(1.0)
    watching = await diagnosis.watch(system, seconds=0.5, limits={"*/both": {Property.RESTARTS: Limits(high=3.5)}})
    await advance(3.0)
    await exchange(system)
    seen = {str(atom) for atom in (await watching.observed()).negative if str(atom).endswith(".restarts)")}
    assert seen == set()


class Silent(Observer):
    """It says of each component on its list that its own atom does not hold."""

    def __init__(self, *atoms: str) -> None:
        super().__init__(manner=Manner(every=0.5, time_to_live=3.0))
        self._atoms = atoms

    def look(self) -> None:
        for atom in self._atoms:
            self.verdict(ok(atom), False)


async def test_what_is_expected_of_ones_own_observer_is_kept_while_the_model_follows(system: hf.ActorSystem) -> None:
    system.spawn(hf.start(Ear, "/a"))
    keeper = await system.start(hf.supervisor("all", children=[hf.child("a", hf.start(Talker))]))
    noise = diagnosis.observer("noise", hf.start(Silent, "noise"))
    expected = [Expectation("ok(noise)", ("all/a",))]
    watching = await diagnosis.watch(system, None, [noise], expect=expected, seconds=2.5, repair="off")
    await advance(3.0)
    assert (await watching.diagnosis()).certain == ("all/a",)
    await keeper.ask(hf.StartChild(hf.child("b", hf.start(Talker))))
    await advance(5.0)
    found = await watching.diagnosis()
    assert set(found.components) == {"all/a", "all/b"}
    assert found.certain == ("all/a",)
    assert (await watching.why()).refused == ()


async def test_what_is_expected_of_nobody_is_refused(system: hf.ActorSystem) -> None:
    await system.start(hf.child("pump", hf.start(Ear, "/a")))
    with pytest.raises(ValueError, match=r"ok\(noise\) is expected of 'pumb', .* did you mean 'pump'"):
        await diagnosis.watch(system, expect=[Expectation("ok(noise)", ("pumb",))], seconds=0.5, repair="off")
