"""Moves of recorded actors: the home stays where it is, with all inputs; only the life goes elsewhere.

The old life takes a last snapshot and comes to rest; its home feeds it nothing more. The new life restores, and at the
instant at which it is live (nothing new has been fed to it yet) it is the one. If it does not come so far, the home
goes on with the old one, and feeds it what has come since.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from ...actors.control.orders_lane import take_orders
from ...actors.errors import CannotMove, StartFailed
from ...actors.kernel import lifecycle, mailbox
from ...actors.kernel.cell import Cell
from ...actors.migration.here import Arrival, FromHere
from ...actors.migration.move import Entering, Leaving, Move
from ...actors.migration.quiesce import Settle, Transit, now, part, settle_with_queue, sorted_out
from ...actors.migration.worker import FromOwnWorker, FromWorker, ToWorker
from ...actors.process.process_host import WorkerPlace
from ..home.journal_home import JournalHome
from ..home.life_ports import RemoteLife, records_of
from ..home.present_life import LifePort
from ..home.switch import Switch
from ..life.recorded_inbox import StopRecorded
from ..life.recorded_life import Life
from ..protocol import Live, ToHome
from .life_here import LifeHere, LocalHome

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...actors.kernel.address_host import AddressHost
    from ...actors.kernel.envelope import Item
    from ...actors.process.resource_limits import Limits
    from ...actors.process.worker_pool import Worker


def leaving(cell: Cell, ignored: tuple[str, ...] = ()) -> Leaving:
    """The side of a move that is where the actor lives now, in this process or in one of its own.

    Args:
        cell: its address.
        ignored: children that are not the actor's own.

    Raises:
        CannotMove: its process has ended.
    """
    home, place = cell.host.home, cell.host.place
    if not isinstance(place, WorkerPlace):
        return FromRecordedHere(home, ignored) if isinstance(home, JournalHome) else FromHere(ignored)
    worker = place.process(cell)
    if worker is None:
        raise CannotMove(cell.path, "its process has ended")
    return FromRecordedWorker(worker, home) if isinstance(home, JournalHome) else FromWorker(worker)


class Detached:
    """A home whose life is at rest, and how to give it back."""

    def __init__(self, switch: Switch, *, stays: bool = False) -> None:
        self._switch, self._next_id = switch, switch.ledger.next_id
        self._held = {source.id for source in switch.open.values() if source.held}  # not fed yet
        self._port: LifePort | None = switch.life.port
        bound = switch.intake.bound
        self._in_hand = None if bound is None else bound.in_hand()
        if stays:
            switch.life.is_released = False
        else:
            switch.life.die()
            switch.calls.rests.abandon()  # The next life's turn waits again.
        if bound is not None:
            bound.restart()

    def attach_again(self, transit: Transit) -> None:
        """The old life goes on: it gets what has come since."""
        switch, bound = self._switch, self._switch.intake.bound
        if switch.life.diverged is not None:
            transit.is_killed = False  # That was for the life that replayed.
        switch.life.resume(self._port)
        if bound is not None and self._in_hand is not None:
            bound.take_up(self._in_hand)
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


class FromRecordedHere(FromHere):
    """A recorded life in this process comes to rest."""

    def __init__(self, home: JournalHome, ignored: tuple[str, ...] = ()) -> None:
        super().__init__(ignored)
        self._home = home
        self._detached: Detached | None = None
        self._life: Life | None = None

    async def quiesce(self) -> None:
        await super().quiesce()
        refuse_unsaved(self.cell, self._home.switch)

    def pack(self, actor: Actor, state: bytes) -> None:
        assert self._home.switch is not None
        self._detached = Detached(self._home.switch, stays=self.move.stays)

    def part(self) -> list[Item]:
        place = self.cell.host.place
        assert isinstance(place, LifeHere)
        life = self._life = place.life
        assert life is not None
        life.port.shut()  # type: ignore[attr-defined]  # in this process it is a LocalHome
        old = self._old = part(self.cell)
        _, commands = sorted_out(self.cell)
        life.cell = old
        return commands

    def stop(self) -> Item:
        assert self._life is not None
        return StopRecorded(self._life, self.move.reason())

    def take_back(self, transit: Transit) -> None:
        assert self._detached is not None
        self._detached.attach_again(transit)


class FromRecordedWorker(FromOwnWorker):
    """A recorded life leaves the process of its own."""

    def __init__(self, worker: Worker, home: JournalHome) -> None:
        super().__init__(worker)
        self._home = home
        self._detached: Detached | None = None

    async def quiesce(self) -> None:
        await super().quiesce()
        refuse_unsaved(self.cell, self._home.switch)

    def left(self) -> None:
        assert self._home.switch is not None
        self._detached = Detached(self._home.switch, stays=self.move.stays)
        self.taken.set_result(None)

    def part(self) -> list[Item]:
        assert self.move.transit is not None
        # Before the new life is fed, so that it obeys them between two turns.
        self.move.transit.control_first(self.cell, take_orders(self.worker))
        return []

    def resume(self) -> None:
        cell, worker, transit, detached, dead = self.cell, self.worker, self.move.transit, self._detached, self.dead
        if dead is None:
            self.move.say_now(worker, "back")
        if transit is None or detached is None:
            return
        old = transit.old
        detached.attach_again(transit)
        if dead is None:
            worker.on_death(self.place.died)
            transit.over(cell, old)
            return
        cell.host = old

        def over(recovers: bool | None) -> None:
            self._home.over(
                cell, -1, str(dead), ordered=False, noticed=worker.end.noticed_at, reason=dead, recovers=recovers
            )  # fmt: skip

        old.parent.life_over(cell, dead, over)
        transit.over(cell, old)


class Beginning:
    """A recorded life that begins in a process. From when it is live to the commit, its home hears nothing of it."""

    def __init__(self, move: Move, switch: Switch) -> None:
        self._move, self._switch = move, switch
        self._is_live: asyncio.Future[None] = move.node.loop.create_future()
        self._unheard: list[ToHome] = []  # that it is live, and what it has said since
        self._is_one = False

    def from_life(self, record: ToHome) -> None:
        """Hold back what it says from when it is live, until it is the life at the address."""
        if self._is_one or not (self._unheard or isinstance(record, Live)):
            self._switch.from_life(record)
            return
        self._unheard.append(record)
        if not self._is_live.done():
            self._is_live.set_result(None)

    def follow(self, live: asyncio.Future[float]) -> None:
        """It fails as the home's own future does."""
        live.add_done_callback(lambda done: None if done.cancelled() else self.fail(done.exception()))

    def fail(self, error: BaseException | None) -> None:
        """It will never be the one."""
        if error is None or self._is_one:
            return
        if self._is_live.done():
            self._move.give_up(f"its new life has ended ({error})")
            return
        is_known = isinstance(error, (StartFailed, CannotMove))
        self._is_live.set_exception(error if is_known else StartFailed(self._move.cell.path, str(error)))
        self._is_live.exception()  # Seen: whoever waits may have given up.

    async def is_live(self) -> None:
        """Wait until it has caught up.

        Raises:
            CannotMove, StartFailed: it will never be.
        """
        await self._move.within(self._is_live, self._move.timeout, lambda: "its new life was not up")

    def go_on(self) -> None:
        """What waits at home is fed to it."""
        self._is_one = True
        for record in self._unheard:
            self._switch.from_life(record)
        self._move.gone_on_at = now()


class ToRecordedWorker(ToWorker):
    """A recorded life begins in a process of its own."""

    def __init__(self, host: AddressHost, limits: Limits | None) -> None:
        super().__init__(host, limits)
        assert isinstance(host.home, JournalHome)
        self._home = host.home

    async def begin(self) -> None:
        cell, luggage, worker, home = self.cell, self.move.luggage, self.worker, self._home
        assert worker is not None
        switch, live, _ = home.open(cell)
        beginning = self._beginning = Beginning(self.move, switch)
        take = records_of(worker, beginning.from_life)
        worker.record_taker = lambda path: take
        port = RemoteLife(cell.path, worker)
        for record in switch.restore_records():
            port.to_life(record)
        kept = {"suspended": luggage.suspended, "trap_exits": luggage.traps, "was_left": luggage.was_left}
        await self.launch(worker, {"recorded": {**home.launch_data(), **kept}})
        switch.attach(port)
        beginning.follow(live)
        await beginning.is_live()

    def take_over(self) -> list[Item]:
        assert self.worker is not None
        self.worker.adopt(self.cell, None, self.place.died)
        return []

    def go_on(self) -> None:
        assert self.worker is not None
        self._beginning.go_on()
        self._home.clock = None
        self.place.settled(self.cell)
        self.worker.connection.flush()

    async def went_on(self) -> None:
        """Do nothing: nobody has to hear of it."""


class ToRecordedHere(Entering):
    """A recorded life begins in this process."""

    to = "to a task"

    def __init__(self, host: AddressHost) -> None:
        assert isinstance(host.place, LifeHere)
        self.host, self._place = host, host.place
        self._arrival: RecordedArrival | None = None

    async def begin(self) -> None:
        luggage = self.move.luggage
        arrival = self._arrival = RecordedArrival(self.cell, self._place)
        began = arrival.begin_recorded(
            suspended=luggage.suspended, trap_exits=luggage.traps, was_left=luggage.was_left
        )  # fmt: skip
        await arrival.is_up(self.move, began)

    def take_over(self) -> list[Item]:
        assert self._arrival is not None
        self._arrival.take_place()
        return []

    def go_on(self) -> None:
        assert self._arrival is not None
        self._arrival.go_on()
        self.move.gone_on_at = now()

    def discard(self) -> None:
        if self._arrival is not None:
            self._arrival.discard()


class RecordedArrival(Arrival):
    """A recorded life that begins as a task beside its address, from its last snapshot and what is behind it."""

    def __init__(self, cell: Cell, place: LifeHere) -> None:
        super().__init__(cell)
        self._place = place
        self.other.life -= 1  # Counted up by the life that begins; it is no other one.
        self._life: Life | None = None
        self._home: ArrivingHome | None = None

    def begin_recorded(
        self, *, suspended: bool, trap_exits: bool = False, was_left: bool = True
    ) -> asyncio.Future[None]:
        """Restore and replay; the future ends when the life is live."""
        cell, owner, start = self.cell, self._place.home, self.cell.extra().start
        assert start is not None
        self.other.extra().trap_exits = trap_exits
        switch, live, _ = owner.open(cell)
        up: asyncio.Future[None] = cell.node.loop.create_future()
        home = self._home = ArrivingHome(owner, cell, self.other, up)
        owner.page = owner.homes.page(switch)
        life = self._life = Life(self.other, home, owner.method, owner.page)
        life.stage.begins_suspended, life.stage.was_left = suspended, was_left
        for record in switch.restore_records():
            life.to_life(record)
        self.other.ended().add_done_callback(lambda done: home.fail(StartFailed(cell.path, str(done.result()))))
        life.begin(start, switch.ledger.state_turn, switch.ledger.stash)
        switch.attach(life)
        live.add_done_callback(lambda done: None if done.cancelled() else home.fail(done.exception()))
        return up

    def take_place(self) -> None:
        """From here on the new life is the one."""
        life, place = self._life, self._place
        assert life is not None
        settle_with_queue(self.other, self.cell)
        life.cell = self.cell
        place.life, place.home.clock = life, None

    def go_on(self) -> None:
        """Now it is live: its home feeds it what waits."""
        assert self._home is not None
        lifecycle.up(self.cell)
        self._home.open()


class ArrivingHome(LocalHome):
    """The way home of a life that is not the one yet: its home hears that it is live when it is."""

    def __init__(self, home: JournalHome, cell: Cell, other: Cell, settled: asyncio.Future[None]) -> None:
        super().__init__(home, cell)
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
        """Let the home hear what was held back: it is the life at the address."""
        held, self._held, self._is_arriving = self._held or [], None, False
        for record in held:
            super().to_home(record)

    def fail(self, error: BaseException | None) -> None:
        """Give up the arrival: it will never be the life at the address."""
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
