"""The idle barrier: wait until nothing can happen any more by itself, instead of sleeping and hoping.

Idle means: no actor is on the run queue, every task of the loop waits for something that nobody here is about to do,
and each actor process has handled what it was sent and said what it had to say. What is left then needs time to pass
(a timer, a deadline) or something from outside.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Iterable
from typing import TYPE_CHECKING, Any

import msgspec

from ..actors.errors import HoldfastError
from ..actors.kernel.loop import RunLoop
from ..actors.kernel.message import message_of
from ..actors.kernel.timers import LoopTimer
from ..actors.process.process_host import Outlet
from ..actors.process.wire import frames
from ..actors.process.worker_pool import Worker
from ..actors.seconds import check_seconds
from ..checkpoint.home.recorded_home import switch_of
from .clock import VirtualClockLoop

if TYPE_CHECKING:
    from ..actors.kernel.cell import Cell
    from ..actors.kernel.node import Node
    from ..system.system import ActorSystem
    from .schedules.processes import SimulatedWorkers

TIMEOUT = 10.0
"""Seconds on the loop's clock."""
QUIET = 3
"""Ticks of the loop in a row in which nothing moves: a callback that is due now may still wake somebody."""
NIL = msgspec.Raw(msgspec.msgpack.encode(None))
SHOWN = 8
"""Of those who move, so many are named."""
PING = "holdfast.testing:Ping"
"""A message name that nobody has: the refusal comes back behind everything that was said before."""


class NotIdle(HoldfastError, TimeoutError):
    """The system did not come to rest: `after` so much of something; `busy` says what still moved."""

    after: str
    busy: tuple[str, ...]

    def __str__(self) -> str:
        return f"not idle after {self.after}: {'; '.join(self.busy) or 'something came up each time'}"


@contextlib.asynccontextmanager
async def patience(timeout: float | None, node: Node | None = None) -> AsyncGenerator[None]:
    """`asyncio.timeout` that ends also when virtual time does not go on: a clock that stands still times nothing out.

    Raises:
        TimeoutError: the seconds are over. NotIdle: virtual time stood still.
    """
    loop, own = asyncio.get_running_loop(), asyncio.current_task()
    stood_still: list[NotIdle] = []
    try:
        async with asyncio.timeout(timeout) as limit:
            if not isinstance(loop, VirtualClockLoop):
                yield
                return

            def expire(why: str) -> None:
                error = loop.restless(why)
                if not stood_still and not limit.expired():
                    stood_still.append(NotIdle(why, tuple(_busy(node, own)) or error.busy))
                    limit.reschedule(loop.time())

            with loop.hears_of_standstill(expire):
                yield
    except TimeoutError:
        if stood_still:
            raise stood_still[0] from None
        raise


async def idle(system: ActorSystem, *, timeout: float = TIMEOUT) -> None:
    """Wait until nothing is queued and nothing that runs could go on.

    Time that has to pass (a timer, a back-off before a restart) and work in threads are not waited for.

    Args:
        system: a running one. Its actors in processes of their own are asked for a round trip each; of a subtree in a
            process only the turns of its supervisor are known, and what an actor there tells itself is not.
        timeout: seconds on the loop's clock, finite and > 0. Turns that wait for time or for the outside are not waited
            for here, but those in other processes are: nobody sees from here what they wait for.

    Raises:
        NotIdle: it went on all that time, or without end at one moment of virtual time; one task at a time may wait
            for this. SpecError: `timeout` is no such number.
    """
    check_seconds("idle", "timeout", timeout)
    node = system._node
    try:
        async with patience(timeout, node):
            while True:
                await quiet(node)
                if not await _hear(system):
                    return
    except NotIdle:
        raise
    except TimeoutError:
        raise NotIdle(f"{timeout:g} s", tuple(_busy(node) + _waiting(system))) from None


async def quiet(node: Node | None = None) -> None:
    """Wait until no task of this loop could go on, and no actor of the node is ready."""
    calm, loop = 0, asyncio.get_running_loop()
    rest = loop.rest if isinstance(loop, VirtualClockLoop) else None
    while calm < QUIET:
        await (asyncio.sleep(0) if rest is None else rest())
        calm = 0 if _busy(node) else calm + 1


def _busy(node: Node | None, own: asyncio.Task[Any] | None = None) -> list[str]:
    """What could go on now, apart from the task that wants to know."""
    own = own or asyncio.current_task()
    found = [_told(cell) for cell in node.ready] if node is not None else []
    if node is not None and node.awake and not found:
        found.append("the run queue")
    found += [task.get_name() for task in asyncio.all_tasks() if task is not own and _could_go_on(task)]
    return found


def _told(cell: Cell) -> str:
    """An actor, and the message that it handles next."""
    message = message_of(cell.queue[0]) if cell.queue else None
    return cell.path if message is None else f"{cell.path} ({type(message).__name__})"


def movers(handles: Iterable[asyncio.Handle]) -> list[str]:
    """Who is behind the callbacks of a loop: actors with their messages, tasks by name, functions; each once."""
    found: dict[str, None] = {}
    for handle in handles:
        callback = getattr(handle, "_callback", None)  # None: it was cancelled.
        match owner := getattr(callback, "__self__", None):
            case RunLoop():
                found.update(dict.fromkeys(map(_told, owner.ready)))
            case LoopTimer(message=message):
                found[f"{owner._cell.path} (timer of {type(message).__name__})"] = None
            case asyncio.Task():
                found[owner.get_name()] = None
            case None if callback is None:
                pass
            case _:
                found[getattr(callback, "__qualname__", repr(callback))] = None
    return list(found)[:SHOWN]


def _could_go_on(task: asyncio.Task[Any]) -> bool:
    """Whether a task waits for nothing, or for something that is there."""
    waiter = waiter_of(task)
    return waiter is None or waiter.done()


def waiter_of(task: asyncio.Task[Any]) -> asyncio.Future[Any] | None:
    """What a task waits for, which asyncio's own debug output shows as `wait_for`; None: it could go on."""
    waiter: asyncio.Future[Any] | None = getattr(task, "_fut_waiter", None)
    return waiter


def _simulated(system: ActorSystem) -> SimulatedWorkers | None:
    """The pool of a simulated run; None: the processes are real."""
    from .schedules.processes import SimulatedWorkers  # It takes long to import, and few tests simulate.

    pool = system._workers
    return pool if isinstance(pool, SimulatedWorkers) else None


async def _hear(system: ActorSystem) -> bool:
    """One round trip through each actor process. Returns whether anything moved, or may have."""
    simulated = _simulated(system)
    if simulated is not None:  # Their turns are in this loop, and what is on its way is known.
        return await simulated.arrived() or bool(_busy(system._node))
    moved = bool(_waiting(system))
    for worker in list(system._workers.by_cell.values()):
        moved |= await _ping(worker)
    return moved or bool(_busy(system._node))


async def _ping(worker: Worker) -> bool:
    """Everything the process said before its answer has been taken in when this returns. Whether it said anything."""
    if not worker.connection.is_open:
        return True  # It has ended, and what follows from that is still to come.
    counter = FrameCounter(worker)
    try:
        key, answered = worker.acceptance()
        name = worker.connection.names.to_wire(worker.cell.path if worker.cell is not None else "/")
        worker.connection.send(frames.Ask(key, name, worker.connection.names.to_wire(PING), NIL, TIMEOUT))
        try:
            await answered
        except HoldfastError:
            pass  # As it must be: nobody has a handler for it, or the process has ended meanwhile.
    finally:
        counter.close()
    return counter.count > 1


class FrameCounter:
    """Counts what comes from a process: `takers` first, all else by `_on_frame`."""

    def __init__(self, worker: Worker) -> None:
        self.count = 0
        self._connection = worker.connection
        self._on_frame = self._connection._on_frame
        self._takers = dict(self._connection.takers)
        self._connection._on_frame = self._counted(self._on_frame)
        self._connection.takers = {kind: self._counted(take) for kind, take in self._takers.items()}

    def _counted(self, take: Any) -> Any:
        def counted(frame: Any) -> None:
            self.count += not isinstance(frame, frames.Beat)
            take(frame)

        return counted

    def close(self) -> None:
        """Count no more."""
        self._connection._on_frame, self._connection.takers = self._on_frame, self._takers


def _waiting(system: ActorSystem) -> list[str]:
    """Actors in real processes that have not handled what they were sent."""
    found: list[str] = []
    if _simulated(system) is not None:
        return found
    for cell in system._workers.by_cell:
        outlet = cell.more.outlet if cell.more is not None else None
        switch = switch_of(cell)
        if switch is not None:
            if set(switch.open) - switch.ledger.stashed():  # To those nothing happens by itself.
                found.append(f"{cell.path} has {len(switch.open)} inputs in hand")
        elif isinstance(outlet, Outlet):
            outlet.trim()
            if outlet.flight:
                found.append(f"{cell.path} has {len(outlet.flight)} messages in hand")
    return found
