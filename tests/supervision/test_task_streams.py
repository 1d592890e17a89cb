"""Streams of jobs: order, back-pressure, timeouts, leaving early (otp.md 1.14 Task.Supervisor async_stream)."""

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import idle
from tests.supervision.family import refused
from tests.supervision.test_tasks import Gate, add, opened

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


class Load:
    """Notes which items run, and how many at once."""

    def __init__(self) -> None:
        self.running, self.most, self.begun, self.ended = 0, 0, list[float](), list[str]()

    async def take(self, seconds: float) -> float:
        self.begun.append(seconds)
        self.running += 1
        self.most = max(self.most, self.running)
        try:
            await asyncio.sleep(seconds)
        except asyncio.CancelledError:
            self.ended.append(f"cancelled {seconds:g}")
            raise
        finally:
            self.running -= 1
        return seconds * 2

    async def fail_odd(self, n: int) -> int:
        if n % 2:
            raise ValueError(f"{n} is odd")
        return n


async def values(results: AsyncIterator[hf.supervision.Ok[Any, Any] | hf.supervision.Failed[Any]]) -> list[Any]:
    return [result.value if isinstance(result, hf.supervision.Ok) else str(result.error) async for result in results]


@virtual
@pytest.mark.parametrize("ordered", [True, False])
async def test_results_come_in_the_order_of_items_or_of_ends(ordered: bool) -> None:
    async with opened() as (_, jobs):
        load = Load()
        found = await values(jobs.stream(load.take, [3.0, 1.0, 2.0], max_concurrency=3, ordered=ordered))
        assert found == ([6.0, 2.0, 4.0] if ordered else [2.0, 4.0, 6.0])
        assert asyncio.get_running_loop().time() == 3.0
        assert await jobs.children() == []


@pytest.mark.parametrize("most", [1, 2, 5])
@pytest.mark.parametrize("ordered", [True, False])
@virtual
async def test_never_more_than_max_concurrency_run(most: int, ordered: bool) -> None:
    async with opened() as (_, jobs):
        load = Load()
        items = [float(n % 3 + 1) for n in range(12)]
        found = await values(jobs.stream(load.take, items, max_concurrency=most, ordered=ordered))
        assert sorted(found) == sorted(2 * item for item in items)
        assert load.most == most


async def test_each_result_says_what_it_was_given_and_failures_stop_nothing() -> None:
    async with opened() as (_, jobs):
        results = [result async for result in jobs.stream(Load().fail_odd, range(4), max_concurrency=2)]
        assert [result.item for result in results] == [0, 1, 2, 3]
        assert [type(result) for result in results] == [
            hf.supervision.Ok,
            hf.supervision.Failed,
            hf.supervision.Ok,
            hf.supervision.Failed,
        ]
        assert [str(result.error) for result in results if isinstance(result, hf.supervision.Failed)] == [
            "ValueError: 1 is odd",
            "ValueError: 3 is odd",
        ]


async def test_an_empty_source_gives_nothing() -> None:
    async def nothing() -> AsyncIterator[int]:
        for n in range(0):
            yield n

    async with opened() as (_, jobs):
        assert await values(jobs.stream(add, [])) == []
        assert await values(jobs.stream(add, nothing())) == []


@pytest.mark.parametrize("kind", ["sync", "async"])
async def test_the_source_is_pulled_only_as_fast_as_results_are_taken(kind: str) -> None:
    pulled = 0

    def numbers() -> Iterator[int]:
        nonlocal pulled
        for n in range(20):
            pulled += 1
            yield n

    async def numbers_later() -> AsyncIterator[int]:
        for n in numbers():
            await asyncio.sleep(0)
            yield n

    async with opened() as (system, jobs):
        source = numbers() if kind == "sync" else numbers_later()
        taken = 0
        async with contextlib.aclosing(jobs.stream(add, source, max_concurrency=3)) as results:
            async for result in results:
                assert result == hf.supervision.Ok(taken, taken + 1)
                taken += 1
                await idle(system)
                assert pulled <= taken + 3
        assert (taken, pulled) == (20, 20)


@virtual
async def test_results_come_while_a_slow_source_has_no_next_item() -> None:
    async def slow() -> AsyncIterator[float]:
        for _ in range(3):
            yield 1.0
            await asyncio.sleep(10.0)

    async with opened() as (_, jobs):
        loop, times = asyncio.get_running_loop(), list[float]()
        async for _ in jobs.stream(Load().take, slow(), max_concurrency=2):
            times.append(loop.time())
        assert times == [1.0, 11.0, 21.0]


@pytest.mark.parametrize("how", ["aclosing", "break", "raise"])
async def test_leaving_the_stream_early_ends_its_jobs(how: str) -> None:
    async with opened() as (system, jobs):
        load = Load()
        items = [0.0, 1000.0, 2000.0, 3000.0]
        if how == "aclosing":
            async with contextlib.aclosing(jobs.stream(load.take, items, max_concurrency=3)) as results:
                async for _ in results:
                    break
            assert load.running == 0, "closed is closed"
        elif how == "break":
            async for _ in jobs.stream(load.take, items, max_concurrency=3):
                break
        else:
            with contextlib.suppress(ZeroDivisionError):
                async for _ in jobs.stream(load.take, items, max_concurrency=3):
                    raise ZeroDivisionError
        await idle(system)
        assert (load.running, await jobs.children()) == (0, [])
        assert 3000.0 not in load.begun


@pytest.mark.parametrize("error", [LookupError, SystemExit])
async def test_an_error_of_the_source_ends_the_stream_and_its_jobs(error: type[BaseException]) -> None:
    def broken() -> Iterator[float]:
        yield 1000.0
        raise error("no more")

    async def broken_later() -> AsyncIterator[float]:
        for item in broken():
            yield item

    async with opened() as (_, jobs):
        sources: list[Callable[[], Any]] = [broken, broken_later]
        for source in sources:
            load = Load()
            with pytest.raises(error):
                await values(jobs.stream(load.take, source(), max_concurrency=2))
            assert (load.running, await jobs.children()) == (0, [])


@virtual
async def test_a_slow_job_ends_the_stream_or_only_itself() -> None:
    async with opened() as (system, jobs):
        load = Load()
        found = await values(
            jobs.stream(load.take, [1.0, 50.0, 2.0], max_concurrency=2, timeout=5.0, on_timeout="kill_task")
        )
        assert (found[0], found[2]) == (2.0, 4.0)
        assert "did not reply within 5 s" in found[1]
        assert asyncio.get_running_loop().time() == 6.0 - 1.0
        error = await refused(values(jobs.stream(load.take, [1.0, 50.0, 60.0], max_concurrency=3, timeout=5.0)))
        assert isinstance(error, hf.AskTimeout)
        await idle(system)
        assert (load.running, await jobs.children()) == (0, [])


async def test_a_stream_wider_than_the_supervisor_allows_is_refused() -> None:
    async with opened(max_children=2) as (_, jobs):
        gate = Gate()
        error = await refused(values(jobs.stream(gate, [1, 2, 3], max_concurrency=3)))
        assert error == hf.errors.MaxChildren(2)
        assert await jobs.children() == []
        assert await values(jobs.stream(add, range(9), max_concurrency=2)) == list(range(1, 10))


async def test_a_stream_of_processes() -> None:
    async with opened() as (_, jobs):
        assert await values(jobs.stream(add, [1, 2, 3], max_concurrency=2, isolation="process")) == [2, 3, 4]


@pytest.mark.parametrize("ordered", [True, False])
async def test_an_item_costs_the_same_however_many_run_at_once(ordered: bool) -> None:
    """Counted in callbacks that are hung on futures, not in seconds."""

    async def callbacks_with(most: int) -> int:
        count = 0

        def called(frame: object, event: str, function: Any) -> None:
            nonlocal count
            count += event == "c_call" and function.__name__ == "add_done_callback"

        async with opened() as (_, jobs):
            sys.setprofile(called)
            try:
                found = await values(jobs.stream(add, range(100), max_concurrency=most, ordered=ordered))
            finally:
                sys.setprofile(None)
        assert sorted(found) == list(range(1, 101))
        return count

    assert await callbacks_with(100) < 2 * await callbacks_with(5)
