"""What asyncio promises holds in every schedule: a program that relies on it is right, and is told nothing."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from typing import Any

import anyio
import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, idle, simulate
from tests.testing.schedules.planted import Note, Step

STRATEGIES = ("mixed", "random", "pct", "coverage")
Right = Callable[[GuardedSystem], Coroutine[Any, Any, None]]


async def adds_a_callback_and_awaits(system: GuardedSystem) -> None:
    called: list[int] = []
    loop = asyncio.get_running_loop()
    future = loop.create_future()
    future.add_done_callback(lambda _: called.append(1))
    loop.call_soon(future.set_result, None)
    await future
    assert called


async def discards_a_task_that_is_done(system: GuardedSystem) -> None:
    tasks: set[asyncio.Task[None]] = set()
    task = asyncio.create_task(asyncio.sleep(0))
    tasks.add(task)
    task.add_done_callback(tasks.discard)
    await task
    assert not tasks


async def calls_before_a_task_begins(system: GuardedSystem) -> None:
    called: list[int] = []

    async def begins() -> None:
        assert called

    asyncio.get_running_loop().call_soon(called.append, 1)
    await asyncio.create_task(begins())


async def speaks_through_a_socket(system: GuardedSystem) -> None:
    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(await reader.readline())
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(echo, "127.0.0.1", 0, family=socket.AF_INET)
    async with server:
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        writer.write(b"line\n")
        assert await reader.readline() == b"line\n"
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize(
    "right", [adds_a_callback_and_awaits, discards_a_task_that_is_done, calls_before_a_task_begins]
)
def test_a_callback_is_called_before_the_steps_scheduled_after_it(right: Right, strategy: str) -> None:
    simulate(right, seeds=60, strategy=strategy)()


@pytest.mark.filterwarnings("ignore::holdfast.testing.schedules.world.EscapesSimulation")
def test_a_connection_is_set_up_in_the_order_of_asyncio() -> None:
    simulate(speaks_through_a_socket, seeds=30)()


# -- what is in sets --------------------------------------------------------------------------------------------------


def notes(system: GuardedSystem) -> list[hf.ActorRef[Note]]:
    return [system.spawn(hf.start(Note), f"note {number}") for number in range(6)]


async def tell_all(refs: Iterable[hf.ActorRef[Note]], system: GuardedSystem) -> None:
    for ref in refs:
        ref.tell(Step(1))
    await idle(system)


async def sleeps_and_tells(ref: hf.ActorRef[Note], sleep: Callable[[float], Awaitable[object]]) -> None:
    try:
        await sleep(60)
    finally:
        ref.tell(Step(1))


async def goes_through_what_is_done(system: GuardedSystem) -> None:
    refs = notes(system)

    async def waits(number: int) -> int:
        await asyncio.sleep(1)
        return number

    done, _ = await asyncio.wait([asyncio.create_task(waits(number)) for number in range(6)])
    await tell_all([refs[task.result()] for task in done], system)


async def goes_through_asks_that_are_done(system: GuardedSystem) -> None:
    refs = notes(system)
    asks = {ref.ask(Step(1)): ref for ref in refs}
    done, _ = await asyncio.wait(asks)
    await tell_all([asks[ask] for ask in done], system)


async def cancels_what_is_pending(system: GuardedSystem) -> None:
    tasks = [asyncio.create_task(sleeps_and_tells(ref, asyncio.sleep)) for ref in notes(system)]
    _, pending = await asyncio.wait(tasks, timeout=1)
    for task in pending:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    await idle(system)


async def has_a_group_that_fails(system: GuardedSystem) -> None:
    try:
        async with asyncio.TaskGroup() as group:
            for ref in notes(system):
                group.create_task(sleeps_and_tells(ref, asyncio.sleep))
            await asyncio.sleep(1)
            raise ValueError
    except* ValueError:
        await idle(system)


async def cancels_a_scope(system: GuardedSystem) -> None:
    async with anyio.create_task_group() as group:
        for ref in notes(system):
            group.start_soon(sleeps_and_tells, ref, anyio.sleep)
        await anyio.sleep(1)
        group.cancel_scope.cancel()
    await idle(system)


async def takes_what_is_completed(system: GuardedSystem) -> None:
    async def asks(ref: hf.ActorRef[Note]) -> None:
        await ref.ask(Step(1))

    for one in asyncio.as_completed([asks(ref) for ref in notes(system)]):
        await one


@pytest.mark.parametrize(
    "right",
    [
        goes_through_what_is_done,
        goes_through_asks_that_are_done,
        cancels_what_is_pending,
        has_a_group_that_fails,
        cancels_a_scope,
        takes_what_is_completed,
    ],
)
def test_the_order_of_tasks_in_a_set_is_the_seeds(right: Right) -> None:
    simulate(right, seeds=60)()
