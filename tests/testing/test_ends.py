"""Everything that waits ends: idle, expect and the virtual clock name who moves, and hold still for every thread."""

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import anyio.to_thread
import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, NotIdle, Probe, VirtualClockLoop, advance, idle, probe
from holdfast.testing.threads import FUTEX, NewThreads, waits_for_a_lock
from tests.testing.players import Add, Counter, Total

T = TypeVar("T")
virtual = pytest.mark.asyncio(loop_factories=["virtual"])


def run(main: Callable[[], Coroutine[Any, Any, T]], **limits: int) -> T:
    """Run on a virtual clock with smaller limits than a user has."""
    with asyncio.Runner(loop_factory=lambda: VirtualClockLoop(**limits)) as runner:
        return runner.run(main())


class Again(hf.Message): ...


class Restless(hf.Actor):
    @hf.on(Again)
    def again(self, message: Again) -> None:
        self.ctx.ref.tell(message)


class Heart(hf.Actor):
    def on_start(self, restored: bool) -> None:
        self.ctx.every(1.0, Again())

    @hf.on(Again)
    def beat(self, message: Again) -> None: ...


async def idle_beside(system: GuardedSystem) -> None:
    await idle(system, timeout=1.0)


async def expect_beside(system: GuardedSystem) -> None:
    await probe(system).expect(Add, timeout=1.0)


async def fish_beside(system: GuardedSystem) -> None:
    await probe(system).fish(Add, timeout=1.0)


async def expect_nothing_beside(system: GuardedSystem) -> None:
    await probe(system).expect_no_message(within=1.0)


async def advance_beside(system: GuardedSystem) -> None:
    await advance(1.0)


@pytest.mark.parametrize("wait", [idle_beside, expect_beside, fish_beside, expect_nothing_beside, advance_beside])
def test_who_tells_itself_for_ever_is_named_although_no_time_passes(
    wait: Callable[[GuardedSystem], Awaitable[None]],
) -> None:
    async def main() -> None:
        async with GuardedSystem() as system:
            system.spawn(hf.start(Restless), "restless").tell(Again())
            with pytest.raises(NotIdle, match=r"300 ticks of the loop at virtual time 0 s: .*/app/restless \(Again\)"):
                await wait(system)
            assert await system.spawn(hf.start(Counter)).ask(Total()) == 0, "the system and the clock go on"

    run(main, ticks=300)


def test_a_clock_that_stands_still_ends_the_run_of_a_test_that_waits_by_itself() -> None:
    async def main() -> None:
        async with GuardedSystem() as system:
            system.spawn(hf.start(Restless), "restless").tell(Again())
            async with asyncio.timeout(1.0):
                await asyncio.Event().wait()

    with pytest.raises(NotIdle, match=r"/app/restless \(Again\)"):
        run(main, ticks=300)


def test_a_test_that_waits_for_ever_beside_a_heartbeat_ends() -> None:
    async def main() -> None:
        async with GuardedSystem() as system:
            system.spawn(hf.start(Heart), "heart")
            await asyncio.Event().wait()

    with pytest.raises(
        NotIdle, match=r"400 jumps of the clock, at virtual time 401 s: .*/app/heart \(timer of Again\)"
    ):
        run(main, jumps=400)


@virtual
@pytest.mark.parametrize("interval", [1.0, 0.1, 0.02])
async def test_a_recorded_actor_comes_to_rest_whenever_its_snapshots_fall_due(
    actor_system: GuardedSystem, interval: float
) -> None:
    for step in range(1, 10):
        counter = await actor_system.start(
            hf.child(f"c{step}", hf.start(Counter), recovery=hf.hybrid(interval=interval))
        )
        for number in range(1, 6):
            await asyncio.sleep(0.1 * step + 0.03 * (step % 3))
            counter.tell(Add(1))
            await idle(actor_system)
            assert await counter.ask(Total()) == number


@virtual
async def test_no_timer_fires_before_its_time() -> None:
    loop = asyncio.get_running_loop()
    fired: list[tuple[float, float]] = []

    def note(due: float) -> None:
        fired.append((due, loop.time()))

    await asyncio.sleep(1e6 / 3)
    now = loop.time()
    for delay in (1e-10, 5e-10, 0.1 + 0.2, 0.3, 1 / 3, 2 / 3):
        loop.call_at(now + delay, note, now + delay)
    await asyncio.sleep(1.0)
    assert len(fired) == 6
    assert all(due == at for due, at in fired)


@virtual
async def test_the_clock_does_not_go_to_infinity() -> None:
    with pytest.raises(ValueError, match="finite"):
        await advance(float("inf"))
    async with asyncio.timeout(float("inf")):
        await asyncio.sleep(5.0)
    assert asyncio.get_running_loop().time() == 5.0


# -- threads ---------------------------------------------------------------------------------------------------------


class Work:
    """What a thread does; it takes real time, which nobody measures."""

    def __init__(self) -> None:
        self.is_done = False

    def __call__(self) -> str:
        for _ in range(20):
            time.sleep(0.001)
        self.is_done = True
        return "done"


async def in_executor(work: Work) -> str:
    return await asyncio.get_running_loop().run_in_executor(None, work)


async def in_anyio(work: Work) -> str:
    return await anyio.to_thread.run_sync(work)


async def in_pool(work: Work) -> str:
    with ThreadPoolExecutor(1) as pool:
        return await asyncio.wrap_future(pool.submit(work))


OLD_POOL = ThreadPoolExecutor(1)


async def in_a_pool_that_was_there_before(work: Work) -> str:
    return await asyncio.wrap_future(OLD_POOL.submit(work))


async def in_raw_thread(work: Work) -> str:
    loop = asyncio.get_running_loop()
    future: asyncio.Future[str] = loop.create_future()
    thread = threading.Thread(target=lambda: loop.call_soon_threadsafe(future.set_result, work()))
    thread.start()
    try:
        return await future
    finally:
        thread.join()


@pytest.mark.parametrize("way", [in_executor, in_anyio, in_pool, in_a_pool_that_was_there_before, in_raw_thread])
def test_work_in_any_thread_holds_virtual_time_still(way: Callable[[Work], Awaitable[str]]) -> None:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(10.0):
            for _ in range(3):
                assert await way(Work()) == "done"
        assert loop.time() == 0.0
        await asyncio.sleep(5.0)  # Idle threads of pools do not hold it.
        return loop.time()

    OLD_POOL.submit(int).result()  # Its thread runs before the loop is made.
    assert run(main) == 5.0


def test_a_thread_that_was_woken_is_at_work_before_it_runs() -> None:
    threads, lock, runs = NewThreads(), threading.Lock(), 0
    is_over = False
    lock.acquire()

    def work() -> None:
        nonlocal runs
        while not is_over:
            lock.acquire()
            runs += 1

    thread = threading.Thread(target=work)
    thread.start()
    try:
        for number in range(3000):
            while threads.at_work():
                time.sleep(0.0001)
            assert runs == number
            lock.release()
            assert threads.at_work() or runs == number + 1
    finally:
        is_over = True
        while thread.is_alive():
            if lock.locked():  # Nobody but the thread locks it.
                lock.release()
            time.sleep(0.0001)
        thread.join()


STATUS = "Name:\tpython\nState:\t{}\nvoluntary_ctxt_switches:\t7\nnonvoluntary_ctxt_switches:\t1\n"
LOCK = f"{FUTEX} 0x55d7 0x189 0x0 0x0 0x0 0xffffffff 0x7f 0x7f"


@pytest.mark.parametrize(
    ("state", "syscall", "waits"),
    [
        ("S (sleeping)", LOCK, True),
        ("R (running)", LOCK, False),
        ("S (sleeping)", LOCK.replace("0x189 0x0 0x0", "0x189 0x0 0x7ffe"), False),
        ("S (sleeping)", LOCK.replace("0x189 0x0", "0x80 0x2"), False),
        ("S (sleeping)", "230 0x1 0x0 0x7f 0x0 0x0 0x0 0x7f 0x7f", False),
        ("R (running)", "running", False),
    ],
    ids=["lock", "woken", "with_a_limit", "mutex", "sleep", "runs"],
)
def test_only_who_waits_for_a_lock_is_not_at_work(state: str, syscall: str, waits: bool) -> None:
    assert waits_for_a_lock(STATUS.format(state), syscall) is waits


def test_a_thread_that_does_not_come_to_an_end_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.testing.clock.LONGEST_WORK", 0.01)
    gate = threading.Event()

    def wait() -> None:
        while not gate.wait(0.01):
            pass

    async def main() -> None:
        threading.Thread(target=wait, name="for ever").start()
        await asyncio.sleep(5.0)

    try:
        with pytest.raises(RuntimeError, match=r"a thread is at work: for ever\. .* needs a real loop"):
            run(main)
    finally:
        gate.set()
        for thread in threading.enumerate():
            if thread.name == "for ever":
                thread.join()


@virtual
async def test_a_thread_that_waits_for_the_test_holds_nothing() -> None:
    gate = threading.Event()
    thread = threading.Thread(target=gate.wait)
    thread.start()
    try:
        await asyncio.sleep(5.0)
    finally:
        gate.set()
        thread.join()
    assert asyncio.get_running_loop().time() == 5.0


@virtual
@pytest.mark.parametrize("guarded", [False, True])
async def test_an_actor_of_another_process_is_refused_by_name(guarded: bool, probe: Probe) -> None:
    system = GuardedSystem("far") if guarded else hf.ActorSystem("far", log=False)
    async with system:
        with pytest.raises(hf.HoldfastError, match="cannot run under the virtual clock"):
            await system.start(hf.child("a", hf.start(Counter), isolation="process"))
    assert asyncio.get_running_loop().time() == 0.0


@virtual
async def test_a_program_is_refused_by_name(probe: Probe) -> None:
    async with hf.ActorSystem("far", log=False) as system:
        with pytest.raises(hf.HoldfastError, match="cannot run under the virtual clock"):
            await system.start(hf.supervision.program(["sleep", "60"]))
