"""Probes as users of other test kits know them: unordered expects, a common limit, autopilot, forward, taps, events."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import ActorStarted, ChildRestarted
from holdfast.testing import GuardedSystem, Probe, Unexpected, idle, probe
from tests.testing.players import Add, Count, Counter, Put, Shelf, Total

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


class Ping(hf.Message[str]):
    n: int = 0


class Pong(hf.Message):
    n: int = 0


class Sub(Pong):
    """A kind of Pong."""


class Busy(hf.Refusal):
    for_seconds: float


class Order(hf.Message):
    to: hf.ActorRef
    n: int


class Sender(hf.Actor):
    @hf.on(Order)
    def order(self, message: Order) -> None:
        message.to.tell(Add(message.n))


# -- expecting -------------------------------------------------------------------------------------------------------


async def test_all_of_these_come_in_any_order(probe: Probe) -> None:
    for message in (Pong(2), Ping(1), Sub(3)):
        probe.ref.tell(message)
    assert await probe.expect_all(Ping, Pong(2), Sub) == (Ping(1), Pong(2), Sub(3))
    probe.ref.tell(Sub(1))
    probe.ref.tell(Pong(1))
    assert await probe.expect_all(Pong, Sub) == (Pong(1), Sub(1)), "what came first would do for both"


async def test_each_of_all_comes_once(probe: Probe) -> None:
    probe.ref.tell(Pong(1))
    probe.ref.tell(Pong(1))
    with pytest.raises(Unexpected, match=r"expected all of Pong\(n=1\), .*Ping \(still .*Ping\), got Pong\(n=1\)"):
        await probe.expect_all(Pong(1), Ping)


@virtual
async def test_what_of_all_has_not_come_is_named(probe: Probe) -> None:
    probe.ref.tell(Pong(1))
    with pytest.raises(Unexpected, match=r"still Pong\(n=2\)\), got nothing in 5 s"):
        await probe.expect_all(Pong(1), Pong(2), timeout=5.0)
    assert asyncio.get_running_loop().time() == 5.0


@virtual
async def test_all_within_share_one_limit(probe: Probe) -> None:
    loop = asyncio.get_running_loop()
    loop.call_later(6.0, probe.ref.tell, Pong(1))
    async with probe.within(10.0):
        await probe.expect(Pong)  # longer than an expect waits by itself
        assert loop.time() == 6.0
        with pytest.raises(Unexpected, match="got nothing in 4 s"):
            await probe.expect(Pong, timeout=60.0)
    assert loop.time() == 10.0
    with pytest.raises(Unexpected, match="got nothing in 3 s"):
        await probe.expect(Pong)
    async with probe.within(10.0):
        with pytest.raises(Unexpected, match="got nothing in 1 s"):
            await probe.fish(Pong, timeout=1.0)


@virtual
async def test_what_takes_longer_than_its_limit_fails(probe: Probe) -> None:
    with pytest.raises(Unexpected, match="within 2 s took longer"):
        async with probe.within(2.0):
            await asyncio.sleep(3.0)
    with pytest.raises(Unexpected, match="within 5 s took longer"):
        async with probe.within(5.0), probe.within(60.0):
            await asyncio.sleep(6.0)


async def test_two_tasks_that_expect_at_once_are_told(probe: Probe) -> None:
    first = asyncio.create_task(probe.expect(Pong), name="the first")
    await asyncio.sleep(0)
    with pytest.raises(hf.HoldfastError, match="is waited for by the first already"):
        await probe.expect(Pong)
    probe.ref.tell(Pong(1))
    assert await first == Pong(1)


async def test_nothing_is_expected_of_a_probe_that_has_stopped(actor_system: GuardedSystem) -> None:
    one = probe(actor_system)
    one.ref.tell(Pong(1))
    await idle(actor_system)
    await one.stop()
    assert await one.expect(Pong) == Pong(1), "it came before"
    with pytest.raises(hf.HoldfastError, match="has stopped: nothing can come any more"):
        await one.expect(Pong)
    with pytest.raises(hf.HoldfastError, match="has stopped"):
        await one.expect_no_message()


async def test_who_waits_when_the_probe_stops_hears_of_it(actor_system: GuardedSystem) -> None:
    one = probe(actor_system)
    waiting = asyncio.create_task(one.expect(Pong))
    await asyncio.sleep(0)
    await one.stop()
    with pytest.raises(hf.HoldfastError, match="has stopped"):
        await waiting


# -- answering -------------------------------------------------------------------------------------------------------


async def test_a_reply_of_another_type_than_declared_is_refused_at_the_call(probe: Probe) -> None:
    asked = probe.ref.ask(Ping())
    await probe.expect(Ping)
    with pytest.raises(hf.errors.BadMessage, match="the reply 5: Expected `str`, got `int`"):
        probe.reply(5)
    probe.reply("five")
    assert await asked == "five"


async def test_a_second_answer_is_refused(probe: Probe) -> None:
    asked = probe.ref.ask(Ping())
    await probe.expect(Ping)
    probe.reply("one")
    for answer in (lambda: probe.reply("two"), lambda: probe.refuse(Busy(1.0)), lambda: probe.forward(probe.ref)):
        with pytest.raises(hf.HoldfastError, match=r"Ping\(n=0\) \(asked\) was answered or forwarded before"):
            answer()
    assert await asked == "one"


async def test_an_autopilot_answers_and_what_came_is_still_expected(probe: Probe) -> None:
    def answer(message: hf.Message) -> object:
        if isinstance(message, Ping) and message.n == 3:
            raise Busy(3.0)
        return f"pong {message.n}" if isinstance(message, Ping) else NotImplemented

    probe.autopilot(answer)
    assert await probe.ref.ask(Ping(2)) == "pong 2"
    with pytest.raises(Busy):
        await probe.ref.ask(Ping(3))
    assert await probe.expect(Ping) == Ping(2)
    probe.autopilot({Ping: "always", Total: lambda message: 7})
    assert (await probe.ref.ask(Ping(4)), await probe.ref.ask(Total())) == ("always", 7)
    assert await probe.fish(Total) == Total()
    probe.autopilot(None)
    asked = probe.ref.ask(Ping(5))
    await probe.expect(Ping(5))
    assert not asked.done()
    probe.reply("by hand")
    assert await asked == "by hand"


async def test_what_an_autopilot_has_answered_is_not_answered_again(probe: Probe) -> None:
    probe.autopilot({Ping: "pong"})
    assert await probe.ref.ask(Ping()) == "pong"
    await probe.expect(Ping)
    for answer in (lambda: probe.reply("two"), lambda: probe.refuse(Busy(1.0)), lambda: probe.forward(probe.ref)):
        with pytest.raises(hf.HoldfastError, match=r"Ping\(n=0\) \(asked\) was answered or forwarded before"):
            answer()


async def test_an_autopilot_that_answers_wrongly_crashes_the_probe(actor_system: GuardedSystem, probe: Probe) -> None:
    actor_system.expect_crashes(1)
    probe.autopilot({Ping: 5})
    with pytest.raises(hf.RemoteCrash, match="Expected `str`, got `int`"):
        await probe.ref.ask(Ping())


async def test_what_was_expected_is_forwarded(actor_system: GuardedSystem, probe: Probe) -> None:
    counter = actor_system.spawn(hf.start(Counter))
    asked = probe.ref.ask(Add(5))
    await probe.expect(Add)
    probe.forward(counter)
    assert await asked == 5
    sender, other = actor_system.spawn(hf.start(Sender)), probe_of(actor_system)
    sender.tell(Order(probe.ref, 2))
    await probe.expect(Add(2))
    probe.forward(other.ref)
    await other.expect(Add(2))
    assert other.sender == sender
    with pytest.raises(hf.HoldfastError, match="was answered or forwarded before"):
        probe.forward(counter)


def probe_of(system: GuardedSystem) -> Probe:
    return probe(system)


# -- taps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plain", "recorded", "process"])
async def test_a_tap_sees_what_goes_to_an_address_and_changes_nothing(
    actor_system: GuardedSystem, probe: Probe, kind: str
) -> None:
    options = {"plain": {}, "recorded": {"recovery": hf.hybrid()}, "process": {"isolation": "process"}}[kind]
    counter = await actor_system.start(hf.child("counter", hf.start(Counter), **options))  # type: ignore[arg-type]
    with probe.tap(counter):
        counter.tell(Add(1))
        assert await counter.ask(Add(2)) == 3
        assert await probe.expect_all(Add(1), Add(2)) == (Add(1), Add(2))
        with pytest.raises(hf.HoldfastError, match="is no ask"):
            probe.reply(5)
    assert await counter.ask(Add(3)) == 6
    await probe.expect_no_message()


async def test_a_tap_between_two_sees_only_these(actor_system: GuardedSystem, probe: Probe) -> None:
    one, other = (actor_system.spawn(hf.start(Sender), name) for name in ("one", "other"))
    counter = actor_system.spawn(hf.start(Counter))
    tap = probe.tap(one, counter)
    for number, sender in enumerate((one, other, one)):
        sender.tell(Order(counter, number))
    await idle(actor_system)
    await probe.expect(Add(0))
    assert probe.sender == one
    await probe.expect(Add(2))
    await probe.expect_no_message()
    tap.close()
    tap.close()
    one.tell(Order(counter, 5))
    await idle(actor_system)
    assert (probe.waiting, await counter.ask(Total())) == ((), 8)


PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid()},
}
BOTH = {**PLACES, "recorded process": {**PLACES["process"], **PLACES["recorded"]}}


@pytest.mark.parametrize("to", BOTH)
@pytest.mark.parametrize("by", BOTH)
async def test_a_tap_sees_what_one_actor_sends_another_wherever_they_live(
    actor_system: GuardedSystem, probe: Probe, by: str, to: str
) -> None:
    sender = await actor_system.start(hf.child("sender", hf.start(Sender), **BOTH[by]))
    counter = await actor_system.start(hf.child("counter", hf.start(Counter), **BOTH[to]))
    pair = probe_of(actor_system)
    with probe.tap(counter), pair.tap(sender, counter):
        sender.tell(Order(counter, 7))
        await probe.expect(Add(7))
        await pair.expect(Add(7))
        assert (probe.sender, pair.sender) == (sender, sender)
    assert await counter.ask(Add(1)) == 8
    await pair.expect_no_message()


async def test_a_tap_is_refused_where_messages_never_leave_a_process(actor_system: GuardedSystem, probe: Probe) -> None:
    children = [hf.child("one", hf.start(Sender)), hf.child("two", hf.start(Counter))]
    await actor_system.start(hf.supervisor("far", isolation="process", children=children))
    near = await actor_system.start(hf.child("near", hf.start(Sender), isolation="process"))
    one, two = actor_system.ref("/app/far/one", Sender), actor_system.ref("/app/far/two", Counter)
    with pytest.raises(hf.SpecError, match=r"/app/far/two lives in another process, and what whoever lives there"):
        probe.tap(two)
    with pytest.raises(hf.SpecError, match=r"what /app/far/one sends to it never leaves that"):
        probe.tap(one, two)
    with probe.tap(near, two):
        near.tell(Order(two, 3))
        await probe.expect(Add(3))


async def test_two_taps_at_one_address_end_in_any_order(actor_system: GuardedSystem, probe: Probe) -> None:
    shelf, second = actor_system.spawn(hf.start(Shelf)), probe_of(actor_system)
    first = probe.tap(shelf)
    last = second.tap(shelf)
    first.close()
    shelf.tell(Put([1]))
    assert await second.expect(Put) == Put([1])
    last.close()
    shelf.tell(Put([2]))
    assert await shelf.ask(Count()) == 2
    await second.expect_no_message()
    await probe.expect_no_message()


# -- events ----------------------------------------------------------------------------------------------------------


async def test_events_are_expected(actor_system: GuardedSystem, probe: Probe) -> None:
    actor_system.expect_crashes(1)
    counter = await actor_system.start(hf.child("counter", hf.start(Counter)))
    started = await probe.expect_event(lambda event: event.address == counter.path)
    assert isinstance(started, ActorStarted)
    counter.tell(Add(-1))
    assert (await probe.expect_event(ChildRestarted)).attempt == 1


@virtual
async def test_an_event_that_does_not_come_is_told_with_the_others(actor_system: GuardedSystem, probe: Probe) -> None:
    actor_system.spawn(hf.start(Counter), "counter")
    with pytest.raises(
        Unexpected, match=r"(?s)the event .*ChildRestarted, got nothing in 3 s\nother events:.*ActorSta"
    ):
        await probe.expect_event(ChildRestarted)


async def test_a_dead_letter_that_is_expected_is_no_problem(actor_system: GuardedSystem, probe: Probe) -> None:
    counter = actor_system.spawn(hf.start(Counter), "counter")
    await actor_system.stop(counter)
    counter.tell(Add(1))
    counter.tell(Add(2))
    letter = await probe.expect_dead_letter(Add(1), counter)
    assert letter.why == "the actor has stopped"
    assert len(actor_system.problems()) == 1, "the other one was not expected"
    await probe.expect_dead_letter(Add)
    assert actor_system.problems() == []


async def test_what_can_never_come_is_refused(probe: Probe) -> None:
    with pytest.raises(TypeError, match="a class of messages or a message, not 'text'"):
        await probe.expect("text")  # type: ignore[call-overload]
    with pytest.raises(TypeError, match="not 7"):
        await probe.expect_all(hf.Message, 7)
