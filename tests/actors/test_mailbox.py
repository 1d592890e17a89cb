"""Mailboxes: order, bounds, commands ahead of messages, and the fate of what is not handled (DESIGN 3, 4)."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import DeadLetter


class Put(hf.Message[int]):
    n: int


class Hold(hf.Message[None]):
    """Busy until the gate opens."""


class Seen(hf.Message[list[int]]): ...


class Poke(hf.Message[None]):
    """Tell oneself these numbers within one turn."""

    numbers: list[int]


class Pipe(hf.Message[None]): ...


class Box(hf.Actor):
    def __init__(self, gate: asyncio.Event | None = None) -> None:
        self._gate = gate or asyncio.Event()
        self.seen: list[int] = []

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.seen.append(message.n)
        return message.n

    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        await self._gate.wait()

    @hf.on(Seen)
    def look(self, message: Seen) -> list[int]:
        return list(self.seen)

    @hf.on(Poke)
    def poke(self, message: Poke) -> None:
        for number in message.numbers:
            self.ctx.ref.tell(Put(number))

    @hf.on(Pipe)
    async def pipe(self, message: Pipe) -> None:
        for number in range(5):
            self.ctx.pipe_to_self(asyncio.sleep(0, number), lambda n: Put(100 + n))
        await self._gate.wait()


class Sender(hf.Actor):
    """Sends a row of numbers to an actor, letting others run in between."""

    @hf.on(Poke)
    async def send(self, message: Poke) -> None:
        for number in message.numbers:
            self.box.tell(Put(number))
            await asyncio.sleep(0)

    box: hf.Binding[Box]


async def busy(system: hf.ActorSystem, mailbox: Any = None) -> tuple[hf.ActorRef[Box], asyncio.Event]:
    """An actor in the middle of a turn, with an empty queue."""
    gate = asyncio.Event()
    box = system.spawn(hf.start(Box, gate), mailbox=mailbox)
    box.tell(Hold())
    await asyncio.sleep(0)
    return box, gate


async def seen(box: hf.ActorRef[Box], gate: asyncio.Event) -> list[int]:
    """What it has handled once it is free."""
    gate.set()
    await box._cell.node.settled()
    return await box.ask(Seen())


def letters(stream: hf.events.EventStream) -> list[int]:
    return [event.message.n for event in stream.take() if isinstance(event, DeadLetter)]


async def test_tell_send_and_ask_of_one_sender_keep_their_order(system: hf.ActorSystem) -> None:
    box, gate = await busy(system)
    box.tell(Put(1))
    asked = box.ask(Put(2))
    await box.send(Put(3))
    box.tell(Put(4))
    assert await seen(box, gate) == [1, 2, 3, 4]
    assert await asked == 2


async def test_each_sender_s_messages_keep_their_order(system: hf.ActorSystem) -> None:
    box = system.spawn(hf.start(Box))
    senders = [system.spawn(hf.start(Sender)) for _ in range(3)]
    for sender in senders:
        system.bind(sender, "box", box)
    await asyncio.gather(*(sender.ask(Poke(list(range(100 * n, 100 * n + 50)))) for n, sender in enumerate(senders)))
    numbers = await box.ask(Seen())
    assert len(numbers) == 150
    for n in range(3):
        own = [number for number in numbers if number // 100 == n]
        assert own == sorted(own)


async def test_an_unbounded_mailbox_takes_everything(system: hf.ActorSystem) -> None:
    box, gate = await busy(system)
    for number in range(10_000):
        box.tell(Put(number))
    assert await seen(box, gate) == list(range(10_000))


# -- bounds ----------------------------------------------------------------------------------------------------------


async def test_block_a_tell_to_a_full_mailbox_raises(system: hf.ActorSystem) -> None:
    box, gate = await busy(system, hf.bounded(2))
    box.tell(Put(1))
    box.tell(Put(2))
    with pytest.raises(hf.MailboxFull) as full:
        box.tell(Put(3))
    assert (full.value.actor, full.value.capacity) == (box.path, 2)
    assert await seen(box, gate) == [1, 2]
    assert system.dead_letters == 0  # the sender knows


async def test_block_a_send_waits_for_room(system: hf.ActorSystem) -> None:
    box, gate = await busy(system, hf.bounded(1))
    sends = [asyncio.create_task(box.send(Put(number))) for number in range(4)]
    await asyncio.sleep(0)
    assert [send.done() for send in sends] == [True, False, False, False]
    gate.set()
    await asyncio.gather(*sends)
    assert await seen(box, gate) == [0, 1, 2, 3]


async def test_block_a_cancelled_send_passes_its_place_on(system: hf.ActorSystem) -> None:
    """The one that was woken for the free place is cancelled before it runs: the next one must be."""

    class Cancelling(Box):
        @hf.on(Put)
        def put(self, message: Put) -> int:
            if message.n == 0:
                assert first.cancel()  # taking this message has just woken it
            self.seen.append(message.n)
            return message.n

    gate = asyncio.Event()
    box = system.spawn(hf.start(Cancelling, gate), mailbox=hf.bounded(1))
    box.tell(Hold())
    await asyncio.sleep(0)
    box.tell(Put(0))
    first, second = (asyncio.create_task(box.send(Put(number))) for number in (1, 2))
    await asyncio.sleep(0)
    gate.set()
    async with asyncio.timeout(30):
        await second
    assert first.cancelled()
    assert await seen(box, gate) == [0, 2]


async def test_block_an_ask_waits_for_room_and_is_answered(system: hf.ActorSystem) -> None:
    box, gate = await busy(system, hf.bounded(1))
    asks = [box.ask(Put(number)) for number in range(4)]
    gate.set()
    assert await asyncio.gather(*asks) == [0, 1, 2, 3]


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_block_an_ask_that_waits_for_room_ends_at_its_deadline_unrun(system: hf.ActorSystem) -> None:
    box, gate = await busy(system, hf.bounded(1))
    box.tell(Put(1))
    with pytest.raises(hf.AskTimeout) as late:
        await box.ask(Put(2), timeout=1.0)
    assert late.value.handled is False
    box_free = box.ask(Put(3), timeout=100.0)
    assert await seen(box, gate) == [1, 3]
    assert await box_free == 3


async def test_block_whoever_waits_hears_of_the_end(system: hf.ActorSystem) -> None:
    box, gate = await busy(system, hf.bounded(1))
    box.tell(Put(1))
    asked, sent = box.ask(Put(2)), asyncio.create_task(box.send(Put(3)))
    await asyncio.sleep(0)
    box.stop()
    gate.set()
    with pytest.raises(hf.ActorStopped):
        await asked
    with pytest.raises(hf.ActorStopped):
        await sent


async def test_fail_refuses_tell_send_and_ask(system: hf.ActorSystem) -> None:
    box, gate = await busy(system, hf.bounded(1, overflow="reject"))
    box.tell(Put(1))
    with pytest.raises(hf.MailboxFull):
        box.tell(Put(2))
    with pytest.raises(hf.MailboxFull):
        await box.send(Put(3))
    with pytest.raises(hf.MailboxFull):
        await box.ask(Put(4))
    assert await seen(box, gate) == [1]


@pytest.mark.parametrize(
    ("overflow", "kept", "lost"),
    [("drop_newest", [1, 2], [3, 4]), ("drop_oldest", [3, 4], [1, 2]), ("latest", [3, 4], [1, 2])],
)
async def test_the_loser_goes_to_dead_letters(
    system: hf.ActorSystem, overflow: Any, kept: list[int], lost: list[int]
) -> None:
    box, gate = await busy(system, hf.bounded(2, overflow=overflow))
    with system.events() as stream:
        for number in (1, 2, 3, 4):
            box.tell(Put(number))
        assert letters(stream) == lost
    assert system.dead_letters == 2
    assert await seen(box, gate) == kept


async def test_latest_keeps_only_the_newest(system: hf.ActorSystem) -> None:
    box, gate = await busy(system, hf.bounded(3, overflow="latest"))
    for number in range(4):
        box.tell(Put(number))
    assert await seen(box, gate) == [3]


@pytest.mark.parametrize(
    ("overflow", "answered"),
    [("drop_newest", [True, False]), ("drop_oldest", [False, True]), ("latest", [False, True])],
)
async def test_the_loser_s_ask_gets_mailbox_full(system: hf.ActorSystem, overflow: Any, answered: list[bool]) -> None:
    box, gate = await busy(system, hf.bounded(1, overflow=overflow))
    asks = [box.ask(Put(number)) for number in range(2)]
    gate.set()
    outcomes = await asyncio.gather(*asks, return_exceptions=True)
    assert [not isinstance(outcome, hf.MailboxFull) for outcome in outcomes] == answered
    (full,) = [outcome for outcome in outcomes if isinstance(outcome, hf.MailboxFull)]
    was_taken = answered == [False, True]
    assert full.displaced_by == (overflow if was_taken else "")
    assert ("had taken the message, and dropped it for a newer one" in str(full)) == was_taken


async def test_an_actor_that_overflows_its_own_mailbox_in_a_turn_lives_on(system: hf.ActorSystem) -> None:
    """The run loop has counted four messages; the overflow then leaves one."""
    box, gate = await busy(system, hf.bounded(4, overflow="latest"))
    ended = box._cell.ended()
    for message in (Poke([10, 11]), Put(1), Put(2), Put(3)):
        box.tell(message)
    assert await seen(box, gate) == [11]
    assert not ended.done()


async def test_what_the_runtime_puts_in_takes_no_place(system: hf.ActorSystem) -> None:
    """Pipe results and timers always fit, and make no room for more than the capacity."""
    gate = asyncio.Event()
    box = system.spawn(hf.start(Box, gate), mailbox=hf.bounded(2, overflow="reject"))
    box.tell(Pipe())
    for _ in range(10):
        await asyncio.sleep(0)
    box.tell(Put(1))
    box.tell(Put(2))
    with pytest.raises(hf.MailboxFull):
        box.tell(Put(3))
    assert await seen(box, gate) == [100, 101, 102, 103, 104, 1, 2]
    box.tell(Put(4))
    box.tell(Put(5))
    with pytest.raises(hf.MailboxFull):
        box.tell(Put(6))


@pytest.mark.parametrize("capacity", [0, -1, 1.5, True, "2", None])
def test_a_capacity_is_a_whole_number_of_messages(capacity: Any) -> None:
    with pytest.raises(hf.SpecError, match="capacity"):
        hf.bounded(capacity)


def test_the_overflow_policies_are_named_in_the_refusal() -> None:
    with pytest.raises(hf.SpecError, match="drop_oldest"):
        hf.bounded(1, overflow="drop")  # type: ignore[arg-type]


# -- commands and signals --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["stop", "kill"])
async def test_a_command_passes_ahead_of_queued_messages(system: hf.ActorSystem, command: str) -> None:
    box, gate = await busy(system)
    queued = [box.ask(Put(number)) for number in range(3)]
    getattr(box, command)()
    gate.set()
    for ask in queued:
        with pytest.raises(hf.ActorStopped):
            await ask


async def test_a_down_signal_keeps_its_place_after_earlier_messages(system: hf.ActorSystem) -> None:
    class Watcher(hf.Actor):
        def __init__(self) -> None:
            self.order: list[str] = []

        @hf.on(Put)
        def put(self, message: Put) -> int:
            self.order.append(f"put {message.n}")
            return 0

        @hf.on(Hold)
        async def hold(self, message: Hold) -> None:
            self.ctx.monitor(dying)
            await gate.wait()

        def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
            self.order.append("down")
            done.set_result(list(self.order))

    class Dying(hf.Actor):
        @hf.on(Hold)
        def end(self, message: Hold) -> None:
            watcher.tell(Put(1))
            watcher.tell(Put(2))
            self.ctx.stop()

    gate, done = asyncio.Event(), asyncio.get_running_loop().create_future()
    dying, watcher = system.spawn(hf.start(Dying)), system.spawn(hf.start(Watcher))
    watcher.tell(Hold())
    await asyncio.sleep(0)
    await dying.ask(Hold())
    watcher.tell(Put(3))
    gate.set()
    assert await done == ["put 1", "put 2", "down"]
    await watcher.ask(Put(4))


# -- what is left ----------------------------------------------------------------------------------------------------


class Heir(Box):
    def on_undelivered(self, message: hf.Message[Any]) -> None:
        assert isinstance(message, Put)
        if message.n == 2:
            raise ValueError("will not")
        left.append(message.n)


left: list[int] = []


async def test_what_is_queued_at_a_stop_goes_to_on_undelivered(system: hf.ActorSystem) -> None:
    left.clear()
    gate = asyncio.Event()
    heir = system.spawn(hf.start(Heir, gate))
    heir.tell(Hold())
    await asyncio.sleep(0)
    for number in (1, 2, 3):
        heir.tell(Put(number))
    asked = heir.ask(Put(4))
    heir.stop()
    gate.set()
    with pytest.raises(hf.ActorStopped):
        await asked
    assert left == [1, 3]
    assert system.dead_letters == 1  # the hook refused it: still not lost without a trace


async def test_without_the_hook_it_is_a_dead_letter(system: hf.ActorSystem) -> None:
    box, gate = await busy(system)
    with system.events() as stream:
        for number in (1, 2):
            box.tell(Put(number))
        box.stop()
        gate.set()
        await system._node.settled()
        box.tell(Put(3))
        assert letters(stream) == [1, 2, 3]
    assert system.dead_letters == 3


async def test_a_send_to_a_stopped_actor_raises(system: hf.ActorSystem) -> None:
    box = system.spawn(hf.start(Box))
    await system.stop(box)
    with pytest.raises(hf.ActorStopped):
        await box.send(Put(1))


async def test_a_ref_reaches_whoever_lives_at_its_address_later(system: hf.ActorSystem) -> None:
    box = system.spawn(hf.start(Box), "here")
    await system.stop(box)
    system.spawn(hf.start(Box), "here")
    box.tell(Put(1))
    assert await box.ask(Put(2)) == 2
    await box.send(Put(3))
    assert await box.ask(Seen()) == [1, 2, 3]
    assert system.dead_letters == 0


async def test_queued_messages_outlive_a_crash(system: hf.ActorSystem) -> None:
    class Fragile(Box):
        @hf.on(Hold)
        async def hold(self, message: Hold) -> None:
            await super().hold(message)
            raise ValueError

    gate = asyncio.Event()
    fragile = await system.start(hf.child("f", hf.start(Fragile, gate)))
    held, asks = fragile.ask(Hold()), [fragile.ask(Put(number)) for number in range(3)]
    gate.set()
    with pytest.raises(hf.RemoteCrash):
        await held
    assert await asyncio.gather(*asks) == [0, 1, 2]
    assert await fragile.ask(Seen()) == [0, 1, 2]  # in the second life, each once
    assert fragile._cell.life == 2
