"""The side of a migration that is this process: a life comes to rest here, or begins beside its address."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from ..control.orders_lane import QueuedOrder
from ..errors import CannotMove, StartFailed, error_text
from ..exit_reasons import ExitReason, start_failed
from ..kernel import lifecycle, mailbox
from ..kernel.cell import RUNNING, Cell, Host
from ..kernel.context import ActorContext
from ..kernel.envelope import Item
from ..kernel.lifecycle import Stop
from ..kernel.mailbox import Bound
from ..kernel.timers import LoopTimer
from .luggage import check_sendable, let_come, pack_rest
from .move import Entering, Leaving, Move
from .quiesce import PackLife, Transit, decoded, farewell, now, part, resume, settle, sorted_out, twin
from .worker_moves import await_up

if TYPE_CHECKING:
    from ..kernel.actor import Actor, Start
    from ..kernel.links import LifeMonitor


class FromHere(Leaving):
    """A life in this process, which has no home: it comes to rest between two turns, and is packed there."""

    def __init__(self, ignored: tuple[str, ...] = ()) -> None:
        self._ignored = ignored  # children that are not the actor's own
        self._take: PackLife | None = None
        self._old: Cell | None = None
        self._topics: set[str] = set()
        self._links: set[Cell] = set()
        self._watches: set[LifeMonitor] = set()

    async def quiesce(self) -> None:
        move, entering = self.move, self.move.entering
        self._start = move.cell.extra().start
        self._rested: asyncio.Future[None] = move.node.loop.create_future()
        take = self._take = PackLife(entering.owe, self._at_rest, move.give_up, self._ignored, stays=move.stays)
        lifecycle.urge(move.cell, take)
        take.hurry(move.cell)
        await move.within(self._rested, move.timeout, lambda: f"{take.why}, and that did not change")

    def _at_rest(self, actor: Actor, state: bytes) -> None:
        """Called in its place between two turns; if this raises, the actor goes on."""
        move, more = self.move, self.cell.extra()
        if move.given_up.done():
            raise CannotMove(move.cell.path, move.given_up.result())
        if more.start is not self._start:
            raise CannotMove(move.cell.path, "its code was replaced meanwhile; try again")
        move.rest_at = now()
        luggage = move.luggage
        luggage.suspended, luggage.traps, luggage.stash = (
            bool(more.suspended & mailbox.BY_USER),
            more.trap_exits,
            list(more.stash or ()),
        )
        luggage.was_left = not actor.ctx._owes_turn
        # What belongs to the address: a new life that fails may have added to it.
        self._topics = set(more.belongings.topics)
        self._links, self._watches = set(more.ties.links), set(more.ties.watching)
        self.pack(actor, state)
        move.at_rest()
        self._rested.set_result(None)

    def pack(self, actor: Actor, state: bytes) -> None:
        """Take along what the life has."""
        check_sendable(self.cell)
        self.move.luggage.state, self.move.luggage.rest = state, pack_rest(actor)
        self.move.entering.packed(actor)

    def part(self) -> list[Item]:
        cell, luggage = self.cell, self.move.luggage
        luggage.bound = cell.extra().bound
        self._old = part(cell)
        items, commands = sorted_out(cell)
        luggage.queue = [item for item in items if not isinstance(item, QueuedOrder)]
        return [*commands, *(item for item in items if isinstance(item, QueuedOrder))]

    def retire(self) -> None:
        assert self._old is not None
        farewell(self._old, self.stop())

    def stop(self) -> Item:
        """What ends the old life."""
        return Stop(self.move.reason())

    def resume(self) -> None:
        if self._take is not None:
            self._take.withdraw(self.cell)
        cell, transit = self.cell, self.move.transit
        if transit is None:
            return
        more = cell.extra()
        for topic in [topic for topic in more.belongings.topics if topic not in self._topics]:
            cell.node.topics.unsubscribe(topic, cell)
        for peer in [peer for peer in more.ties.links if peer not in self._links]:
            peer.extra().ties.links.pop(cell, None)
            del more.ties.links[peer]
        for watch in [watch for watch in more.ties.watching if watch not in self._watches]:
            watch.cancel()
        self.take_back(transit)
        transit.over(cell, transit.old)
        resume(cell)

    def take_back(self, transit: Transit) -> None:
        """What had been given away."""


class Arrival:
    """A life that begins in this process beside its address, and handles nothing until it is the one."""

    def __init__(self, cell: Cell) -> None:
        self.cell, self.other = cell, twin(cell)
        self.other.extra().bindings = cell.extra().bindings

    def begin(
        self, start: Start[Any], restore: Callable[[Actor], None], *, trap_exits: bool = False
    ) -> asyncio.Future[None]:
        """Build the actor and give it its state; the future ends when it is up.

        Raises:
            StartFailed: it could not be built, or its state could not be restored.
        """
        other = self.other
        other.table = start.kind._table
        lifecycle.build(other, start, ActorContext)
        other.extra().trap_exits = trap_exits
        assert other.actor is not None
        try:
            restore(other.actor)
        except BaseException as error:
            raise StartFailed(self.cell.path, f"its state could not be restored: {error_text(error)}") from error
        gone, up = other.ended(), await_up(other, start)
        gone.add_done_callback(lambda done: self._ended_early(up, done.result()))
        return up

    def _ended_early(self, up: asyncio.Future[None], reason: ExitReason) -> None:
        if not up.done():
            up.set_exception(start_failed(self.cell.path, reason))
            up.exception()  # Seen: whoever waits may have given up.

    async def is_up(self, move: Move, up: asyncio.Future[None]) -> None:
        """Wait for the new life.

        Raises:
            CannotMove, StartFailed: it does not come up, or has ended again.
        """
        await move.within(up, move.timeout, lambda: "its new life was not up")
        if self.other.state is not RUNNING:
            raise start_failed(self.cell.path, self.other.extra().reason)

    def take_over(
        self, queue: Iterable[Any], stash: Iterable[Any], bound: Bound | None, *, suspended: bool
    ) -> list[Item]:
        """From here on the new life is the one, with what waits for it; returns the commands that it had beside.

        A life that has ended meanwhile, by its background work, leaves the mailbox and nothing else.
        """
        cell, other, more = self.cell, self.other, self.cell.extra()
        own, commands = sorted_out(other, ticks=True)
        if other.state is RUNNING:
            settle(other, cell)
        more.outlet, more.bound = None, bound
        cell.admit = mailbox.admit_first if bound is None else mailbox.admit_bounded
        cell.queue = None  # That of a bounded mailbox is another one.
        waiting = mailbox.queue_of(cell)
        waiting.extend(item for one in (*own, *queue) if (item := decoded(cell, one)) is not None)
        if bound is not None:
            bound.count = sum(map(mailbox.counts, waiting))
        kept = deque(item for one in stash if (item := decoded(cell, one)) is not None)
        more.stash = kept or None
        if suspended:
            mailbox.suspend(cell)
        return commands

    def discard(self) -> None:
        """The new life is not to be."""
        dispose(self.other)


class ToHere(Entering):
    """The life of an actor without a home begins in this process."""

    to = "to a task"

    def __init__(self, host: Host) -> None:
        self.host = host
        self._arrival: Arrival | None = None

    async def begin(self) -> None:
        start, luggage = self.cell.extra().start, self.move.luggage
        assert start is not None
        arrival = self._arrival = Arrival(self.cell)
        await arrival.is_up(self.move, arrival.begin(start, luggage.restore, trap_exits=luggage.traps))

    def take_over(self) -> list[Item]:
        cell, luggage, arrival = self.cell, self.move.luggage, self._arrival
        assert arrival is not None
        bound = None
        if luggage.bound is not None:
            bound = Bound(luggage.bound.capacity, luggage.bound.overflow).inherit(luggage.bound)
        commands = arrival.take_over(luggage.queue, luggage.stash, bound, suspended=luggage.suspended)
        for name, body, left, interval in luggage.timers:
            message = cell.node.codec.decode(cell.table.kind_named(name), body)
            LoopTimer.unpacked(cell, message, max(0.0, left), interval or None, False)
        let_come(cell, luggage.waiting)
        if bound is not None:
            let_in(cell, bound)
        return commands

    def go_on(self) -> None:
        lifecycle.up(self.cell)
        self.move.gone_on_at = now()

    def discard(self) -> None:
        if self._arrival is not None:
            self._arrival.discard()


def let_in(cell: Cell, bound: Bound) -> None:
    """Some of those who waited for room may have it now."""
    bound.count += 1
    bound.taken(cell)


def dispose(other: Cell) -> None:
    """End the life at a twin."""
    if other.state is not RUNNING or other.actor is None:
        return
    if other.more is not None and other.more.turn is not None:
        other.kill()
    else:
        lifecycle.killed(other)
