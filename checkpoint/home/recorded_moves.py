"""Moves of recorded actors: the home stays where it is, with all inputs; only the life goes elsewhere.

The old life takes a last snapshot and comes to rest; its home feeds it nothing more. The new life restores, and at the
instant at which it is live (nothing new has been fed to it yet) it is the one. If it does not come so far, the home
goes on with the old one, and feeds it what has come since.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from ...actors.errors import CannotMove, StartFailed
from ...actors.exit_reasons import ExitReason
from ...actors.kernel import lifecycle, mailbox
from ...actors.kernel.cell import Cell
from ...actors.kernel.envelope import Item
from ...actors.migration.here import Arrival
from ...actors.migration.quiesce import (
    Settle,
    Transit,
    farewell,
    now,
    obey_commands,
    part,
    settle_with_queue,
    sorted_out,
)
from ...actors.migration.to_process import ToProcess
from ...actors.migration.to_task import FromProcess
from ...actors.process.resource_limits import Limits
from ...actors.process.worker_pool import Worker, Workers
from ..life.recorded_inbox import StopRecorded
from ..life.recorded_life import Life
from ..protocol import LifePort, Live, ToHome
from .recorded_hosts import LocalHome, LocalLife, RecordedProcessHost, RemoteLife, TaskHost, records_of
from .switch import Switch

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor


class Detached:
    """A home whose life is at rest, and how to give it back."""

    def __init__(self, switch: Switch) -> None:
        self._switch, self._next_id = switch, switch.next_id
        self._held = {source.id for source in switch.open.values() if source.held}  # not fed yet
        self._port: LifePort | None = switch.port
        bound = switch.bound
        self._in_hand = None if bound is None else bound.in_hand()
        switch.port, switch.is_released = None, False
        if bound is not None:
            bound.restart()

    def attach_again(self, transit: Transit) -> None:
        """The old life goes on: it gets what has come since."""
        switch = self._switch
        if switch.diverged is not None:
            transit.is_killed = False  # That was for the life that replayed.
        if switch.live is not None and not switch.live.done():
            switch.live.cancel()
        switch.diverged, switch.is_void = None, False
        switch.port, switch.is_released = self._port, True
        if switch.bound is not None and self._in_hand is not None:
            switch.bound.take_up(self._in_hand)
        for source in list(switch.open.values()):
            if source.id >= self._next_id or source.id in self._held:
                switch.forward(source)


def refuse_unsaved(cell: Cell, home: Switch | None) -> None:
    """What is not replayed moves by its last snapshot, or not at all.

    Raises:
        CannotMove: that could not be kept.
    """
    if home is not None and not home.method.replays and home.turns:
        raise CannotMove(cell.path, "its last snapshot could not be kept, and it is not replayed")


def leave_task(cell: Cell, host: TaskHost, reason: ExitReason) -> tuple[Cell, StopRecorded, list[Item]]:
    """A recorded life that is at rest here is its address's no more.

    Returns: where it is now, what is to end it there, and the commands that are for the new life.
    """
    life = host.life
    assert life is not None
    life.port.shut()  # type: ignore[attr-defined]  # in this process it is a LocalHome
    old = part(cell)
    _, commands = sorted_out(cell)
    life.cell = old
    return old, StopRecorded(life, reason), commands


class RecordedToProcess(ToProcess):
    """A recorded actor, from a task to a process of its own."""

    host: RecordedProcessHost

    def __init__(self, cell: Cell, host: RecordedProcessHost, timeout: float, workers: Workers, limits: Limits | None):
        super().__init__(cell, host, timeout, workers, limits)
        old = cell.host
        assert isinstance(old, TaskHost)
        self._old = old
        self._home: Detached | None = None
        self._up: asyncio.Future[None] = self.node.loop.create_future()

    def pack(self, actor: Actor, state: bytes) -> None:
        assert self._old.switch is not None
        self._home = Detached(self._old.switch)

    async def carry(self) -> None:
        cell, worker, more = self.cell, self.worker, self.cell.extra()
        assert worker is not None
        refuse_unsaved(cell, self._old.switch)
        switch, live, _ = self.host.open(cell)
        take = records_of(worker, lambda record: self._from_life(switch, worker, record))
        worker.record_taker = lambda path: take
        port = RemoteLife(cell.path, worker)
        for record in switch.restore_records():
            port.to_life(record)
        recorded = {"method": self.host.method.data(), "turn": switch.state_turn, "stash": switch.stash}
        kept = {"suspended": more.suspended, "trap_exits": more.trap_exits}
        launched = worker.launch(cell, self.recipe, {"recorded": {**recorded, **kept}})
        await self.within(launched, self.timeout, lambda: "its new life was not up")
        switch.attach(port)
        live.add_done_callback(self._failed)
        await self.within(self._up, self.timeout, lambda: "its new life was not up")

    def _failed(self, live: asyncio.Future[float]) -> None:
        error = None if live.cancelled() else live.exception()
        if error is not None and not self._up.done():
            self._up.set_exception(StartFailed(self.cell.path, str(error)))

    def _from_life(self, switch: Switch, worker: Worker, record: ToHome) -> None:
        if isinstance(record, Live):
            if self.given_up.done() or self._up.done():
                return  # Too late: the process is being ended.
            self._switch_over(switch, record, worker)
        else:
            switch.from_life(record)

    def _switch_over(self, switch: Switch, live: Live, worker: Worker) -> None:
        """From here on the new life is the one."""
        cell, host, old_host = self.cell, self.host, self._old
        assert self.transit is not None
        with self.commit():
            old, stop, commands = leave_task(cell, old_host, self.reason())
            worker.adopt(cell, None, host.died)
            host.clock = None
        self._up.set_result(None)
        switch.from_life(live)  # What waits is fed.
        worker.connection.flush()
        self.gone_on_at = now()
        self.transit.over(cell, host)
        obey_commands(cell, commands)
        farewell(old, stop)
        self.moved()

    def stay(self, transit: Transit) -> None:
        assert self._home is not None
        self._home.attach_again(transit)
        super().stay(transit)


class RecordedToTask(FromProcess):
    """A recorded actor, from a process of its own to a task."""

    host: TaskHost

    def __init__(self, cell: Cell, host: TaskHost, timeout: float, worker: Worker) -> None:
        super().__init__(cell, host, timeout, worker)
        self._home: Detached | None = None
        self._arrival: RecordedArrival | None = None

    def left(self) -> None:
        old = self.transit.old if self.transit is not None else None
        assert isinstance(old, RecordedProcessHost)
        assert old.switch is not None
        self._home = Detached(old.switch)
        self.taken.set_result(None)

    async def carry(self) -> None:
        old = self.transit.old if self.transit is not None else None
        refuse_unsaved(self.cell, old.switch if isinstance(old, RecordedProcessHost) else None)
        arrival = self._arrival = RecordedArrival(self.cell, self.host)
        await arrival.is_up(self, arrival.begin_recorded(suspended=self.suspended, trap_exits=self.trap_exits))
        self._commit(arrival)

    def _commit(self, arrival: RecordedArrival) -> None:
        assert self.transit is not None
        with self.commit():
            arrival.take_place()
        self.transit.over(self.cell, self.host)
        arrival.go_on()
        self.gone_on_at = now()
        self.leave()
        self.moved()

    def undo(self) -> None:
        cell, worker, transit, home = self.cell, self.worker, self.transit, self._home
        if self._arrival is not None:
            self._arrival.discard()
        if self.dead is None:
            self.tell_old("back")
        if transit is None or home is None:
            return
        old = transit.old
        assert isinstance(old, RecordedProcessHost)
        home.attach_again(transit)
        if self.dead is None:
            worker.on_death(old.died)
            transit.over(cell, old)
            return
        cell.host = old
        old.over(cell, -1, str(self.dead), ordered=False, noticed=worker.noticed_at, reason=self.dead)
        lifecycle.ended(cell, self.dead)
        transit.over(cell, old)


class RecordedArrival(Arrival):
    """A recorded life that begins as a task beside its address, from its last snapshot and what is behind it."""

    def __init__(self, cell: Cell, host: TaskHost) -> None:
        super().__init__(cell)
        self._host = host
        self.other.life -= 1  # Counted up by the life that begins; it is no other one.
        self._life: Life | None = None
        self._home: ArrivingHome | None = None

    def begin_recorded(self, *, suspended: bool, trap_exits: bool = False) -> asyncio.Future[None]:
        """Restore and replay; the future ends when the life is live."""
        cell, host, start = self.cell, self._host, self.cell.extra().start
        assert start is not None
        self.other.extra().trap_exits = trap_exits
        switch, live, _ = host.open(cell)
        up: asyncio.Future[None] = cell.node.loop.create_future()
        home = self._home = ArrivingHome(host, cell, self.other, up)
        host.page = host.homes.page(switch)
        life = self._life = Life(self.other, home, host.method, host.page)
        life.begins_suspended = suspended
        for record in switch.restore_records():
            life.from_home(record)
        self.other.ended().add_done_callback(lambda done: home.fail(StartFailed(cell.path, str(done.result()))))
        life.begin(start, switch.state_turn, switch.stash)
        switch.attach(LocalLife(life))
        live.add_done_callback(lambda done: None if done.cancelled() else home.fail(done.exception()))
        return up

    def take_place(self) -> None:
        """From here on the new life is the one."""
        life, host = self._life, self._host
        assert life is not None
        settle_with_queue(self.other, self.cell)
        life.cell = self.cell
        host.life, host.clock = life, None

    def go_on(self) -> None:
        """Now it is live: its home feeds it what waits."""
        assert self._home is not None
        lifecycle.up(self.cell)
        self._home.open()


class ArrivingHome(LocalHome):
    """The way home of a life that is not the one yet: its home hears that it is live when it is."""

    def __init__(self, host: TaskHost, cell: Cell, other: Cell, settled: asyncio.Future[None]) -> None:
        super().__init__(host, cell)
        self._other, self._settled = other, settled
        self._held: list[ToHome] | None = None
        self._is_arriving = True

    def to_home(self, record: ToHome) -> None:
        if self._held is not None:
            self._held.append(record)
            return
        if isinstance(record, Live) and self._is_arriving:
            self._held = [record]
            mailbox.queue_of(self._other).appendleft(Settle(self._settled))
            return
        super().to_home(record)

    def open(self) -> None:
        """It is the one."""
        held, self._held, self._is_arriving = self._held or [], None, False
        for record in held:
            super().to_home(record)

    def fail(self, error: BaseException | None) -> None:
        """It will never be."""
        if error is not None and not self._settled.done():
            self._settled.set_exception(
                error if isinstance(error, StartFailed) else StartFailed(self._cell.path, str(error))
            )
            self._settled.exception()

    def closed(self) -> None:
        if self._is_arriving:
            self.shut()
        else:
            super().closed()
