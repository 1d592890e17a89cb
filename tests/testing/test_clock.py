"""The virtual clock: timers take no real time, order is kept, and a loop that would hang says so."""

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import pytest

from holdfast.testing.clock import NothingToWaitFor, RealTimeNeeded, VirtualClockLoop
from holdfast.testing.clock import virtual as virtual_loop
from holdfast.testing.threads import NewThreads, task_file, waits_for_a_lock

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


@virtual
async def test_a_day_passes_at_once() -> None:
    loop, began = asyncio.get_running_loop(), time.monotonic()
    await asyncio.sleep(86_400 * 3)
    assert loop.time() == 86_400 * 3
    assert time.monotonic() - began < 60.0


@virtual
async def test_the_clock_stands_still_while_anything_runs() -> None:
    loop = asyncio.get_running_loop()
    before = loop.time()
    for _ in range(1000):
        await asyncio.sleep(0)
    assert loop.time() == before


@virtual
async def test_timers_fire_in_order_each_at_its_own_time() -> None:
    loop = asyncio.get_running_loop()
    fired: list[tuple[str, float]] = []

    def note(name: str) -> None:
        fired.append((name, loop.time()))

    for name, delay in (("c", 30.0), ("a", 0.1), ("b", 7.25)):
        loop.call_later(delay, note, name)
    await asyncio.sleep(60)
    assert fired == [("a", 0.1), ("b", 7.25), ("c", 30.0)]


@virtual
async def test_a_timeout_strikes_at_its_virtual_time() -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(600):
            await asyncio.Event().wait()
    assert asyncio.get_running_loop().time() == 600


@virtual
async def test_a_thread_takes_no_virtual_time_and_its_result_comes_before_any_timer() -> None:
    loop, gate = asyncio.get_running_loop(), threading.Event()
    fired: list[float] = []
    timer = loop.call_later(1.0, lambda: fired.append(loop.time()))
    loop.call_soon(gate.set)
    assert await loop.run_in_executor(None, gate.wait, 10.0)
    assert (loop.time(), fired) == (0.0, [])
    timer.cancel()


@virtual
async def test_time_passes_for_a_thread_that_waits_for_what_it_has_handed_to_the_loop() -> None:
    loop = asyncio.get_running_loop()

    def hands_over() -> None:
        asyncio.run_coroutine_threadsafe(asyncio.sleep(3600.0), loop).result(20.0)

    await asyncio.to_thread(hands_over)
    assert loop.time() == 3600.0


@virtual
async def test_a_pool_of_processes_is_refused() -> None:
    with ProcessPoolExecutor(1) as pool, pytest.raises(RealTimeNeeded, match="work in a pool of processes"):
        asyncio.get_running_loop().run_in_executor(pool, abs, -1)


@virtual
async def test_a_socket_is_waited_for_when_no_timer_is_set() -> None:
    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(await reader.readline())
        writer.close()
        await writer.wait_closed()

    async with await asyncio.start_server(echo, "127.0.0.1", 0) as server:
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        writer.write(b"hello\n")
        assert await reader.readline() == b"hello\n"
        writer.close()
        await writer.wait_closed()


def test_a_loop_that_would_hang_says_so() -> None:
    with (
        asyncio.Runner(loop_factory=virtual_loop) as runner,
        pytest.raises(NothingToWaitFor, match="at virtual time 2 s"),
    ):
        runner.run(wait_for_nothing())


async def wait_for_nothing() -> None:
    await asyncio.sleep(2)
    await asyncio.Event().wait()


def test_a_thread_that_the_loop_does_not_know_may_still_wake_it() -> None:
    async def main() -> str:
        loop = asyncio.get_running_loop()
        woken: asyncio.Future[str] = loop.create_future()
        thread = threading.Thread(target=lambda: loop.call_soon_threadsafe(woken.set_result, "woken"))
        thread.start()
        try:
            return await woken
        finally:
            thread.join()

    with asyncio.Runner(loop_factory=virtual_loop) as runner:
        assert runner.run(main()) == "woken"


def test_of_two_threads_that_wake_each_other_one_is_always_at_work() -> None:
    others = NewThreads()
    gates = (threading.Lock(), threading.Lock())
    ended = threading.Event()

    def pass_on(own: threading.Lock, other: threading.Lock) -> None:
        while not ended.is_set():
            own.acquire()
            other.release()

    for gate in gates:
        gate.acquire()
    threads = [threading.Thread(target=pass_on, args=pair) for pair in (gates, gates[::-1])]
    for thread in threads:
        thread.start()
    gates[0].release()
    try:
        assert all(others.at_work() for _ in range(1_000))
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def test_a_thread_that_was_woken_behind_the_first_look_is_at_work() -> None:
    gate, handed_over, ended, rest = threading.Lock(), threading.Event(), threading.Event(), threading.Lock()

    def wait_and_work() -> None:
        gate.acquire()
        ended.wait(60.0)

    def work_and_hand_over() -> None:
        handed_over.wait(60.0)
        gate.release()
        rest.acquire()

    first, second = threading.Thread(target=wait_and_work), threading.Thread(target=work_and_hand_over)

    def is_at_rest(thread: threading.Thread) -> bool:
        return waits_for_a_lock(task_file(thread, "status"), task_file(thread, "syscall"))

    def told(thread: threading.Thread, file: str) -> str:
        """The first thread has been looked at when the second one, on its way to rest, wakes it."""
        if thread is second:
            handed_over.set()
            assert spins_until(lambda: is_at_rest(second))
        return task_file(thread, file)

    threads = NewThreads(told)
    gate.acquire()
    rest.acquire()
    first.start()
    second.start()
    try:
        assert spins_until(lambda: is_at_rest(first))
        assert threads.at_work() == [first.name]
    finally:
        for event in (handed_over, ended):
            event.set()
        rest.release()
        for thread in (first, second):
            thread.join()


def spins_until(holds: Callable[[], bool]) -> bool:
    ends = time.monotonic() + 30.0
    while not holds():
        if time.monotonic() > ends:
            return False
    return True


def test_the_clock_begins_where_it_is_told_to() -> None:
    with asyncio.Runner(loop_factory=lambda: VirtualClockLoop(start=100.0)) as runner:
        runner.run(asyncio.sleep(0.5))
        assert runner.get_loop().time() == 100.5


def test_time_that_a_call_takes_passes_at_once_and_what_is_due_then_comes() -> None:
    async def run() -> float:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualClockLoop)
        loop.pass_time(25.0)
        await asyncio.sleep(1e-20)
        return loop.time()

    with asyncio.Runner(loop_factory=lambda: VirtualClockLoop(ticks=100)) as runner:
        assert runner.run(run()) == 25.0
