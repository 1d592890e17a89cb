"""The idle barrier and the virtual clock's `advance`: what happens by itself has happened, and nothing else has."""

import asyncio
import threading

import pytest

import holdfast as hf
from holdfast.testing import Faults, GuardedSystem, NotIdle, Probe, advance, idle
from tests.testing.players import Add, Counter, Linger, Tell, Total

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


async def test_a_chain_of_turns_is_over(actor_system: GuardedSystem, probe: Probe) -> None:
    first = actor_system.spawn(hf.start(Counter))
    first.tell(Tell(probe.ref, hops=200))
    await idle(actor_system)
    assert probe.waiting == (Add(1),)


class Relay(hf.Actor):
    """Asks on, with work in between that takes several ticks."""

    @hf.on(Tell)
    async def tell(self, message: Tell) -> None:
        for _ in range(20):
            await asyncio.sleep(0)
        self.ctx.pipe_to_self(asyncio.to_thread(lambda: 0) if message.hops == 1 else _later(), lambda n: Add(n))
        self.to = message.to

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.to.tell(message)
        return 0


async def _later() -> int:
    for _ in range(20):
        await asyncio.sleep(0)
    return 7


async def test_turns_that_wait_and_background_work_go_on_to_their_end(
    actor_system: GuardedSystem, probe: Probe
) -> None:
    actor_system.spawn(hf.start(Relay)).tell(Tell(probe.ref))
    await idle(actor_system)
    assert probe.waiting == (Add(7),)


async def test_work_in_a_thread_is_not_waited_for(actor_system: GuardedSystem, probe: Probe) -> None:
    let_go = threading.Event()

    class Works(hf.Actor):
        @hf.on(Tell, to_thread=True)
        def tell(self, message: Tell) -> None:
            let_go.wait(30.0)
            message.to.tell(Add(7))

    actor_system.spawn(hf.start(Works)).tell(Tell(probe.ref))
    await idle(actor_system)
    assert probe.waiting == ()
    let_go.set()
    await probe.expect(Add(7))


@virtual
async def test_what_needs_time_is_not_waited_for(actor_system: GuardedSystem) -> None:
    counter = actor_system.spawn(hf.start(Counter))
    lingering = counter.ask(Linger(3600.0), timeout=7200.0)
    await idle(actor_system)
    assert (lingering.done(), asyncio.get_running_loop().time()) == (False, 0.0)
    await advance(3600.0)
    assert await lingering == 1


async def test_a_system_that_does_not_come_to_rest_says_what_moves(actor_system: GuardedSystem) -> None:
    class Restless(hf.Actor):
        @hf.on(Total)
        def again(self, message: Total) -> int:
            self.ctx.ref.tell(message)
            return 0

    restless = actor_system.spawn(hf.start(Restless), "restless")
    restless.tell(Total())
    with pytest.raises(NotIdle, match=r"not idle after 0\.05 s: .*(/app/restless|the run queue)"):
        await idle(actor_system, timeout=0.05)


@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_processes_have_handled_everything_and_said_what_they_had_to_say(
    actor_system: GuardedSystem, probe: Probe, recovery: hf.Method | None
) -> None:
    far = [
        await actor_system.start(hf.child(f"far{n}", hf.start(Counter), isolation="process", recovery=recovery))
        for n in range(2)
    ]
    for hops in (0, 3, 50):
        far[0].tell(Tell(far[1], hops=0))
        far[1].tell(Tell(probe.ref, hops=hops))
    far[0].tell(Linger(0.02))
    await idle(actor_system)
    assert probe.waiting == (Add(1),) * 3
    assert [cell.more.outlet is not None for cell in actor_system._workers.by_cell if cell.more] == [True, True]
    assert [await ref.ask(Total()) for ref in far] == [1, 3]


async def test_what_a_process_has_said_and_is_still_on_its_way_is_waited_for(
    actor_system: GuardedSystem, probe: Probe
) -> None:
    far = await actor_system.start(hf.child("far", hf.start(Counter), isolation="process"))
    async with Faults(1).on(far, at="frame in", delay=1.0, seconds=0.05, times=1):
        far.tell(Tell(probe.ref))
        await idle(actor_system)
        assert probe.waiting == (Add(1),)


async def test_a_process_that_dies_meanwhile_is_no_hindrance(actor_system: GuardedSystem, probe: Probe) -> None:
    far = await actor_system.start(hf.child("far", hf.start(Counter), isolation="process"))
    far.tell(Tell(probe.ref))
    far.tell(Linger(60.0))
    await probe.expect(Add, timeout=60.0)  # Its next turn has begun.
    with pytest.raises(NotIdle, match="/app/far has 1 messages in hand"):
        await idle(actor_system, timeout=0.05)
    asyncio.get_running_loop().call_soon(far.kill)
    await idle(actor_system)
    assert await far.ask(Total(), timeout=60.0) == 0


# -- advance ---------------------------------------------------------------------------------------------------------


class Beat(hf.Message): ...


class Times(hf.Message[list[float]]): ...


class Clock(hf.Actor):
    def __init__(self) -> None:
        self.times: list[float] = []

    def on_start(self, restored: bool) -> None:
        self.ctx.every(60.0, Beat())
        self.ctx.tell_after(90.0, Beat())

    @hf.on(Beat)
    def beat(self, message: Beat) -> None:
        self.times.append(asyncio.get_running_loop().time())

    @hf.on(Times)
    def read(self, message: Times) -> list[float]:
        return list(self.times)


@virtual
async def test_timers_fire_each_at_its_time(actor_system: GuardedSystem) -> None:
    clock = actor_system.spawn(hf.start(Clock))
    await advance(59.0)
    assert await clock.ask(Times()) == []
    await advance(1.0)
    assert await clock.ask(Times()) == [60.0]
    await advance(120.0)
    assert await clock.ask(Times()) == [60.0, 90.0, 120.0, 180.0]


@virtual
@pytest.mark.parametrize(("period", "gives_up"), [(3600.0, True), (3599.0, False)])
async def test_back_off_and_intensity_window_pass_without_sleeping(
    actor_system: GuardedSystem, period: float, gives_up: bool
) -> None:
    """T29, T30: restarts 600, 1800 and 4200 s after the first crash; a window counts both its ends."""
    actor_system.expect_crashes(3)
    backoff = hf.Backoff(initial=600.0, maximum=9000.0, reset_after=9000.0, jitter=0.0)
    spec = hf.child("c", hf.start(Counter), backoff=backoff)
    group = hf.supervisor("s", intensity=2, period=period, children=[spec], restart="temporary")
    await actor_system.start(group)
    counter = actor_system.ref("/app/s/c", Counter)
    for life, delay in ((1, 600.0), (2, 1200.0)):
        counter.tell(Add(-1))
        await advance(delay - 1.0)
        assert counter._cell.life == life
        await advance(1.0)
        assert counter._cell.life == life + 1
    with actor_system.events() as events:
        counter.tell(Add(-1))
        await advance(2400.0)
        assert any(isinstance(event, hf.events.SupervisorGaveUp) for event in events.take()) is gives_up


@pytest.mark.asyncio(loop_factories=["uvloop", "asyncio"])
async def test_only_a_virtual_clock_can_be_advanced() -> None:
    with pytest.raises(hf.HoldfastError, match="needs the virtual clock"):
        await advance(1.0)


@virtual
async def test_the_clock_does_not_go_back() -> None:
    with pytest.raises(ValueError, match="the clock goes forward"):
        await advance(-1.0)


@virtual
async def test_what_belongs_to_another_process_is_refused() -> None:
    with pytest.raises(hf.HoldfastError, match="a subprocess cannot run under the virtual clock"):
        await asyncio.create_subprocess_exec("true")
