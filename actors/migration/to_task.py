"""Moving a live actor from a process of its own to a task."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from ..control.orders_lane import OrderAsk
from ..errors import AskFailed, error_text
from ..exit_reasons import KILLED, ExitReason
from ..kernel import lifecycle, mailbox
from ..kernel.cell import Cell, Host
from ..kernel.envelope import Ask
from ..kernel.links import Monitor
from ..kernel.stopping import PATIENCE
from ..process.process_host import Outlet, ProcessHost
from .here import Arrival
from .luggage import unpack, unpack_items
from .process_move import Move
from .quiesce import now, obey_commands, sorted_out
from .to_process import let_in, send_queue

if TYPE_CHECKING:
    from ..kernel.actor import Actor
    from ..process.worker_pool import Worker


class FromProcess(Move):
    """From a process of its own to a task; what recorded and other actors have in common."""

    to = "task"

    def __init__(self, cell: Cell, host: Host, timeout: float, worker: Worker) -> None:
        super().__init__(cell, host, timeout)
        self.worker = worker
        self.taken: asyncio.Future[None] = self.node.loop.create_future()
        self.dead: ExitReason | None = None  # the old process has died meanwhile
        self.trap_exits = self.suspended = False

    async def take(self) -> None:
        self.hear(self.worker)
        self.tell_old("take")
        await self.within(
            self.taken, self.timeout, lambda: "it did not come to rest: a turn or background work goes on"
        )

    def tell_old(self, step: str) -> None:
        """Tell the old process, at once."""
        self.say(self.worker, step)
        self.worker.connection.flush()

    def heard(self, step: str, told: dict[str, Any]) -> None:
        match step:
            case "refused":
                self.give_up(str(told["why"]))
            case "taken" if self.worker.is_killed:
                self.give_up("it is killed")
            case "taken" if not self.given_up.done():
                self.rest_at = float(told["at"])
                self.trap_exits, self.suspended = bool(told["trap_exits"]), bool(told["suspended"])
                self.at_rest()
                self.worker.on_death(self.old_died)
                self.left()
            case "packed":
                self.packed(told)
            case _:
                pass

    def left(self) -> None:
        """The old life is at rest, and the root knows it."""
        raise NotImplementedError

    def packed(self, luggage: dict[str, Any]) -> None:
        """What it takes along has come."""

    def old_died(self, cell: Cell, reason: ExitReason) -> None:
        """The old process ends while its actor is being carried over: that matters only if it was to stay."""
        self.dead = reason
        if reason == KILLED:
            self.give_up("it is killed")
        if not self.taken.done():
            self.give_up(f"its process has died ({reason})")

    def leave(self) -> None:
        """What is left in the old process ends; orders that it has not carried out come here."""
        worker, cell = self.worker, self.cell
        calls = [ask.call for ask in worker.pending.values() if isinstance(ask, OrderAsk) and ask.call is not None]
        worker.pending = {
            key: ask for key, ask in worker.pending.items() if not (isinstance(ask, OrderAsk) and ask.call is not None)
        }
        worker.leave(cell, self.reason(), PATIENCE)
        for call in calls:
            if not call.ask.is_done:
                call.ask.started = False
                cell.host.control(cell, call)
        old = self.transit.old if self.transit is not None else None
        if isinstance(old, ProcessHost) and old.stop_sent is not None:  # It came when the actor was at rest already.
            cell.host.stop(cell, old.stop_sent)


class ToTask(FromProcess):
    """From a process of its own to a task."""

    def __init__(self, cell: Cell, host: Host, timeout: float, worker: Worker) -> None:
        super().__init__(cell, host, timeout, worker)
        self._luggage: dict[str, Any] = {}
        self._queued: list[Any] = []
        self._stash: list[Any] = []
        self._asks: dict[int, Ask] = {}
        self._arrival: Arrival | None = None
        self._left_behind: tuple[list[Any], list[Any]] = [], []

    def left(self) -> None:
        outlet: Outlet = self.cell.extra().outlet
        outlet.worker = None  # Messages wait here from now on.
        self.tell_old("pack")  # Behind everything that was sent: all that is there is packed.

    def packed(self, luggage: dict[str, Any]) -> None:
        try:
            cell, outlet = self.cell, self.cell.extra().outlet
            numbers, self._asks = dict(outlet.flight), dict(self.worker.pending)

            def known(entry: list[Any]) -> Any:
                return self._asks.get(entry[1]) if entry[0] == "ask" else numbers.get(entry[1])

            self._luggage = luggage
            self._stash = unpack_items(cell, luggage["stash"], known)
            self._queued = unpack_items(cell, luggage["queue"], known)
        except BaseException as error:  # What a class of the state raises when it is read.
            self.give_up(error_text(error))
            return
        if not self.taken.done():
            self.taken.set_result(None)

    def old_died(self, cell: Cell, reason: ExitReason) -> None:
        outlet: Outlet = cell.extra().outlet
        outlet.worker = self.worker  # Its page is still there.
        self._left_behind = outlet.close()
        if self.taken.done():
            self.worker.take_pending()  # They are among what we carry; if not, they are failed by `undo`.
        super().old_died(cell, reason)

    async def carry(self) -> None:
        start, rest = self.cell.extra().start, self._luggage["rest"]
        assert start is not None

        def restore(actor: Actor) -> None:
            unpack(actor, self._luggage["state"], rest, self._asks.__getitem__, self._watched)

        arrival = self._arrival = Arrival(self.cell)
        await arrival.is_up(self, arrival.begin(start, restore))
        self._commit(arrival)

    def _watched(self, path: str, for_good: bool) -> Monitor:
        watching: dict[Monitor, None] = self.cell.extra().watching
        return next(watch for watch in watching if watch.target.path == path and watch.for_good is for_good)

    def _commit(self, arrival: Arrival) -> None:
        """From here on the new life is the one."""
        cell, more = self.cell, self.cell.extra()
        assert self.transit is not None
        with self.commit():
            held, commands = sorted_out(cell)
            old = more.bound
            bound = None if old is None else mailbox.Bound(old.capacity, old.overflow).inherit(old)
            queue = (*self._queued, *held)
            own_commands = arrival.take_over(queue, self._stash, bound, suspended=self.suspended)
            if bound is not None:
                let_in(cell, bound)
        self.worker.take_pending() if self.dead is not None else self._keep_orders()
        self.transit.over(cell, self.host)
        self.leave()
        obey_commands(cell, [*own_commands, *commands])
        lifecycle.up(cell)
        self.gone_on_at = now()
        self.moved()

    def _keep_orders(self) -> None:
        """What is asked of the actor is answered here from now on; the old process answers nothing."""
        pending = self.worker.pending
        for key, ask in list(pending.items()):
            if not isinstance(ask, OrderAsk):
                del pending[key]

    def undo(self) -> None:
        cell, worker, transit = self.cell, self.worker, self.transit
        if self._arrival is not None:
            self._arrival.discard()
        if transit is None:
            self.tell_old("back")
            return
        host, outlet = transit.old, cell.extra().outlet
        assert isinstance(host, ProcessHost)
        if self.dead is None:
            self.tell_old("back")
            worker.on_death(host.died)
            outlet.worker = worker
            send_queue(cell)
            transit.over(cell, host)
            return
        begun, queued = self._left_behind
        mailbox.queue_of(cell).extendleft(reversed(queued))
        again = {id(item) for item in queued}
        for ask in (*(item for item in begun if isinstance(item, Ask)), *self._asks.values()):
            if id(ask) not in again:
                ask.fail(AskFailed(cell.path, str(self.dead)))
        cell.host = host
        host.died(cell, self.dead)
        transit.over(cell, host)
