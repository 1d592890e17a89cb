"""Whether a mailbox only grows: a leak is told from a burst, however large the burst is, by what it came back from."""

import asyncio
import random

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import State
from holdfast.diagnosis.literals import keeps_up
from holdfast.diagnosis.observers.backlog import Backlog
from holdfast.testing import advance


def queue(backlog: Backlog, arrivals: list[int], rate: float, waiting: float = 0.0, start: float = 0.0) -> bool:
    """Play a mailbox that gets so many messages at each tenth of a second, and works off `rate` in a second."""
    has_grown = False
    for tick, came in enumerate(arrivals):
        waiting = max(0.0, waiting + came - rate / 10)
        backlog.take(round(waiting), start + tick / 10)
        has_grown = has_grown or backlog.has_grown
    return has_grown


@pytest.mark.parametrize("size", [10, 1_000, 100_000])
def test_a_burst_is_no_leak_however_large_it_is(size: int) -> None:
    assert not queue(Backlog(), [size, *[0] * 3_000], size / 200)


def test_a_burst_after_which_as_much_comes_as_is_handled_is_no_leak() -> None:
    assert not queue(Backlog(), [0] * 10 + [1_000] + [1] * 3_000, 10.0)


def test_what_grows_without_end_is_a_leak_also_in_bursts() -> None:
    rng = random.Random(1)
    bursts = [rng.randint(5, 40) if rng.random() < 0.06 else 0 for _ in range(3_000)]
    backlog = Backlog()
    assert not queue(backlog, bursts, 40.0)
    assert queue(backlog, bursts[:600], 2.0, start=300.0)


def test_a_long_rise_is_no_leak_where_such_rises_have_ended_before() -> None:
    day = [3] * 90 + [0] * 300  # Nine seconds of more than it can do, and then time to work it off.
    backlog = Backlog()
    assert not queue(backlog, day, 10.0)
    assert not queue(backlog, [3] * 300 + [0] * 900, 10.0, start=39.0)
    assert queue(backlog, [3] * 3_000, 10.0, start=159.0)


@pytest.mark.parametrize("seed", range(10))
def test_a_queue_that_is_busy_nine_tenths_of_the_time_leaks_nothing(seed: int) -> None:
    rng = random.Random(seed)
    arrivals = [sum(rng.random() < 0.09 for _ in range(10)) for _ in range(36_000)]
    assert not queue(Backlog(), arrivals, 10.0), seed


def test_a_leak_is_over_when_what_waits_becomes_less() -> None:
    backlog = Backlog()
    assert queue(backlog, [3] * 300, 10.0)
    assert queue(backlog, [1] * 20, 10.0, waiting=600.0, start=30.0), "it only stays as it is"
    queue(backlog, [0] * 400, 10.0, waiting=600.0, start=32.0)
    assert not backlog.has_grown


class Item(hf.Message):
    seconds: float


class Slow(hf.Actor):
    """Is told, and never asked."""

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        await asyncio.sleep(message.seconds)


class Through(hf.Actor):
    """Asks another one in each turn, which takes its time."""

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        await self.ctx.find("/t/store", Store).ask(Wanted(message.seconds))


class Wanted(hf.Message[int]):
    seconds: float


class Store(hf.Actor):
    @hf.on(Wanted)
    async def answer(self, message: Wanted) -> int:
        await asyncio.sleep(message.seconds)
        return 1


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("kind", [Slow, Through])
async def test_who_cannot_keep_up_is_named_or_whom_it_waits_for(kind: type[hf.Actor]) -> None:
    async with hf.ActorSystem("t", log=False, seed=1) as system:
        await system.start(hf.child("store", hf.start(Store)))
        slow = await system.start(hf.child("slow", hf.start(kind)))
        watching = await diagnosis.watch(system, seconds=0.1)
        for tick in range(350):
            slow.tell(Item(0.02 if tick < 150 else 0.2))
            await advance(0.1)
            if tick == 149:
                assert (await watching.diagnosis()).state is State.HEALTHY
        culprit = "slow" if kind is Slow else "store"
        assert (await watching.diagnosis()).certain == (culprit,)
        assert keeps_up(culprit) in (await watching.observed()).negative
        await advance(40.0)  # Nothing comes any more.
        assert (await watching.diagnosis()).state is State.HEALTHY
