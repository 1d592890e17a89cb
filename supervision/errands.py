"""Errands: the waiting work of a supervisor, as coroutines stepped in its turns; no turn ever waits.

An errand is written as a coroutine. It is stepped in turns of the actor; where it waits, that turn ends, and when what
it waits for has come, the rest is another item in the actor's mailbox: behind all that is there, except for children
that are still to be started. So the actor answers, and can be stopped, while children start and stop; and what an
errand finds after a wait may be different from what it left.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Sequence
from typing import Any

from ..actors.errors import HoldfastError
from ..actors.kernel import lifecycle, mailbox
from ..actors.kernel.context import ActorContext
from ..actors.kernel.envelope import LEAVE, Ask, Envelope, Item, ReplyHandle, fail
from .admin import StartChild


class Errand(Item):
    """One errand of one life. It is dropped where it stands when that life ends."""

    __slots__ = ("_ctx", "_first", "is_over", "is_urgent", "work")

    def __init__(
        self, ctx: ActorContext, work: Coroutine[Any, Any, None], first: lifecycle.FirstTurn | None = None
    ) -> None:
        self._ctx, self.work, self._first = ctx, work, first
        self.is_over = False
        self.is_urgent = False  # it goes on though the actor is suspended

    def step(self) -> None:
        """Go on until it waits. Raises what the coroutine raises."""
        try:
            awaited: asyncio.Future[Any] = self.work.send(None)
        except StopIteration:
            self.is_over = True
            return
        except BaseException:
            self.is_over = True
            raise
        awaited._asyncio_future_blocking = False  # As a task would: we do wait for it.
        self._ctx._cell.node.errand_waits()
        awaited.add_done_callback(self._woken)

    def _woken(self, awaited: asyncio.Future[Any]) -> None:
        cell = self._ctx._cell
        if not self._ctx._closed:
            queue = cell.queue or ()
            starts = 0 if self.is_urgent else _starts_behind(queue)
            if starts:  # Who is among thousands that start is answered when it is up, and not behind the last of them.
                mailbox.queue_of(cell).insert(len(queue) - starts, self)
                cell.schedule()
            else:
                (cell.urge if self.is_urgent else cell.push)(self)
        cell.node.errand_goes_on()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        try:
            item.step()
        except BaseException as error:
            if item._first is None:
                raise
            lifecycle.crash(item._ctx._cell, item._first, error)  # It is the start of this life that has failed.
            return LEAVE
        if item.is_over and item._first is not None:
            lifecycle.came_up(item._ctx._cell)
        return None


def _starts_behind(queue: Sequence[Any]) -> int:
    """How many orders to start a child there are behind everything else. (There may be thousands, at each call.)"""
    count = 0
    for item in reversed(queue):
        kind = type(item)
        if kind is Ask or kind is Envelope:
            kind = type(item.message)
        if kind is not StartChild:
            break
        count += 1
    return count


async def answered(ctx: ActorContext, handle: ReplyHandle[Any], work: Coroutine[Any, Any, Any]) -> None:
    """Do what was asked for, and answer: an error is the caller's business, not our crash."""
    item = ctx._item
    try:
        reply = await work
    except HoldfastError as error:
        fail(ctx, handle, item, error)
    else:
        handle.reply(reply)
