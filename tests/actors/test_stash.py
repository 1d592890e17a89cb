"""Stash: messages put aside come again, in order, before what is queued."""

import asyncio

import pytest

import holdfast as hf


class Item(hf.Message[int]):
    n: int = 0


class Open(hf.Message[None]): ...


class Twice(hf.Message[str]): ...


class Crash(hf.Message[None]): ...


class Seen(hf.Message[list[int]]): ...


class Shop(hf.Actor):
    """Closed at first: customers wait."""

    def __init__(self) -> None:
        self.open = False
        self.seen: list[int] = []

    @hf.on(Item)
    async def serve(self, message: Item) -> int:
        if not self.open:
            self.ctx.stash()
            return -1  # no reply: it was stashed
        await asyncio.sleep(0)
        self.seen.append(message.n)
        return message.n

    @hf.on(Open)
    def unlock(self, message: Open) -> None:
        self.open = True
        self.ctx.unstash()

    @hf.on(Twice)
    def twice(self, message: Twice) -> str:
        self.ctx.stash()
        self.ctx.stash()
        return ""

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError

    @hf.on(Seen)
    def look(self, message: Seen) -> list[int]:
        return list(self.seen)


async def test_stashed_messages_come_back_in_order_before_later_ones(system: hf.ActorSystem) -> None:
    shop = system.spawn(hf.start(Shop))
    for number in (1, 2):
        shop.tell(Item(number))
    asked = shop.ask(Item(3))
    await system._node.settled()
    shop.tell(Open())
    shop.tell(Item(4))
    assert await asked == 3
    assert await shop.ask(Item(5)) == 5
    assert await shop.ask(Seen()) == [1, 2, 3, 4, 5]


async def test_a_stashed_ask_has_no_reply_until_it_is_handled(system: hf.ActorSystem) -> None:
    shop = system.spawn(hf.start(Shop))
    asked = shop.ask(Item(1))
    await system._node.settled()
    assert not asked.done()
    await shop.ask(Open())
    assert await asked == 1


class Later(hf.Message[None]): ...


class Patient(Shop):
    """Lets customers in from a background task, when no message wakes it."""

    @hf.on(Later)
    def later(self, message: Later) -> None:
        async def open_soon() -> None:
            await asyncio.sleep(0)
            self.open = True
            self.ctx.unstash()

        self.ctx.create_task(open_soon())


async def test_unstash_wakes_an_actor_that_is_idle(system: hf.ActorSystem) -> None:
    """Also from background work, behind which no message comes."""
    shop = system.spawn(hf.start(Patient))
    asked = shop.ask(Item(1))
    await shop.ask(Later())
    assert await asked == 1


async def test_one_message_instance_sent_twice_is_two_messages(system: hf.ActorSystem) -> None:
    shop, same = system.spawn(hf.start(Shop)), Item(7)
    shop.tell(same)
    shop.tell(same)
    await shop.ask(Open())
    await system._node.settled()
    assert await shop.ask(Seen()) == [7, 7]


async def test_stashing_twice_in_a_turn_is_an_error(system: hf.ActorSystem) -> None:
    shop = system.spawn(hf.start(Shop))
    with system.events() as stream:
        shop.tell(Twice())
        await system._node.settled()
        assert any("stashed or forwarded already" in str(getattr(event, "reason", "")) for event in stream.take())


async def test_only_messages_can_be_stashed(system: hf.ActorSystem) -> None:
    class Starter(Shop):
        def on_start(self, restored: bool) -> None:
            self.ctx.stash()

    with pytest.raises(hf.StartFailed, match="only a message"):
        await system.start(hf.child("s", hf.start(Starter)))


async def test_the_stash_is_not_lost_in_a_crash(system: hf.ActorSystem) -> None:
    shop = await system.start(hf.child("shop", hf.start(Shop)))
    for number in (1, 2):
        shop.tell(Item(number))
    with pytest.raises(hf.RemoteCrash):
        await shop.ask(Crash())
    shop.tell(Item(3))
    await shop.ask(Open())
    await system._node.settled()
    assert await shop.ask(Seen()) == [1, 2, 3]
    assert shop._cell.life == 2


async def test_stashed_asks_fail_when_the_actor_ends_for_good(system: hf.ActorSystem) -> None:
    shop = system.spawn(hf.start(Shop))
    asked = shop.ask(Item(1))
    shop.tell(Item(2))
    await system._node.settled()
    await system.stop(shop)
    with pytest.raises(hf.ActorStopped):
        await asked
    assert system.dead_letters == 1


async def test_a_stashed_message_takes_no_place_until_it_comes_back(system: hf.ActorSystem) -> None:
    shop = system.spawn(hf.start(Shop), mailbox=hf.bounded(3, overflow="reject"))
    for number in range(6):
        shop.tell(Item(number))
        await system._node.settled()
    await shop.ask(Open())
    await system._node.settled()
    assert await shop.ask(Seen()) == list(range(6))
    for number in range(3):
        shop.tell(Item(number))
    with pytest.raises(hf.MailboxFull):
        shop.tell(Item(9))
