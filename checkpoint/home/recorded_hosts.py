"""The recovery controller: hosts that stand where a supervisor expects one.

"Start this child again" means here "bring it back": restore, replay, release; each phase timed and told.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable

import msgspec

from ...actors.errors import StartFailed, StartIgnored
from ...actors.exit_reasons import KILLED, ExitReason
from ...actors.kernel import lifecycle, links
from ...actors.kernel.cell import DOWN, GONE, RUNNING, Cell
from ...actors.kernel.envelope import Item
from ...actors.process.fork.child_processes import parent_of
from ...actors.process.process_host import ProcessHost
from ...actors.process.resource_limits import Limits
from ...actors.process.wire import frames
from ...actors.process.wire.connection import BadFrame
from ...actors.process.worker_pool import Worker, Workers
from ..life.recorded_life import Life, LifeHost
from ..method import Method
from ..protocol import Released, Snapshot, ToHome, ToLife, TurnEnd, Wanted
from ..turn_word import input_of
from .homes import ENDED, HomeHost, Homes
from .switch import Switch

FROM_LIFE: msgspec.msgpack.Decoder[ToHome] = msgspec.msgpack.Decoder(ToHome)


SENT = frozenset(("tell", "send", "ask", "forward", "publish"))
"""Outputs that are messages to somebody."""


class TaskHost(HomeHost, LifeHost):
    """The host of a recorded actor in this process."""

    takes_parcels = True

    def __init__(self, homes: Homes, method: Method) -> None:
        super().__init__(homes, method)
        self.life: Life | None = None

    def start(self, cell: Cell) -> asyncio.Future[None] | None:
        start = cell.extra().start
        assert start is not None
        cell.table = start.kind._table
        switch, live, recovering = self.enter(cell)
        if self.is_gated:
            begun = self._step_by_step(cell, switch, live, recovering)
        else:
            self.isolated()
            self._begin(cell, switch)
            self._replay(cell, switch)
            begun = self._follow(cell, live, recovering)
        self._starting = lifecycle.outside_turn(cell, begun)
        return self._starting

    def _begin(self, cell: Cell, switch: Switch) -> None:
        """S3, the new life with its state."""
        start = cell.extra().start
        assert start is not None
        self.page = self.homes.page(switch)
        life = self.life = Life(cell, LocalHome(self, cell), self.method, self.page)
        for record in switch.restore_records():
            life.to_life(record)
        life.begin(start, switch.state_turn, switch.stash)
        assert self.clock is not None
        self.clock.mark("restart")

    def _replay(self, cell: Cell, switch: Switch) -> None:
        """S3, what it has handled since."""
        assert self.life is not None
        self.subscribe(cell)
        switch.attach(self.life)

    async def _step_by_step(self, cell: Cell, switch: Switch, live: asyncio.Future[float], recovering: bool) -> None:
        """A recovery on whose way others have something to do."""
        await self.gate("restart")
        if cell.state is not DOWN:
            raise StartFailed(cell.path, "it was stopped while it started")
        self._begin(cell, switch)
        await self.gate("replay")
        if not live.done():  # Else it has ended meanwhile.
            self._replay(cell, switch)
        await self._follow(cell, live, recovering)

    async def _follow(self, cell: Cell, live: asyncio.Future[float], recovering: bool) -> None:
        try:
            await self.until_live(cell, live, recovering)
        except StartIgnored:
            await cell.ended()  # The next life begins when this one is over.
            raise
        except StartFailed as error:
            if cell.state not in (DOWN, GONE):  # Its replay diverged: the next life begins when this one is over.
                cell.kill()
                await cell.ended()
                raise
            raise StartFailed(cell.path, error.reason if error.reason != ENDED else str(cell.extra().reason)) from error
        self.clock = None

    def push(self, cell: Cell, item: Item) -> None:
        if isinstance(item, (links.Exit, links.Down)):
            assert self.switch is not None
            super().push(cell, item)
        else:
            LifeHost.push(self, cell, item)

    def kill(self, cell: Cell) -> None:
        if cell.state is DOWN and self._starting is not None:
            self._starting.cancel()
        else:
            super().kill(cell)

    def running(self, cell: Cell) -> int:
        feed = self.life.feed if self.life is not None else None
        return -1 if feed is None else feed.id


class LocalHome:
    """From a life to its home, in one process."""

    def __init__(self, host: TaskHost, cell: Cell) -> None:
        self._host, self._cell = host, cell
        self._is_open = True

    def to_home(self, record: ToHome) -> None:
        switch = self._host.switch
        if switch is not None and self._is_open:
            switch.from_life(record)

    def when_told(self, then: Callable[[], None]) -> None:
        then()

    def closed(self) -> None:
        if self._is_open:
            self.shut()
            self._host.over(self._cell, self._host.running(self._cell), ENDED, ordered=True)

    def shut(self) -> None:
        """What the life says from now on is not heard, nor its end: it has been moved away."""
        self._is_open = False


class RecordedProcessHost(HomeHost, ProcessHost):
    """The host of a recorded actor with a process of its own."""

    def __init__(self, workers: Workers, limits: Limits | None, homes: Homes, method: Method) -> None:
        ProcessHost.__init__(self, workers, limits)
        HomeHost.__init__(self, homes, method)

    def start(self, cell: Cell) -> asyncio.Future[None]:
        start = cell.extra().start
        assert start is not None
        cell.table = start.kind._table
        # Now, not in the task: from here on what is sent is admitted by the home.
        return self.begin(cell, self._recover(cell, *self.enter(cell)))

    async def _recover(self, cell: Cell, switch: Switch, live: asyncio.Future[float], recovering: bool) -> None:
        await self.gate("restart")
        worker, recipe = await self.take(cell)
        worker.record_taker = functools.partial(own_records, worker, switch)
        self.subscribe(cell)
        port = RemoteLife(cell.path, worker)
        for record in switch.restore_records():
            port.to_life(record)
        options = {"recorded": {"method": self.method.data(), "turn": switch.state_turn, "stash": switch.stash}}
        try:
            await worker.launch(cell, recipe, options)
            await self.replay(cell, port, live, recovering)
        except StartFailed:
            await worker.gone()  # The next life begins when this one is over.
            raise
        self.is_live(cell)

    def is_live(self, cell: Cell) -> None:
        """The life in the process is the one; if it was to be stopped before, it is stopped now."""
        self.clock = None
        if self._stop_wanted is not None:
            self.stop(cell, self._stop_wanted)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        worker = self._workers.of(cell)
        if worker is None or self.switch is None or not self.switch.is_live:
            self._stop_wanted = reason
            return
        self.send_stop(worker, cell, reason)

    def died(self, cell: Cell, reason: ExitReason) -> None:
        """The process is gone: the home keeps everything, and counts deaths in the same turn."""
        worker = self._workers.of(cell)
        if worker is None or cell.state is not RUNNING:
            return
        running = input_of(worker.page[0])
        noticed = worker.noticed_at
        self.over(cell, running, str(reason), ordered=reason == KILLED, noticed=noticed, reason=reason)
        lifecycle.ended(cell, reason)

    def running(self, cell: Cell) -> int:
        worker = self._workers.of(cell)
        return -1 if worker is None else input_of(worker.page[0])

    def retired(self, cell: Cell) -> None:
        ProcessHost.retired(self, cell)
        self.give_up(cell)


def own_records(worker: Worker, switch: Switch, path: str) -> frames.TakeRecord:
    """Who takes the records of a process with one recorded actor."""
    return records_of(worker, switch.from_life)


def records_of(worker: Worker, take: Callable[[ToHome], None]) -> frames.TakeRecord:
    """Hand the records of a life in a process on, as far as it may say such a thing.

    Raises (when one comes):
        BadFrame: it sends what it may not send, or names the memory of another process.
    """
    decode, gate = FROM_LIFE.decode, worker.gate

    def taken(frame: frames.Record) -> None:
        record = decode(frame.body)
        if isinstance(record, (TurnEnd, Released)):
            for out in record.outs:
                if out.verb in SENT:
                    gate.output(out.to, out.name)
        elif isinstance(record, Wanted):
            gate.claims(record.bindings)
        elif isinstance(record, Snapshot) and record.image is not None:
            pid = record.image.pid
            if pid != worker.pid and parent_of(pid) != worker.pid:
                raise BadFrame(f"an image in the memory of process {pid}")
        take(record)

    return taken


class RemoteLife:
    """From a home to its life, in another process."""

    begins = True

    def __init__(self, path: str, worker: Worker) -> None:
        self._path, self._connection = path, worker.connection

    def to_life(self, record: ToLife) -> None:
        self._connection.send(frames.Record(self._connection.name_out(self._path), record), self._path)  # type: ignore[arg-type]  # encoded in place
