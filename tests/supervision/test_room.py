"""Room and load: asked of any actor, wherever it lives and whether it is recorded, in pools and on topics."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf

TOPIC = "/room"
PLACES: list[tuple[Any, Any]] = [("task", None), ("task", hf.hybrid()), ("process", None), ("process", hf.hybrid())]
NAMES = ["task", "recorded-task", "process", "recorded-process"]
everywhere = pytest.mark.parametrize(("isolation", "recovery"), PLACES, ids=NAMES)


class Item(hf.Message[None]):
    n: int


class Taken(hf.Message[list[int]]): ...


class Where(hf.Message[str]): ...


class Publish(hf.Message[int]):
    first: int
    last: int


class Subscribe(hf.Message[None]):
    on: bool


class TellOther(hf.Message[None]):
    first: int
    last: int


class SendSelf(hf.Message[int]):
    last: int


class Reader(hf.Actor):
    """Takes two turns for each item, so that others come in between."""

    def __init__(self) -> None:
        self.taken: list[int] = []

    @hf.on(Item)
    async def item(self, message: Item) -> None:
        await asyncio.sleep(0)
        self.taken.append(message.n)

    @hf.on(Taken)
    def all_taken(self, message: Taken) -> list[int]:
        return list(self.taken)

    @hf.on(Where)
    def where(self, message: Where) -> str:
        return self.ctx.path.rpartition("/")[2]

    @hf.on(Subscribe)
    def change(self, message: Subscribe) -> None:
        if message.on:
            self.ctx.subscribe(TOPIC)
        else:
            self.ctx.unsubscribe(TOPIC)


class Listener(Reader):
    @hf.subscribe(TOPIC)
    @hf.on(Item)
    async def item(self, message: Item) -> None:
        await super().item(message)


class Writer(hf.Actor):
    other: hf.Binding[hf.Actor]

    @hf.on(Publish)
    async def publish(self, message: Publish) -> int:
        for n in range(message.first, message.last):
            await self.ctx.publish(TOPIC, Item(n))
        return message.last - message.first

    @hf.on(SendSelf)
    async def send_self(self, message: SendSelf) -> int:
        for n in range(message.last):
            try:
                await self.ctx.ref.send(Item(n))
            except hf.MailboxFull:
                return n
        return message.last

    @hf.on(TellOther)
    def tell_other(self, message: TellOther) -> None:
        for n in range(message.first, message.last):
            self.other.tell(Item(n))


class Echo(Writer, Listener):
    """Hears what it says."""


# -- pools -----------------------------------------------------------------------------------------------------------


@everywhere
async def test_a_pool_of_bounded_workers_loses_nothing(isolation: Any, recovery: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        worker = hf.child(None, hf.start(Reader), isolation=isolation, recovery=recovery, mailbox=hf.bounded(2))
        await system.start(hf.supervision.pool("w", worker, 2, mailbox=hf.bounded(2)))
        pool = hf.supervision.pool_of(system, "/app/w", Reader)
        for n in range(40):
            await asyncio.wait_for(pool.send(Item(n)), 60)
        taken: list[int] = []
        while len(taken) < 40 and not system.dead_letters:
            taken = [n for at in (0, 1) for n in await system.ref(f"/app/w/{at}", Reader).ask(Taken(), 60)]
        assert system.dead_letters == 0
        assert sorted(taken) == list(range(40))


async def test_a_pool_in_a_process_of_its_own_loses_nothing_whose_homes_are_at_the_root() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        worker = hf.child(None, hf.start(Reader), recovery=hf.hybrid(), mailbox=hf.bounded(2))
        pool = hf.supervision.pool("w", worker, 2, mailbox=hf.bounded(2))
        await system.start(hf.supervisor("apart", children=[pool], isolation="process"))
        router = system.ref("/app/apart/w/router", hf.Actor)
        workers = [system.ref(f"/app/apart/w/{at}", Reader) for at in (0, 1)]
        for one in workers:
            await system.suspend(one)
        sends = [asyncio.ensure_future(router.send(Item(n))) for n in range(60)]
        for _ in range(20):
            await system.ref("/app/apart/w", hf.supervision.PoolSupervisor).ask(hf.supervision.PoolInfo(), 60)
        assert sum(send.done() for send in sends) < 20, "2 wait at each of three, 2 are on the way to each worker"
        assert system.dead_letters == 0
        for one in workers:
            await system.resume(one)
        await asyncio.wait_for(asyncio.gather(*sends), 60)
        taken: list[int] = []
        while len(taken) < 60 and not system.dead_letters:
            taken = [n for one in workers for n in await one.ask(Taken(), 60)]
        assert (sorted(taken), system.dead_letters) == (list(range(60)), 0)


@pytest.mark.parametrize("mailbox", [None, hf.bounded(9)], ids=["unbounded", "bounded"])
@everywhere
async def test_least_loaded_knows_who_has_messages(isolation: Any, recovery: Any, mailbox: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        worker = hf.child(None, hf.start(Reader), isolation=isolation, recovery=recovery, mailbox=mailbox)
        await system.start(hf.supervision.pool("w", worker, 2, routing="least_loaded"))
        pool = hf.supervision.pool_of(system, "/app/w", Reader)
        for busy in ("0", "1"):
            one = system.ref(f"/app/w/{busy}", Reader)
            await system.suspend(one)
            for n in range(4):
                await one.send(Item(n))
            assert {await pool.ask(Where(), 60) for _ in range(2)} == {"1" if busy == "0" else "0"}
            await system.resume(one)
            while len(await one.ask(Taken(), 60)) < 4:
                pass


# -- topics ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("listener", [None, hf.hybrid()], ids=["to-plain", "to-recorded"])
@everywhere
async def test_a_publisher_waits_for_room(isolation: Any, recovery: Any, listener: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        slow = await system.start(hf.child("slow", hf.start(Listener), recovery=listener, mailbox=hf.bounded(3)))
        writer = await system.start(hf.child("writer", hf.start(Writer), isolation=isolation, recovery=recovery))
        assert await writer.ask(Publish(0, 25), 60) == 25
        taken: list[int] = []
        while len(taken) < 25 and not system.dead_letters:
            taken = await slow.ask(Taken(), 60)
        assert (taken, system.dead_letters) == (list(range(25)), 0)


@everywhere
async def test_a_full_recorded_subscriber_holds_the_publisher_back(isolation: Any, recovery: Any) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        full = await system.start(
            hf.child("full", hf.start(Listener), recovery=hf.hybrid(), mailbox=hf.bounded(1)),
        )
        other = await system.start(hf.child("other", hf.start(Listener)))
        writer = await system.start(hf.child("writer", hf.start(Writer), isolation=isolation, recovery=recovery))
        await system.suspend(full)
        published = writer.ask(Publish(0, 9), 60)
        while 1 not in await other.ask(Taken(), 60):
            assert not published.done()
        for _ in range(50):
            assert max(await other.ask(Taken(), 60)) < 5, "it has room for one, and one is on its way"
        await system.resume(full)
        await published
        assert await full.ask(Taken(), 60) == list(range(9))


@pytest.mark.parametrize("publisher", ["system", *NAMES])
async def test_one_full_subscriber_holds_back_the_publisher_and_no_other_subscriber(publisher: str) -> None:
    """And who has left the topic meanwhile, or has begun a life that never was there, does not get it."""
    async with hf.ActorSystem("app", log=False) as system:
        full, other, leaving = [
            await system.start(hf.child(name, hf.start(Reader), mailbox=hf.bounded(1)))
            for name in ("full", "other", "leaving")
        ]
        for reader in (full, leaving, other):
            await reader.ask(Subscribe(on=True), 60)
        for reader in (full, leaving):
            await system.suspend(reader)
            await reader.send(Item(0))
        if publisher == "system":
            published: asyncio.Future[Any] = asyncio.ensure_future(system.publish(TOPIC, Item(1)))
        else:
            isolation, recovery = dict(zip(NAMES, PLACES, strict=True))[publisher]
            spec: Any = hf.child("writer", hf.start(Writer), isolation=isolation, recovery=recovery)
            published = (await system.start(spec)).ask(Publish(1, 2), 60)
        while await other.ask(Taken(), 60) != [1]:
            assert not published.done(), "the others are full"
        system._node.topics.unsubscribe(TOPIC, leaving._cell)
        for reader in (leaving, full):
            assert not published.done(), "it waits for who is full"
            await system.resume(reader)
        await asyncio.wait_for(published, 60)
        assert [await reader.ask(Taken(), 60) for reader in (full, leaving, other)] == [[0, 1], [0], [1]]
        assert system.dead_letters == 0


@pytest.mark.parametrize(
    ("below", "isolation", "recovery"),
    [*((None, *place) for place in PLACES), *(("process", *place) for place in PLACES[:2])],
    ids=[*NAMES, *(f"{name}-below-a-process" for name in NAMES[:2])],
)
async def test_who_is_full_of_its_own_messages_does_not_wait_for_itself(
    below: Any, isolation: Any, recovery: Any
) -> None:
    """Its turn makes no room while it waits. What is not taken is a dead letter, and others get it all."""
    async with hf.ActorSystem("app", log=False) as system:
        with system.events() as events:
            other = await system.start(hf.child("other", hf.start(Listener)))
            echo = hf.child(
                "echo", hf.start(Echo), isolation=isolation, recovery=recovery, mailbox=hf.bounded(2), start_timeout=60
            )
            await system.start(echo if below is None else hf.supervisor("below", children=[echo], isolation=below))
            ref = system.ref("/app/echo" if below is None else "/app/below/echo", Echo)
            assert await ref.ask(Publish(0, 9), 60) == 9
            taken = [*await ref.ask(Taken(), 60)]
            lost = [event.message.n for event in events.take() if isinstance(event, hf.events.DeadLetter)]
            assert taken + lost == list(range(9))
            assert bool(lost) == (recovery is None), "a recorded actor has room for what it says itself"
            assert await other.ask(Taken(), 60) == list(range(9))
            sent = await ref.ask(SendSelf(9), 60)
            assert await ref.ask(Taken(), 60) == [*taken, *range(sent)]
            assert sent == (2 if recovery is None and isolation == "task" else 9)


# -- who waits, and does not take the room ----------------------------------------------------------------------------


class Leftover(hf.Actor):
    """Leaves a task of its own behind that still sends when this life is over."""

    def __init__(self, to: hf.ActorRef[Reader], left: list[asyncio.Task[None]]) -> None:
        self._to, self._left = to, left

    @hf.on(Where)
    async def begin(self, message: Where) -> str:
        self._left.append(asyncio.get_running_loop().create_task(self._to.send(Item(100))))
        await asyncio.sleep(0)
        return ""


@everywhere
async def test_a_place_that_the_woken_sender_does_not_take_is_the_next_one_s(isolation: Any, recovery: Any) -> None:
    """The first in the row is a sender whose life has ended: it may not send, and the second one does."""
    async with hf.ActorSystem("app", log=False) as system:
        box = await system.start(
            hf.child("box", hf.start(Reader), isolation=isolation, recovery=recovery, mailbox=hf.bounded(1))
        )
        left: list[asyncio.Task[None]] = []
        leftover = system.spawn(hf.start(Leftover, box, left))
        await system.suspend(box)
        sent = 0
        while box._cell.has_room:
            await box.send(Item(sent))
            sent += 1
        await leftover.ask(Where())
        await system.stop(leftover)
        second = asyncio.ensure_future(box.send(Item(101)))
        await asyncio.sleep(0)
        assert not second.done()
        await system.resume(box)
        await asyncio.wait_for(second, 60)
        with pytest.raises(hf.ActorStopped, match="this life is over"):
            await left[0]
        taken: list[int] = []
        while 101 not in taken:
            taken = await box.ask(Taken(), 60)
        assert taken == [*range(sent), 101]


# -- what is lost -----------------------------------------------------------------------------------------------------


@everywhere
@pytest.mark.parametrize("receiver", [None, hf.hybrid()], ids=["to-plain", "to-recorded"])
async def test_what_a_full_mailbox_refuses_is_told_as_the_message_it_was(
    isolation: Any, recovery: Any, receiver: Any
) -> None:
    """A tell from the same process raises, and here ends the teller; one from elsewhere or a recorded turn cannot."""
    async with hf.ActorSystem("app", log=False) as system:
        with system.events() as events:
            full = await system.start(hf.child("full", hf.start(Reader), recovery=receiver, mailbox=hf.bounded(1)))
            await system.suspend(full)
            while full._cell.has_room:
                await full.send(Item(0))
            writer = await system.start(
                hf.child(
                    "writer", hf.start(Writer), isolation=isolation, recovery=recovery, bindings={"other": "/app/full"}
                )
            )
            told = writer.ask(TellOther(5, 6), 60)
            if (isolation, recovery) == ("task", None):
                with pytest.raises(hf.RemoteCrash, match="mailbox of /app/full is full"):
                    await told
            else:
                await told
                async for event in events:
                    if isinstance(event, hf.events.DeadLetter):
                        assert (event.address, event.message) == ("/app/full", Item(5))
                        assert "is full" in event.why
                        break
            await system.resume(full)
