"""Timers: messages that come later, in their place in the mailbox, and end with the life that set them (T22)."""

import asyncio
from typing import Any

import pytest

import holdfast as hf

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])


class Tick(hf.Message[None]):
    n: int = 0


class Do(hf.Message[Any]):
    work: Any


class Stranger(hf.Message[None]): ...


class Clock(hf.Actor):
    def __init__(self, begin: float = 0.0) -> None:
        self.ticks: list[tuple[int, float]] = []
        self._begin = begin

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.ticks.append((message.n, round(asyncio.get_running_loop().time() - self._begin, 3)))

    @hf.on(Do)
    async def do(self, message: Do) -> Any:
        result = message.work(self)
        return await result if asyncio.iscoroutine(result) else result


def clock(system: hf.ActorSystem) -> hf.ActorRef[Clock]:
    return system.spawn(hf.start(Clock, asyncio.get_running_loop().time()))


async def ticks(ref: hf.ActorRef[Clock]) -> list[tuple[int, float]]:
    return await ref.ask(Do(lambda actor: actor.ticks))


async def test_tell_after_comes_once_at_its_time(system: hf.ActorSystem) -> None:
    one = clock(system)
    timer: hf.Timer = await one.ask(Do(lambda actor: actor.ctx.tell_after(2.0, Tick(1))))
    assert timer.is_active
    await asyncio.sleep(10)
    assert await ticks(one) == [(1, 2.0)]
    assert not timer.is_active


async def test_timers_come_in_the_order_of_their_times(system: hf.ActorSystem) -> None:
    one = clock(system)
    for seconds in (3, 1, 2):
        await one.ask(Do(lambda actor, s=seconds: actor.ctx.tell_after(s, Tick(s)) and None))
    await asyncio.sleep(10)
    assert await ticks(one) == [(1, 1.0), (2, 2.0), (3, 3.0)]


async def test_every_comes_again_and_again_without_drift(system: hf.ActorSystem) -> None:
    one = clock(system)
    timer = await one.ask(Do(lambda actor: actor.ctx.every(1.5, Tick(1))))
    await asyncio.sleep(100.0)
    timer.cancel()
    assert [at for _, at in await ticks(one)] == [1.5 * (n + 1) for n in range(66)]
    await asyncio.sleep(10)
    assert len(await ticks(one)) == 66


async def test_ticks_that_fall_due_while_one_waits_are_left_out(system: hf.ActorSystem) -> None:
    one = clock(system)
    await one.ask(Do(lambda actor: actor.ctx.every(1.0, Tick(1)) and None))
    await one.ask(Do(lambda actor: asyncio.sleep(4.5)), timeout=10)
    await asyncio.sleep(1)
    assert await ticks(one) == [(1, 4.5), (1, 5.0)]


async def test_a_cancelled_timer_does_not_come_not_even_if_it_is_queued(system: hf.ActorSystem) -> None:
    one = clock(system)

    async def late_cancel(actor: Clock) -> None:
        timers = [actor.ctx.tell_after(1, Tick(1)), actor.ctx.every(1, Tick(2))]
        await asyncio.sleep(1.5)  # both are queued now
        assert all(timer.is_active for timer in timers)
        for timer in timers:
            timer.cancel()
        assert not any(timer.is_active for timer in timers)

    await one.ask(Do(late_cancel))
    await asyncio.sleep(5)
    assert await ticks(one) == []


@pytest.mark.parametrize("end", ["crash", "kill"])
async def test_timers_end_with_the_life_that_set_them(system: hf.ActorSystem, end: str) -> None:
    one = await system.start(hf.child("c", hf.start(Clock, asyncio.get_running_loop().time())))

    async def set_them(actor: Clock) -> None:
        actor.ctx.tell_after(0.5, Tick(1))
        actor.ctx.tell_after(3.0, Tick(2))
        actor.ctx.every(1.0, Tick(3))
        await asyncio.sleep(1.2)  # two are queued already
        if end == "crash":
            raise ValueError
        actor.ctx.ref.kill()

    one.tell(Do(set_them))
    await asyncio.sleep(10)
    assert await ticks(one) == []
    assert await one.ask(Do(lambda actor: actor.ctx.life)) == 2


async def test_timers_set_in_an_init_that_fails_do_not_come(system: hf.ActorSystem) -> None:
    kept: list[hf.Timer] = []

    class Failing(Clock):
        def __init__(self) -> None:
            super().__init__()
            kept.append(self.ctx.every(1.0, Tick(1)))
            self.ctx.spawn(hf.start(Clock), "orphan")
            self.ctx.subscribe("/x")
            raise ValueError

    with pytest.raises(hf.StartFailed):
        system.spawn(hf.start(Failing), "failing")
    await asyncio.sleep(0)
    assert system.tree() == ["/t"]
    assert system._node.topics.names() == []
    assert not kept[0].is_active


@pytest.mark.parametrize(
    ("how", "seconds"), [("tell_after", -1), ("tell_after", float("nan")), ("every", 0), ("every", -2)]
)
async def test_seconds_that_make_no_sense_are_refused(system: hf.ActorSystem, how: str, seconds: float) -> None:
    one = clock(system)
    with pytest.raises(hf.RemoteCrash, match="must be a finite number of seconds"):
        await one.ask(Do(lambda actor: getattr(actor.ctx, how)(seconds, Tick())))


async def test_a_message_the_actor_does_not_handle_is_refused_when_the_timer_is_set(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.RemoteCrash, match="no handler"):
        await clock(system).ask(Do(lambda actor: actor.ctx.tell_after(1, Stranger())))


async def test_a_crash_in_a_timer_s_turn_is_the_actor_s_crash(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("c", hf.start(Clock)))
    await one.ask(Do(lambda actor: actor.ctx.tell_after(1, Do(lambda _: 1 / 0)) and None))
    await asyncio.sleep(2)
    assert await one.ask(Do(lambda actor: actor.ctx.life)) == 2
