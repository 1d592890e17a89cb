"""Moving a live actor from a task to a process of its own."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any

from ..control.orders_lane import Call
from ..errors import BadMessage, CannotMove
from ..kernel import mailbox
from ..kernel.cell import Cell
from ..kernel.lifecycle import Stop
from ..kernel.links import Monitor
from ..process.process_host import Outlet, ProcessHost, RemoteBound, admit_remote, admit_remote_bounded, undelivered
from ..process.wire.start_codec import pack_recipe
from .here import Departure
from .luggage import check_sendable, pack_rest
from .process_move import Move
from .quiesce import Transit, farewell, now, obey_commands, part, resume, sorted_out

if TYPE_CHECKING:
    from ..kernel.actor import Actor
    from ..process.worker_pool import Worker, Workers

READY_WITHIN = 60.0
"""Seconds that a process may take to import what the actor needs."""
LATE = 1.0
"""Seconds to wait for a moved actor's process to say when it went on."""


class ToProcess(Move):
    """From a task to a process of its own."""

    to = "process"

    def __init__(self, cell: Cell, host: ProcessHost, timeout: float, workers: Workers, limits: Any) -> None:
        super().__init__(cell, host, timeout)
        self.workers, self.limits = workers, limits
        self.worker: Worker | None = None
        self.recipe = b""
        self._departure = Departure(self, lambda ask: self._expecting().expect(ask), self._pack)
        self._luggage: dict[str, Any] = {}
        self._began: asyncio.Future[float] = self.node.loop.create_future()
        self._topics: set[str] = set()
        self._links: set[Cell] = set()
        self._watches: set[Monitor] = set()

    async def prepare(self) -> None:
        start = self.cell.extra().start
        assert start is not None
        self.workers.want(start.kind.__module__)
        self.recipe = pack_recipe(start, self.cell.path)
        worker = self.worker = await self.workers.take()
        worker.reserve(
            self.cell, self.limits, lambda cell, reason: self.give_up(f"the new process has died ({reason})")
        )
        self.hear(worker)
        await self.within(worker.prepare(self.cell, self.recipe), READY_WITHIN, lambda: "the new process was not ready")

    def heard(self, step: str, told: dict[str, Any]) -> None:
        if step == "began" and not self._began.done():
            self._began.set_result(float(told["at"]))

    async def take(self) -> None:
        await self._departure.quiesce()

    def _expecting(self) -> Worker:
        assert self.worker is not None
        return self.worker

    def _pack(self, actor: Actor, state: bytes) -> None:
        self.remember()
        self.pack(actor, state)

    def pack(self, actor: Actor, state: bytes) -> None:
        """Pack what the actor takes along."""
        check_sendable(self.cell)
        self._luggage = {"state": state, "rest": pack_rest(actor)}

    async def carry(self) -> None:
        cell, worker, more = self.cell, self.worker, self.cell.extra()
        assert worker is not None
        self.say(worker, "luggage", **self._luggage)
        launched = worker.launch(cell, self.recipe, {"bounded": more.bound is not None, "moved": True})
        await self.within(launched, self.timeout, lambda: "its new life was not up")
        if not worker.is_alive():
            raise CannotMove(cell.path, "the new process has died")
        self._commit(worker)
        await self.went_on()

    def remember(self) -> None:
        """What belongs to the address: a new life that fails may have added to it."""
        more = self.cell.extra()
        self._topics, self._links, self._watches = set(more.topics), set(more.links), set(more.watching)

    async def went_on(self) -> None:
        """Wait for the process to say when the actor went on."""
        self.gone_on_at = now()
        done, _ = await asyncio.wait((self._began,), timeout=LATE)
        if done:
            self.gone_on_at = self._began.result()

    def _commit(self, worker: Worker) -> None:
        """From here on the new life is the one."""
        cell, host, more = self.cell, self.host, self.cell.extra()
        assert isinstance(host, ProcessHost)
        assert self.transit is not None
        with self.commit():
            suspended, stash = more.suspended, list(more.stash or ())
            old = part(cell)
            items, commands = sorted_out(cell)
            outlet = more.outlet = Outlet(cell.path)
            cell.admit = admit_remote
            if more.bound is not None:
                more.bound = RemoteBound(more.bound).inherit(more.bound)
                cell.admit = admit_remote_bounded
            worker.adopt(cell, None, host.died)
            self._unpack_there(worker, stash, suspended=suspended)
            outlet.worker = worker
            calls = [item for item in items if isinstance(item, Call)]
            cell.queue = deque(item for item in items if not isinstance(item, Call))
            send_queue(cell)
            worker.connection.flush()
        self.transit.over(cell, host)
        obey_commands(cell, [*commands, *calls])
        farewell(old, Stop(self.reason()))
        self.moved()

    def _unpack_there(self, worker: Worker, stash: list[Any], *, suspended: bool) -> None:
        """Have the life in the process take up its stash, and go on."""
        cell = self.cell
        if stash:
            self.say(worker, "stash")
            for item in stash:
                worker.send_item(cell, cell.path, item, 0)
        self.say(worker, "go", suspended=suspended)

    def undo(self) -> None:
        cell, worker = self.cell, self.worker
        self._departure.call_off()
        if worker is not None:
            worker.give_back()
        transit = self.transit
        if transit is None:
            return
        more = cell.extra()
        for topic in set(more.topics) - self._topics:
            cell.node.topics.unsubscribe(topic, cell)
        for peer in set(more.links) - self._links:
            peer.extra().links.pop(cell, None)
            del more.links[peer]
        for watch in set(more.watching) - self._watches:
            watch.cancel()
        self.stay(transit)

    def stay(self, transit: Transit) -> None:
        """The old life goes on."""
        transit.over(self.cell, transit.old)
        resume(self.cell)


def send_queue(cell: Cell) -> None:
    """Send what is queued to the process of the actor."""
    more, queue = cell.extra(), cell.queue
    outlet: Outlet = more.outlet
    if isinstance(more.bound, RemoteBound):
        more.bound.recount(cell)
        more.bound.send(cell)
        let_in(cell, more.bound)
        return
    while queue:
        item = queue.popleft()
        try:
            outlet.hand_over(cell, item)
        except BadMessage as error:
            undelivered(cell, item, error)


def let_in(cell: Cell, bound: mailbox.Bound) -> None:
    """Some of those who waited for room may have it now."""
    bound.count += 1
    bound.taken(cell)
