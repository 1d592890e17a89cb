"""Processes of a simulated run: each actor's process is a guest in the loop of the run, over the real frames and codec.

What a real process has and this one has not: memory of its own (what is no message is shared), limits, its standard
output, and threads that block it. What a kill does is the same: nothing of it runs again, no `finally`, no `on_stop`;
what it had written to its socket comes, and then the end of that.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import os
import signal
from collections import deque
from collections.abc import Callable
from contextvars import Context, copy_context
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

import msgspec

from ...actors.errors import HoldfastError
from ...actors.exit_reasons import ExitReason
from ...actors.kernel.cell import Cell
from ...actors.kernel.codec import Codec
from ...actors.process import worker_node
from ...actors.process.effect_main import answered
from ...actors.process.effect_processes import EffectProcesses
from ...actors.process.fork.boot import PAGE_BYTES
from ...actors.process.fork.child_processes import parent_of
from ...actors.process.process_host import on_frame
from ...actors.process.resource_limits import Limits
from ...actors.process.wire import frames
from ...actors.process.wire.connection import HIGH_BYTES, Connection
from ...actors.process.worker_pool import Worker, Workers
from ...checkpoint.life.recorded_context import RecordedContext
from ...system.worker_main import WorkerComposition
from ..latencies import DelayLine
from .places import ProgramPlace, SimulatedPlace, inside

if TYPE_CHECKING:
    from ...actors.kernel.node import Node
    from .control import ControlledLoop

FIRST_PID: Final = 2**22 + 1
"""Larger than any that the kernel gives, so that a signal to it hits nobody."""


class Pipe(asyncio.Transport):
    """One end of a socket pair: what is written comes to the other end, in order, late by what is drawn.

    Args:
        pool: knows how late.
        owner: the process whose end it is; None: the root.
        context: in which its protocol is called.
    """

    def __init__(self, pool: SimulatedWorkers, owner: SimulatedProcess | None, context: Context) -> None:
        super().__init__()
        self.owner, self.context = owner, context
        self.other: Pipe
        self.protocol: asyncio.BufferedProtocol
        self._pool = pool
        self._line = DelayLine(pool.loop, pool.loop.latencies.of("frames"))
        self._arrived: deque[bytes] = deque()  # and our protocol has not read it
        self._unread = 0  # bytes that the other end has not read
        self._is_reading, self._is_closing, self._is_full = True, False, False

    def connect(self, protocol: asyncio.BufferedProtocol, other: Pipe) -> None:
        """Speak to the other end from now on."""
        self.protocol, self.other = protocol, other
        self.context.run(protocol.connection_made, self)

    # -- what a connection asks of its transport --------------------------------------------------------------------

    def write(self, data: Any) -> None:
        if self._is_closing:
            return
        copy = bytes(data)
        self._unread += len(copy)
        if self._unread > HIGH_BYTES and not self._is_full:
            self._is_full = True
            self.protocol.pause_writing()
        self._line.send(functools.partial(self.other.arrived, copy), self.other.context)

    def writelines(self, list_of_data: Any) -> None:
        self.write(b"".join(list_of_data))

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """As they are."""

    def pause_reading(self) -> None:
        self._is_reading = False

    def resume_reading(self) -> None:
        self._is_reading = True
        self._read()

    def is_closing(self) -> bool:
        return self._is_closing

    def close(self) -> None:
        self.end()
        self._pool.loop.call_soon(self.protocol.connection_lost, None, context=self.context)

    def abort(self) -> None:
        self.close()

    # -- on the way -------------------------------------------------------------------------------------------------

    def times(self) -> list[float]:
        """When each thing that was written here arrives."""
        return self._line.times()

    def end(self) -> None:
        """Nothing more is written here: the other end sees that behind what was written."""
        if not self._is_closing:
            self._is_closing = True
            self._line.send(self.other.ended, self.other.context)

    def arrived(self, data: bytes) -> None:
        """The other end has written this."""
        self._arrived.append(data)
        self._read()

    def ended(self) -> None:
        """The other end is closed."""
        if not self._is_closing:
            self._is_reading = True
            self._read()
            self._is_closing = True
            self.protocol.connection_lost(None)

    def _read(self) -> None:
        while self._arrived and self._is_reading and not self._is_closing:
            data = memoryview(self._arrived.popleft())
            self.other.was_read(len(data))
            while data and not self._is_closing:
                room = cast("memoryview", self.protocol.get_buffer(len(data)))
                size = min(len(room), len(data))
                room[:size] = data[:size]
                data = data[size:]
                self.protocol.buffer_updated(size)

    def was_read(self, size: int) -> None:
        """The other end has read so many bytes."""
        self._unread -= size
        if self._is_full and self._unread <= HIGH_BYTES // 4:
            self._is_full = False
            self._pool.loop.call_soon(self.protocol.resume_writing, context=self.context)


class SimulatedProcess(SimulatedPlace):
    """One process: a guest with a node of its own, all of whose callbacks are marked as its own.

    Attributes:
        pid: its number, which no real process has.
    """

    def __init__(self, pid: int, pool: SimulatedWorkers) -> None:
        super().__init__(pool.place_name)
        self.pid, self.pool = pid, pool
        self.page = bytearray(PAGE_BYTES)
        self.context = Context()
        self.guest: worker_node.Guest
        self._on_exit: Callable[[int], None] = lambda status: None
        self.context.run(inside.set, self)

    # What the pool knows of a forked process:
    pidfd = -1

    def kill(self, signum: int | None = None) -> bool:
        """SIGKILL, or another signal that it dies of, at once. True, as of a process that there is."""
        self.die(int(signum or signal.SIGKILL))
        return True

    def owns(self, pid: int) -> bool:
        """Whether a process is the real one in which all simulated ones are, or a child of it."""
        return os.getpid() in (pid, parent_of(pid))

    def close(self) -> None:
        """Nothing to be given back."""

    def boot(self, ours: Connection, died: Callable[[int], None]) -> None:
        """Begin to serve the root, which speaks over this connection."""
        self._on_exit = died
        self.context.run(self._boot, ours)

    def _boot(self, ours: Connection) -> None:
        loop = asyncio.get_running_loop()
        guest = self.guest = worker_node.Guest(
            loop, memoryview(self.page).cast("Q"), WorkerComposition, None, SimulatedEffectProcess
        )
        self.nodes.append(guest.node)
        theirs = Connection(guest.on_frame, guest.on_lost, guest.on_batch)
        guest.join(theirs)
        theirs.takers = guest.takers
        self.pool.born(self)
        root_end = Pipe(self.pool, None, self.pool.root_context)
        end = self._end = Pipe(self.pool, self, self.context)
        end.other, root_end.other = root_end, end
        root_end.connect(ours, end)
        self.pool.loop.call_soon(end.connect, theirs, root_end, context=copy_context())
        guest.ended.add_done_callback(lambda ended: self.die(ended.result() << 8))

    def on_its_way(self) -> list[float]:
        """When each thing arrives that has been written to it or by it."""
        ways = [self._end] if self.is_dead else [self._end, self._end.other]
        return [when for way in ways for when in way.times()]

    def die(self, status: int) -> None:
        """End it: nothing of it runs any more, and the root sees the end of its socket and its status.

        Args:
            status: as `waitpid` reports it.
        """
        if self.is_dead:
            return
        self._end.end()
        self.pool.loop.drop(self)
        self._give_back()
        self.pool.loop.call_soon(self._on_exit, status, context=self.pool.root_context)

    def _give_back(self) -> None:
        """Give back the memory in which its actors had images of their states, and its timers, as the kernel does."""
        waiting = [cell for cell in (self.guest.node.root,) if cell is not None]
        while waiting:
            cell = waiting.pop()
            if isinstance(cell.ctx, RecordedContext):
                cell.ctx.recorded.images.close()
            waiting.extend((cell.children or {}).values())
        self.guest.node.deadlines.close()


class SimulatedServer:
    """In place of the fork server."""

    preload_errors: ClassVar[dict[str, str]] = {}
    is_deaf = False

    def has_ended(self) -> bool:
        """Never."""
        return False

    def expect_exits(self) -> None:
        """Nothing: simulated processes tell of their end themselves."""


class SimulatedWorker(Worker):
    """The root's side of a simulated process: all of it is the real one's but what only the kernel can tell."""

    process: SimulatedProcess

    async def connect(self) -> None:
        self.process = cast("SimulatedProcess", self.forked)
        connection = Connection(self._on_frame, self._on_lost, guarded=True)
        self.join(connection)
        connection.takers = {
            frames.Reply: self.on_reply,
            frames.Failure: self.on_failure,
            frames.Forget: self.on_forget,
        }
        self.process.boot(connection, self.on_exit)

    def is_alive(self) -> bool:
        return self.connection.is_open and not self.process.is_dead

    def reserve(self, cell: Cell, limits: Limits | None, died: Callable[[Cell, ExitReason], None]) -> None:
        super().reserve(cell, None, died)  # No kernel watches over it.

    def hung(self, seconds: float) -> None:
        """Never: whatever blocks it blocks the run."""


class SimulatedEffectProcess:
    """A process for the functions of effects: they run in that of the test, one at a time, and cannot end it."""

    is_alive = True

    def __init__(self) -> None:
        self._codec = Codec(_no_refs)

    async def call(self, request: bytes) -> bytes:
        """Answer a request when all that is ready now has run."""
        await asyncio.sleep(0)
        return msgspec.msgpack.encode(answered(self._codec, request))

    def end(self) -> None:
        """Nothing is left of it."""


def _no_refs(path: str) -> Cell:
    raise HoldfastError(f"no ref comes to the function of an effect, and {path} has")


class SimulatedWorkers(Workers):
    """The pool of a simulated run."""

    def __init__(self, node: Node, loop: ControlledLoop) -> None:
        super().__init__(node, "", [], on_frame, warm=0)
        self.loop = loop
        self.root_context = copy_context()
        place = inside.get()
        self.place_name = "" if place is None else place.name
        if isinstance(place, ProgramPlace):
            place.pools.append(self)
        self._pids = itertools.count(FIRST_PID)
        self._processes: list[SimulatedProcess] = []
        self._stub = SimulatedServer()
        self.effects = EffectProcesses(node.codec, SimulatedEffectProcess)

    async def arrived(self) -> bool:
        """Let time pass until what is on its way now has arrived. Returns whether anything was."""
        times = [when for process in self._processes for when in process.on_its_way()] + self.loop.on_their_way()
        if times:
            await asyncio.sleep(max(0.0, max(times) - self.loop.time()))
        return bool(times)

    async def _fork(self) -> Worker:
        seconds = self.loop.latencies.of("starts")()
        if seconds:
            await asyncio.sleep(seconds)
        process = SimulatedProcess(next(self._pids), self)
        worker = SimulatedWorker(self, cast("Any", process), cast("Any", self._stub))
        self._alive[process.pid] = worker
        await worker.connect()
        return worker

    def born(self, process: SimulatedProcess) -> None:
        """A process has its node."""
        self._processes.append(process)

    async def close(self) -> None:
        await super().close()
        self.end()

    def end(self) -> None:
        """Every process dies."""
        for process in self._processes:
            process.die(signal.SIGKILL)


def no_limits(limits: dict[str, Any]) -> None:
    """They would be the limits of the test's own process."""
