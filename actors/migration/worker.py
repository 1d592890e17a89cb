"""The side of a migration that is a process of the actor's own, as the root sees it."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any

from ..control.orders_lane import OrderAsk, take_orders
from ..errors import AskFailed, CannotMove, error_text
from ..exit_reasons import KILLED, ExitReason
from ..kernel import mailbox
from ..kernel.cell import Cell
from ..kernel.envelope import Ask, Item
from ..kernel.lifecycle import PATIENCE
from ..kernel.links import LifeMonitor
from ..process.process_host import Outlet, RemoteBound, WorkerPlace, admit_remote, admit_remote_bounded
from ..process.wire.start_codec import pack_recipe
from .here import let_in
from .luggage import let_come, unpack, unpack_items
from .move import Entering, Leaving
from .quiesce import carry, now, sorted_out
from .words import moment

if TYPE_CHECKING:
    from ..kernel.actor import Actor
    from ..kernel.address_host import AddressHost
    from ..process.resource_limits import Limits
    from ..process.worker_pool import Worker

READY_WITHIN = 60.0
"""Seconds that a process may take to import what the actor needs."""
LATE = 1.0
"""Seconds to wait for a moved actor's process to say when it went on."""
BUSY = "it did not come to rest: a turn or background work goes on"


class ToWorker(Entering):
    """The life of an actor without a home begins in a process of its own."""

    to = "to a process"

    def __init__(self, host: AddressHost, limits: Limits | None) -> None:
        assert isinstance(host.place, WorkerPlace)
        self.host, self.place, self._limits = host, host.place, limits
        self.worker: Worker | None = None
        self.recipe = b""

    async def prepare(self) -> None:
        cell, move = self.cell, self.move
        self._began: asyncio.Future[float] = move.node.loop.create_future()
        recipe = self.place.parent.recipe(cell)
        if isinstance(recipe, bytes):
            self.recipe = recipe
        else:
            self.place.workers.want(recipe.kind.__module__)
            self.recipe = pack_recipe(recipe, cell.path)
        worker = self.worker = await self.place.fork()
        worker.reserve(cell, self._limits, lambda cell, reason: move.give_up(f"the new process has died ({reason})"))
        move.hear(worker, self._heard)
        await move.within(worker.prepare(cell, self.recipe), READY_WITHIN, lambda: "the new process was not ready")

    def _heard(self, step: str, told: dict[str, Any]) -> None:
        if step == "began" and not self._began.done():
            self._began.set_result(moment(told))

    def owe(self, ask: Ask) -> int:
        assert self.worker is not None
        return self.worker.expect(ask)

    async def begin(self) -> None:
        cell, move, luggage, worker = self.cell, self.move, self.move.luggage, self.worker
        assert worker is not None
        numbers = [[number, worker.expect(ask)] for number, ask in luggage.owed.items()]
        move.say(worker, "luggage", state=luggage.state, rest=luggage.rest, owed=numbers)
        bound = luggage.bound or cell.extra().bound
        await self.launch(worker, {"bounded": bound is not None, "moved": True})
        if not worker.is_alive():
            raise CannotMove(cell.path, "the new process has died")

    async def launch(self, worker: Worker, options: dict[str, Any]) -> None:
        """Have the life begin."""
        move = self.move
        launched = worker.launch(self.cell, self.recipe, options)
        await move.within(launched, move.timeout, lambda: "its new life was not up")

    def take_over(self) -> list[Item]:
        cell, luggage, worker, more = self.cell, self.move.luggage, self.worker, self.cell.extra()
        assert worker is not None
        outlet = more.outlet = Outlet(cell.path)
        cell.admit = admit_remote
        if luggage.bound is not None:
            more.bound = RemoteBound(luggage.bound).inherit(luggage.bound)
            cell.admit = admit_remote_bounded
        worker.adopt(cell, None, self.place.died)
        if luggage.stash:
            self.move.say(worker, "stash")
            for item in luggage.stash:
                worker.send_item(cell, cell.path, item, 0)
        self.move.say(worker, "go", suspended=luggage.suspended)
        outlet.worker = worker
        carry(luggage.queue)
        cell.queue = deque(luggage.queue)
        send_queue(cell)
        let_come(cell, luggage.waiting)
        worker.connection.flush()
        return []

    async def went_on(self) -> None:
        self.move.gone_on_at = now()
        done, _ = await asyncio.wait((self._began,), timeout=LATE)
        if done:
            self.move.gone_on_at = self._began.result()

    def discard(self) -> None:
        if self.worker is not None:
            self.worker.give_back()


class FromOwnWorker(Leaving):
    """A life in a process of its own comes to rest; what those with and without a home have in common."""

    def __init__(self, worker: Worker) -> None:
        self.worker = worker
        self.dead: ExitReason | None = None  # the process has died meanwhile

    @property
    def place(self) -> WorkerPlace:
        """Where the life lives until it has moved."""
        place = self.cell.host.place
        assert isinstance(place, WorkerPlace)
        return place

    async def quiesce(self) -> None:
        move = self.move
        self.taken: asyncio.Future[None] = move.node.loop.create_future()
        move.hear(self.worker, self.heard)
        self.worker.on_death(self._died_before_rest)
        move.say_now(self.worker, "take", stays=move.stays)
        try:
            await move.within(self.taken, move.timeout, lambda: BUSY)
        except BaseException:
            if move.transit is None:  # It never was at rest, and is the place's as before.
                self.worker.on_death(self.place.died)
            raise

    def _died_before_rest(self, cell: Cell, reason: ExitReason) -> None:
        """The process ends while the life still is the place's, which deals with that; nobody else tells the move."""
        self.move.is_late = True
        self.move.give_up("its life has ended" if reason.is_clean else f"its process has died ({reason})")
        self.place.died(cell, reason)

    def heard(self, step: str, told: dict[str, Any]) -> None:
        """A word of the process."""
        move = self.move
        match step:
            case "refused":
                move.give_up(str(told["why"]))
            case "taken" if self.worker.is_killed:
                move.give_up("it is killed")
            case "taken" if not move.given_up.done():
                move.rest_at = moment(told)
                move.luggage.traps, move.luggage.suspended = bool(told["trap_exits"]), bool(told["suspended"])
                move.luggage.was_left = not told.get("owes_turn")
                move.at_rest()
                self.worker.on_death(self.died)
                self.left()
            case "packed":
                self.packed(told)
            case _:
                pass

    def left(self) -> None:
        """The life is at rest, and the root knows it."""
        raise NotImplementedError

    def packed(self, told: dict[str, Any]) -> None:
        """What it takes along has come."""

    def died(self, cell: Cell, reason: ExitReason) -> None:
        """The process ends while its actor is being carried over: that matters only if it was to stay."""
        self.dead = reason
        if reason == KILLED:
            self.move.give_up("it is killed")
        if not self.taken.done():
            self.move.give_up("its life has ended" if reason.is_clean else f"its process has died ({reason})")

    def retire(self) -> None:
        """What is left in the process ends; orders that it has not carried out come here."""
        worker, cell, transit = self.worker, self.cell, self.move.transit
        calls = take_orders(worker)
        worker.leave(cell, self.move.reason(), PATIENCE)
        for call in calls:
            cell.host.control(cell, call)
        old = transit.old.place if transit is not None else None
        if isinstance(old, WorkerPlace) and old.stop_sent is not None:  # It came when the actor was at rest already.
            cell.host.stop(cell, old.stop_sent)


class FromWorker(FromOwnWorker):
    """The life of an actor without a home leaves the process of its own."""

    def __init__(self, worker: Worker) -> None:
        super().__init__(worker)
        self._queued: list[Any] = []
        self._asks: dict[int, Ask] = {}
        self._left_behind: tuple[list[Any], list[Any]] = [], []

    def left(self) -> None:
        outlet: Outlet = self.cell.extra().outlet
        outlet.worker = None  # Messages wait here from now on.
        self.move.say_now(self.worker, "pack")  # Behind everything that was sent: all that is there is packed.

    def packed(self, told: dict[str, Any]) -> None:
        cell, luggage, outlet = self.cell, self.move.luggage, self.cell.extra().outlet
        try:
            numbers, self._asks = dict(outlet.flight), dict(self.worker.pending)

            def known(entry: list[Any]) -> Any:
                return self._asks.get(entry[1]) if entry[0] == "ask" else numbers.get(entry[1])

            luggage.state, luggage.rest, luggage.restore = told["state"], told["rest"], self._restore
            luggage.stash = unpack_items(cell, told["stash"], known)
            self._queued = unpack_items(cell, told["queue"], known)
            waiting = {id(item) for item in (*luggage.stash, *self._queued)}
            luggage.owed = {
                number: ask
                for number, ask in self._asks.items()
                if id(ask) not in waiting and not isinstance(ask, OrderAsk)
            }
        except BaseException as error:  # What a class of the state raises when it is read.
            self.move.give_up(error_text(error))
            return
        if not self.taken.done():
            self.taken.set_result(None)

    def _restore(self, actor: Actor) -> None:
        luggage = self.move.luggage
        unpack(actor, luggage.state, luggage.rest, self._asks.__getitem__, self._watched)

    def _watched(self, path: str, for_good: bool) -> LifeMonitor:
        watching: dict[LifeMonitor, None] = self.cell.extra().ties.watching
        return next(watch for watch in watching if watch.name == path and watch.for_good is for_good)

    def died(self, cell: Cell, reason: ExitReason) -> None:
        outlet: Outlet = cell.extra().outlet
        outlet.worker = self.worker  # Its page is still there.
        self._left_behind = outlet.close()
        if self.taken.done():
            self.worker.take_pending()  # They are among what we carry; if not, they are failed by `resume`.
        super().died(cell, reason)

    def part(self) -> list[Item]:
        luggage = self.move.luggage
        held, commands = sorted_out(self.cell)
        luggage.queue, luggage.bound = [*self._queued, *held], self.cell.extra().bound
        return commands

    def retire(self) -> None:
        self.worker.take_pending() if self.dead is not None else self._keep_orders()
        super().retire()

    def _keep_orders(self) -> None:
        """What is asked of the actor is answered here from now on; the old process answers nothing."""
        pending = self.worker.pending
        for key, ask in list(pending.items()):
            if not isinstance(ask, OrderAsk):
                del pending[key]

    def resume(self) -> None:
        cell, worker, transit = self.cell, self.worker, self.move.transit
        if transit is None:
            self.move.say_now(worker, "back")
            return
        host, outlet = transit.old, cell.extra().outlet
        place = self.place
        if self.dead is None:
            self.move.say_now(worker, "back")
            worker.on_death(place.died)
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
        place.died(cell, self.dead)
        transit.over(cell, host)


def send_queue(cell: Cell) -> None:
    """Send what is queued to the process of the actor."""
    more = cell.extra()
    outlet: Outlet = more.outlet
    if isinstance(more.bound, RemoteBound):
        more.bound.recount(cell)
        more.bound.send(cell)
        let_in(cell, more.bound)
    else:
        outlet.hand_over_queue(cell)
