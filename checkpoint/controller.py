"""The recovery controller: detect, isolate, restart, restore, replay, release; each phase timed and told.

It stands where a supervisor expects a host: "start this child again" means here "bring it back".
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

import msgspec

from ..actors import lives
from ..actors.cell import DOWN, GONE, RUNNING, Cell
from ..actors.errors import HoldfastError, StartFailed
from ..actors.events import ActorStarted, Recovered, RecoveryFailed
from ..actors.exits import KILLED, ExitReason
from ..actors.mail import Item
from ..actors.process import frames
from ..actors.process.limits import Limits
from ..actors.process.recipe import pack_recipe
from ..actors.process.remote import ProcessHost
from ..actors.process.workers import Worker, Workers
from .journal import Journal
from .life import Life, StopRecorded
from .method import Method
from .records import Restore, ToHome, ToLife
from .switch import Switch

if TYPE_CHECKING:
    from ..actors.node import Node
    from ..actors.process.guest import Guest

Raw = msgspec.Raw


ENDED = "it ended before it was live"


class Homes:
    """All recorded addresses of a root, and their journal. A home stays when its actor is stopped."""

    def __init__(self, node: Node, journal: Journal) -> None:
        self.node, self.journal = node, journal
        self._switches: dict[str, Switch] = {}

    def of(self, cell: Cell, method: Method) -> Switch:
        """The home of an address; taken up from the store when it is first asked for."""
        switch = self._switches.get(cell.path)
        if switch is None:
            switch = self._switches[cell.path] = Switch(self.node, cell.path, method, self.journal)
        switch.method = method
        switch.cell = cell
        return switch

    def erase(self, path: str) -> None:
        """Forget all about an address."""
        self._switches.pop(path, None)
        self.journal.erase(path)

    def close(self) -> None:
        """Close the store."""
        self.journal.close()


class Clock:
    """The phases of one recovery. (Clocks of loops are too coarse for this.)"""

    __slots__ = ("_marks",)

    def __init__(self) -> None:
        self._marks: dict[str, float] = {}

    def mark(self, phase: str, when: float | None = None) -> None:
        """This phase is over now."""
        self._marks[phase] = time.monotonic() if when is None else when

    def phases(self, restore_seconds: float) -> dict[str, float]:
        """Seconds by phase."""
        spans: dict[str, float] = {}
        before = self._marks.get("noticed")
        for phase in ("detect", "isolate", "restart", "replay", "release"):
            after = self._marks.get(phase)
            if after is None:
                continue
            spans[phase] = max(0.0, after - before) if before is not None else 0.0
            before = after
        spans["restart"] = max(0.0, spans.get("restart", 0.0) - restore_seconds)
        spans["restore"] = restore_seconds
        return spans


class TaskHost(lives.LocalHost):
    """The host of a recorded actor in this process."""

    takes_parcels = True

    def __init__(self, homes: Homes, method: Method) -> None:
        self._homes, self._method = homes, method
        self.switch: Switch | None = None
        self._life: Life | None = None
        self._clock: Clock | None = None

    def start(self, cell: Cell) -> asyncio.Future[None] | None:
        more = cell.extra()
        assert more.start is not None
        switch = self.switch = self._homes.of(cell, self._method)
        cell.table = more.start.kind._table
        cell.admit = switch.admit
        more.outlet = switch
        clock = self._clock = self._clock or Clock()
        clock.mark("isolate")
        live = switch.prepare()
        life = self._life = Life(cell, LocalHome(self), self._method.interval, None)
        for record in switch.restore_records():
            life.from_home(record)
        recovering = not switch.is_new
        life.begin(more.start, switch.state_turn, switch.stash)
        clock.mark("restart")
        for topic in (*more.start.kind._topics, *switch.topics):
            cell.node.topics.subscribe(topic, cell)
        switch.attach(LocalLife(life))
        task = cell.node.loop.create_task(self._follow(cell, live, recovering), name=f"start of {cell.path}")
        task.add_done_callback(_seen)
        return task

    async def _follow(self, cell: Cell, live: asyncio.Future[float], recovering: bool) -> None:
        try:
            await until_live(cell, live, self._clock, self.switch, recovering)
        except StartFailed as error:
            if cell.state not in (DOWN, GONE):  # Its replay diverged: the next life begins when this one is over.
                cell.kill()
                await cell.ended()
                raise
            raise StartFailed(cell.path, error.reason if error.reason != ENDED else str(cell.extra().reason)) from error
        self._clock = None

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if cell.state is RUNNING and self._life is not None:
            cell.urge(StopRecorded(self._life, reason))

    def push(self, cell: Cell, item: Item) -> None:
        if item.of_life and type(item).__module__ != "holdfast.actors.links" and self.switch is not None:
            super().push(cell, item)
        elif self.switch is not None:
            self.switch.push(item)

    def closed(self) -> None:
        """The life has ended."""
        switch = self.switch
        if switch is None:
            return
        switch.died(-1, ordered=True)
        if switch.cell is not None:
            keep_subscriptions(switch.cell)
        self._clock = Clock()
        self._clock.mark("noticed")
        self._clock.mark("detect")
        if switch.live is not None and not switch.live.done():
            switch.live.set_exception(StartFailed(switch.path, ENDED))
            switch.live.exception()  # Nobody may be left to look.

    def is_up(self, cell: Cell) -> bool:
        return self.switch is not None and self.switch.is_released

    def backlog(self, cell: Cell) -> int:
        feed = self._life.feed if self._life is not None else None
        return 0 if self.switch is None else self.switch.backlog(-1 if feed is None else feed.id)

    def recovers(self, reason: ExitReason) -> bool:
        """Whether an end for this reason is followed by a recovery."""
        return not reason.is_clean

    def retired(self, cell: Cell) -> None:
        if self.switch is not None:
            give_up(self.switch, cell)


class LocalHome:
    """From a life to its home, in one process."""

    def __init__(self, host: TaskHost) -> None:
        self._host = host
        self._is_open = True

    def to_home(self, record: ToHome) -> None:
        switch = self._host.switch
        if switch is not None and self._is_open:
            switch.from_life(record)

    def closed(self) -> None:
        if self._is_open:
            self._is_open = False
            self._host.closed()


class LocalLife:
    """From a home to its life, in one process."""

    def __init__(self, life: Life) -> None:
        self._life = life

    def to_life(self, record: ToLife) -> None:
        self._life.from_home(record)


async def until_live(
    cell: Cell, live: asyncio.Future[float], clock: Clock | None, switch: Switch | None, recovering: bool
) -> None:
    """Wait until a life has caught up, and tell of it.

    Raises:
        StartFailed: it did not.
    """
    node = cell.node
    try:
        restore_seconds = await live
        if clock is not None:
            clock.mark("replay", switch.live_at if switch is not None else None)
    except HoldfastError as error:
        node.emit(RecoveryFailed(cell.path, str(error)))
        raise error if isinstance(error, StartFailed) else StartFailed(cell.path, str(error)) from error
    except asyncio.CancelledError:
        raise StartFailed(cell.path, "it was stopped while it started") from None
    if node.watched:
        node.emit(ActorStarted(cell.path, cell.life))
    if recovering and clock is not None and switch is not None:
        clock.mark("release")
        if node.watched:
            node.emit(Recovered(cell.path, cell.life, switch.replayed, clock.phases(restore_seconds)))


def keep_subscriptions(cell: Cell) -> None:
    """A life is over, its address is not: what is published in between is admitted there too."""
    cell.extra().topics.clear()  # what would be unsubscribed with the life


def give_up(switch: Switch, cell: Cell) -> None:
    """The address is free: it hears nothing more."""
    start = cell.extra().start
    for topic in (*(start.kind._topics if start is not None else ()), *switch.topics):
        cell.node.topics.unsubscribe(topic, cell)
    parent = cell.parent
    switch.drop_all("it has stopped", keep_tells=parent is not None and parent.state is not RUNNING)


def _seen(start: asyncio.Task[None]) -> None:
    """Look at the outcome of a start: perhaps nobody else does, when the system stops meanwhile."""
    if not start.cancelled():
        start.exception()


class RecordedProcessHost(ProcessHost):
    """The host of a recorded actor with a process of its own."""

    def __init__(self, workers: Workers, limits: Limits | None, homes: Homes, method: Method) -> None:
        super().__init__(workers, limits)
        self._homes, self._method = homes, method
        self.switch: Switch | None = None
        self._clock: Clock | None = None
        self._decoder = msgspec.msgpack.Decoder(ToHome)

    def start(self, cell: Cell) -> asyncio.Future[None]:
        more = cell.extra()
        assert more.start is not None
        switch = self.switch = self._homes.of(cell, self._method)
        cell.table = more.start.kind._table
        cell.admit = switch.admit
        more.outlet = switch
        self._stop_wanted = None
        self._starting = cell.node.loop.create_task(self._recover(cell, switch), name=f"start of {cell.path}")
        self._starting.add_done_callback(_seen)
        return self._starting

    async def _recover(self, cell: Cell, switch: Switch) -> None:
        start = cell.extra().start
        assert start is not None
        node = cell.node
        clock = self._clock or Clock()
        clock.mark("isolate")
        live = switch.prepare()
        recovering = not switch.is_new
        try:
            recipe = pack_recipe(start, cell.path)
            worker = await self._workers.take()
        except HoldfastError as error:
            raise StartFailed(cell.path, str(error)) from error
        if cell.state is not DOWN:
            worker.kill(KILLED)
            raise StartFailed(cell.path, "it was stopped while it started")
        cell.life += 1
        cell.state = RUNNING
        worker.adopt(cell, self._limits, self.died)
        worker.on_record = lambda frame: switch.from_life(self._decoder.decode(frame.body))
        for topic in (*start.kind._topics, *switch.topics):
            node.topics.subscribe(topic, cell)
        port = RemoteLife(cell.path, worker)
        for record in switch.restore_records():
            port.to_life(record)
        options = {"recorded": {"interval": self._method.interval, "turn": switch.state_turn, "stash": switch.stash}}
        try:
            await worker.launch(cell, recipe, options)
        except StartFailed:
            await worker.gone()
            raise
        clock.mark("restart")
        switch.attach(port)
        try:
            await until_live(cell, live, clock, switch, recovering)
        except StartFailed:
            await worker.gone()  # The next life begins when this one is over.
            raise
        self._clock = None
        if self._stop_wanted is not None:
            self.stop(cell, self._stop_wanted)

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        worker = self._workers.of(cell)
        if worker is None or self.switch is None or not self.switch.is_released:
            self._stop_wanted = reason
            return
        self.send_stop(worker, cell, reason)

    def died(self, cell: Cell, reason: ExitReason) -> None:
        """The process is gone: the home keeps everything, and counts deaths in the same turn."""
        switch, worker = self.switch, self._workers.of(cell)
        if switch is None or worker is None or cell.state is not RUNNING:
            return
        self._clock = Clock()
        self._clock.mark("noticed", worker.noticed_at)
        self._clock.mark("detect")
        switch.died(int(worker.page[0]) - 1, ordered=reason == KILLED)
        if switch.live is not None and not switch.live.done():
            switch.live.set_exception(StartFailed(cell.path, str(reason)))
            switch.live.exception()  # Nobody may be left to look.
        keep_subscriptions(cell)
        lives.ended(cell, reason)

    def push(self, cell: Cell, item: Item) -> None:
        if self.switch is not None:
            self.switch.push(item)

    def is_up(self, cell: Cell) -> bool:
        return self.switch is not None and self.switch.is_released

    def backlog(self, cell: Cell) -> int:
        worker = self._workers.of(cell)
        return 0 if self.switch is None else self.switch.backlog(-1 if worker is None else int(worker.page[0]) - 1)

    def recovers(self, reason: ExitReason) -> bool:
        """Whether an end for this reason is followed by a recovery."""
        return not reason.is_clean

    def retired(self, cell: Cell) -> None:
        super().retired(cell)
        if self.switch is not None:
            give_up(self.switch, cell)


class RemoteLife:
    """From a home to its life, in another process."""

    def __init__(self, path: str, worker: Worker) -> None:
        self._path, self._worker = path, worker

    def to_life(self, record: ToLife) -> None:
        connection = self._worker.connection
        body: Any = record
        connection.send(frames.Record(connection.name_out(self._path), body), self._path)


class RecordedGuest:
    """The life's side in an actor process."""

    def __init__(self, guest: Guest) -> None:
        self._guest = guest
        self._decoder = msgspec.msgpack.Decoder(ToLife)
        self._life: Life | None = None
        self._state: list[Restore] = []
        guest.on_record = self._on_record

    def _on_record(self, frame: frames.Record) -> None:
        record = self._decoder.decode(frame.body)
        if self._life is not None:
            self._life.from_home(record)
        elif isinstance(record, Restore):
            self._guest.connection.name_in(frame.to)
            self._state.append(record)

    def start(self, cell: Cell, options: dict[str, Any]) -> None:
        """Begin the recorded life that a launch asks for.

        Raises:
            StartFailed: `__init__` or the restoring raised.
        """
        start = cell.extra().start
        assert start is not None
        life = Life(cell, self, float(options["interval"]), self._guest.page)
        cell.host = GuestLifeHost(self._guest, life)
        for record in self._state:
            life.from_home(record)
        self._state.clear()
        self._life = life
        life.begin(start, int(options["turn"]), list(options["stash"]))

    def to_home(self, record: ToHome) -> None:
        connection = self._guest.connection
        root = self._guest.node.root
        assert root is not None
        body: Any = record
        connection.send(frames.Record(connection.name_out(root.path), body), root.path)

    def closed(self) -> None:
        pass


class GuestLifeHost(lives.LocalHost):
    """The host of a recorded life in its own process."""

    def __init__(self, guest: Guest, life: Life) -> None:
        self._guest, self._life = guest, life

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if cell.state is RUNNING:
            cell.urge(StopRecorded(self._life, reason))

    def retired(self, cell: Cell) -> None:
        if cell.queue:
            cell.queue.clear()
        self._guest.report_end(cell, cell.extra().reason)
