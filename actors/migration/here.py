"""Leaving this process, and arriving in it: a life here comes to rest, or begins beside its address."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from ..errors import CannotMove, StartFailed, error_text
from ..exit_reasons import ExitReason
from ..kernel import lifecycle, mailbox
from ..kernel.cell import RUNNING, Cell
from ..kernel.context import ActorContext
from ..kernel.envelope import Item
from ..kernel.mailbox import Bound
from .luggage import Owe
from .quiesce import Take, decoded, now, settle, sorted_out, twin
from .worker_moves import await_up

if TYPE_CHECKING:
    from ..kernel.actor import Actor, Start
    from .process_move import Move


class Departure:
    """A life in this process comes to rest between two turns, and is packed there."""

    def __init__(
        self, move: Move, owe: Owe, pack: Callable[[Actor, bytes], None], ignored: tuple[str, ...] = ()
    ) -> None:
        self._move, self._pack = move, pack
        self._start = move.cell.extra().start
        self._take = Take(owe, self._at_rest, move.give_up, ignored)
        self._rested: asyncio.Future[None] = move.node.loop.create_future()

    async def quiesce(self) -> None:
        """Bring the life to rest.

        Raises:
            CannotMove: it did not come to rest in time, or cannot leave.
        """
        move = self._move
        lifecycle.urge(move.cell, self._take)
        await move.within(self._rested, move.timeout, lambda: f"{self._take.why}, and that did not change")

    def _at_rest(self, actor: Actor, state: bytes) -> None:
        """Called in its place between two turns; if this raises, the actor goes on."""
        move = self._move
        if move.given_up.done():
            raise CannotMove(move.cell.path, move.given_up.result())
        if move.cell.extra().start is not self._start:
            raise CannotMove(move.cell.path, "its code was replaced meanwhile; try again")
        move.rest_at = now()
        self._pack(actor, state)
        move.at_rest()
        self._rested.set_result(None)

    def call_off(self) -> None:
        """The life is not to come to rest any more."""
        self._take.is_void = True


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
            up.set_exception(StartFailed(self.cell.path, str(reason)))
            up.exception()  # Seen: whoever waits may have given up.

    async def is_up(self, move: Move, up: asyncio.Future[None]) -> None:
        """Wait for the new life.

        Raises:
            CannotMove, StartFailed: it does not come up, or has ended again.
        """
        await move.within(up, move.timeout, lambda: "its new life was not up")
        if self.other.state is not RUNNING:
            raise StartFailed(self.cell.path, str(self.other.extra().reason))

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
        more.suspended = suspended
        if suspended:
            mailbox.hold(cell)
        return commands

    def discard(self) -> None:
        """The new life is not to be."""
        dispose(self.other)


def dispose(other: Cell) -> None:
    """End the life at a twin."""
    if other.state is not RUNNING or other.actor is None:
        return
    if other.more is not None and other.more.turn is not None:
        other.kill()
    else:
        lifecycle.killed(other)
