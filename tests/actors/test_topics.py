"""Topics: many-to-many, in a name space of their own; a subscription ends with its life."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Probe, probe


class News(hf.Message[None]):
    n: int


class Seen(hf.Message[list[int]]): ...


class Other(hf.Message): ...


class Do(hf.Message[Any]):
    work: Any


class Reader(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[int] = []

    @hf.on(News)
    def news(self, message: News) -> None:
        self.seen.append(message.n)

    @hf.on(Seen)
    def look(self, message: Seen) -> list[int]:
        return self.seen

    @hf.on(Do)
    async def do(self, message: Do) -> Any:
        result = message.work(self)
        return await result if asyncio.iscoroutine(result) else result


class Subscriber(Reader):
    @hf.subscribe("/news")
    @hf.subscribe("/more")
    @hf.on(News)
    def news(self, message: News) -> None:
        super().news(message)


async def test_every_subscriber_gets_what_is_published_once(actor_system: GuardedSystem) -> None:
    reader, *probes = actor_system.spawn(hf.start(Subscriber)), probe(actor_system), probe(actor_system)
    for one in probes:
        one.subscribe("/news")
        one.subscribe("/news")  # twice is once
    for number in range(3):
        await actor_system.publish("/news", News(number))
    await actor_system.publish("/more", News(3))
    await actor_system.publish("/else", News(9))
    assert await reader.ask(Seen()) == [0, 1, 2, 3]
    for one in probes:
        for number in range(3):
            await one.expect(News(number))
        await one.expect_no_message()


async def test_subscriptions_at_run_time(system: hf.ActorSystem) -> None:
    reader = system.spawn(hf.start(Reader))
    await system.publish("/news", News(0))
    await reader.ask(Do(lambda actor: actor.ctx.subscribe("/news")))
    await system.publish("/news", News(1))
    await reader.ask(Do(lambda actor: actor.ctx.unsubscribe("/news")))
    await reader.ask(Do(lambda actor: actor.ctx.unsubscribe("/never")))
    await system.publish("/news", News(2))
    assert await reader.ask(Seen()) == [1]
    assert system._node.topics.names() == []


async def test_an_actor_publishes_with_itself_as_sender(actor_system: GuardedSystem, probe: Probe) -> None:
    probe.subscribe("/news")
    editor = actor_system.spawn(hf.start(Reader), "editor")
    await editor.ask(Do(lambda actor: actor.ctx.publish("/news", News(1))))
    await probe.expect(News(1))
    assert probe.sender == editor


async def test_a_restarted_actor_is_subscribed_as_its_class_says_and_no_more(system: hf.ActorSystem) -> None:
    reader = await system.start(hf.child("r", hf.start(Subscriber)))
    await reader.ask(Do(lambda actor: actor.ctx.subscribe("/run-time")))
    with pytest.raises(hf.RemoteCrash):
        await reader.ask(Do(lambda _: 1 / 0))
    await reader.ask(Seen())
    assert system._node.topics.names() == ["/more", "/news"]


async def test_a_stopped_subscriber_is_forgotten(actor_system: GuardedSystem, probe: Probe) -> None:
    """No dead letter comes of it: the fixture would tell."""
    probe.subscribe("/news")
    await probe.stop()
    await actor_system.publish("/news", News(1))
    assert actor_system._node.topics.names() == []


@pytest.mark.parametrize("inside", [False, True])
async def test_a_subscriber_that_cannot_take_it_does_not_keep_it_from_the_others(
    system: hf.ActorSystem, inside: bool
) -> None:
    """One ends while the publisher waits at another, one is full and fails, one has no handler."""

    class Deaf(hf.Actor):
        def __init__(self) -> None:
            self.ctx.subscribe("/news")

    gate = asyncio.Event()
    slow = system.spawn(hf.start(Subscriber), "slow", mailbox=hf.bounded(1))
    full = system.spawn(hf.start(Subscriber), "full", mailbox=hf.bounded(1, overflow="reject"))
    for busy in (slow, full):
        busy.tell(Do(lambda _: gate.wait()))
    await asyncio.sleep(0)
    for busy in (slow, full):
        busy.tell(News(0))
    ending = system.spawn(hf.start(Subscriber))
    system.spawn(hf.start(Deaf))
    last = system.spawn(hf.start(Subscriber))
    events, publisher = system.events(), ""
    if inside:
        editor = system.spawn(hf.start(Reader))
        publisher = editor.path
        published: Any = editor.ask(Do(lambda actor: actor.ctx.publish("/news", News(1))))
    else:
        published = asyncio.create_task(system.publish("/news", News(1)))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    await system.stop(ending)
    gate.set()
    await published
    events.close()
    letters = [one for one in events.take() if isinstance(one, hf.events.DeadLetter)]
    assert await last.ask(Seen()) == [1]
    assert await slow.ask(Seen()) == [0, 1]
    seen = await full.ask(Seen())
    assert seen in ([0], [0, 1])
    assert [one.sender for one in letters if one.address == full.path] == ([publisher] if seen == [0] else [])


@pytest.mark.parametrize("inside", [False, True])
async def test_a_subscriber_gets_only_what_it_has_a_handler_for(system: hf.ActorSystem, inside: bool) -> None:
    """The rest is for others, and no dead letter."""
    reader = system.spawn(hf.start(Subscriber))
    editor = system.spawn(hf.start(Reader))
    for message in (News(1), Seen(), News(2), Other()):
        if inside:
            await editor.ask(Do(lambda actor, message=message: actor.ctx.publish("/news", message)))
        else:
            await system.publish("/news", message)
    assert await reader.ask(Seen()) == [1, 2]
    assert system.dead_letters == 0


async def test_a_slow_subscriber_holds_the_publisher_back(system: hf.ActorSystem) -> None:
    gate = asyncio.Event()
    slow = system.spawn(hf.start(Subscriber), mailbox=hf.bounded(1))
    slow.tell(Do(lambda _: gate.wait()))
    await asyncio.sleep(0)
    await system.publish("/news", News(0))
    waiting = asyncio.create_task(system.publish("/news", News(1)))
    await asyncio.sleep(0)
    assert not waiting.done()
    gate.set()
    await waiting
    await system._node.settled()
    assert await slow.ask(Seen()) == [0, 1]


@pytest.mark.parametrize("topic", ["news", ""])
async def test_a_topic_begins_with_a_slash(system: hf.ActorSystem, topic: str) -> None:
    with pytest.raises(hf.SpecError, match="must start with '/'"):
        hf.subscribe(topic)
    with pytest.raises(hf.RemoteCrash, match="must start with '/'"):
        await system.spawn(hf.start(Reader)).ask(Do(lambda actor: actor.ctx.subscribe(topic)))


async def test_topics_and_addresses_are_different_name_spaces(system: hf.ActorSystem) -> None:
    one, other = system.spawn(hf.start(Reader), "news"), system.spawn(hf.start(Reader))
    await other.ask(Do(lambda actor: actor.ctx.subscribe("/t/news")))
    await system.publish("/t/news", News(1))
    assert (await one.ask(Seen()), await other.ask(Seen())) == ([], [1])


MIXIN = type("Mixin", (), {"news": Subscriber.news})


@pytest.mark.parametrize("base", [Subscriber, MIXIN], ids=["an actor", "a mixin"])
def test_what_stands_in_the_place_of_a_subscription_says_whether_it_is_one(base: type) -> None:
    bases = (base,) if issubclass(base, hf.Actor) else (base, hf.Actor)

    @hf.on(News)
    def news(self: object, message: News) -> None: ...

    says = r'Silent\.news .* subscribes.* write @subscribe\("/more"\) and @subscribe\("/news"\) above it, too'
    with pytest.raises(TypeError, match=says):
        type("Silent", bases, {"news": news})
    without: Any = type("Without", bases, {"news": None, "quietly": news})
    assert (without._topics, News in without._table) == ((), True)
    elsewhere: Any = type("Elsewhere", bases, {"news": hf.subscribe("/elsewhere")(news)})
    assert elsewhere._topics == ("/elsewhere",)
