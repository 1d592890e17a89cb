"""Waiting for what happens to a process: for an event, a pidfd, a word in its page; never for time to pass."""

from __future__ import annotations

import asyncio
import fcntl
import struct
import termios
from collections.abc import Callable
from typing import Any, TypeVar

import holdfast as hf
from holdfast.actors.process.process_host import WorkerPlace

SECONDS = 60.0

E = TypeVar("E", bound=hf.events.Event)


async def next_event(stream: hf.events.EventStream, kind: type[E], when: Callable[[E], bool] = lambda event: True) -> E:
    """The next event of this kind for which `when` holds; others are passed over."""
    async with asyncio.timeout(SECONDS):
        async for event in stream:
            if isinstance(event, kind) and when(event):
                return event
    raise AssertionError(f"the stream ended before a {kind.__name__}")


async def until(is_so: Callable[[], bool]) -> None:
    """Wait for something that only shows when it is looked at."""
    async with asyncio.timeout(SECONDS):
        while not is_so():
            await asyncio.sleep(0.002)


async def in_turn(system: hf.ActorSystem, ref: hf.ActorRef[Any], number: int) -> None:
    """Wait until the page of an actor's process says that message `number` is being handled."""
    worker = system._workers.of(ref._cell)
    assert worker is not None
    page = worker.page
    await until(lambda: page[0] == number)


async def stop_read(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """Wait until an actor's process has read the order to stop."""
    worker, host = system._workers.of(ref._cell), ref._cell.host.place
    assert worker is not None
    assert isinstance(host, WorkerPlace)
    connection, transport = worker.connection, worker.connection._transport
    assert transport is not None
    file = transport.get_extra_info("socket").fileno()

    def unread() -> int:
        (there,) = struct.unpack("i", fcntl.ioctl(file, termios.TIOCOUTQ, bytes(4)))
        return int(there) + len(connection._out) + transport.get_write_buffer_size()

    await until(lambda: host.stop_sent is not None and not unread())


async def end_of(pidfd: int) -> None:
    """Wait until the process has ended."""
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(pidfd, ended.set)
    try:
        async with asyncio.timeout(SECONDS):
            await ended.wait()
    finally:
        loop.remove_reader(pidfd)
