"""Timers: messages that come later, through the mailbox like any other."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from ..seconds import check_seconds
from ..values.saved_refs import OneOfItsKind
from .envelope import Chain, Item
from .message import Message

if TYPE_CHECKING:
    from .cell import Cell


class Timer(OneOfItsKind):
    """A handle on one timer of an actor, from `ctx.tell_after` or `ctx.every`, for that actor alone.

    Without recovery the timer ends with the life that set it; with recovery it runs on, and the handle may be kept in
    the state.
    """

    __slots__ = ()

    @property
    def is_active(self) -> bool:
        """Say whether the message of the timer may still come: it runs, or its message waits in the mailbox."""
        raise NotImplementedError

    def cancel(self) -> None:
        """Cancel the timer: its message does not come any more, not even if it is queued already."""
        raise NotImplementedError


class LoopTimer(Timer):
    """A timer on the loop of the actor's process, for one life."""

    __slots__ = ("_cell", "_due", "_handle", "_interval", "_queued", "message")

    def __init__(self, cell: Cell, message: Message[Any], delay: float, interval: float | None) -> None:
        cell.require(message)
        self._cell = cell
        self.message = message
        self._interval = interval
        self._queued = False
        self._due = cell.node.loop.time() + delay
        self._handle: asyncio.TimerHandle | None = None
        cell.extra().belongings.timers.add(self)
        self._arm()

    @property
    def is_active(self) -> bool:
        return self._handle is not None or self._queued

    @property
    def is_queued(self) -> bool:
        """Say whether a tick of the timer is in the mailbox, and counts."""
        return self._queued

    @property
    def is_repeated(self) -> bool:
        """Say whether the message of the timer comes again and again."""
        return self._interval is not None

    def cancel(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
        self._handle = None
        self._queued = False
        if self._cell.more is not None:
            self._cell.more.belongings.timers.discard(self)

    def pause(self) -> None:
        """Hold the timer while its actor is moved: nothing comes until `resume`."""
        if self._handle is not None:
            self._handle.cancel()  # Kept: what has a handle is armed again.

    def resume(self) -> None:
        """Let a timer go on that was paused: its actor stays after all."""
        if self._handle is not None:
            self._arm()

    def packed(self) -> tuple[Message[Any], float | None, float | None, bool]:
        """Message, seconds left (None: it has fallen due), interval, and whether a tick of it is queued."""
        left = None if self._handle is None else max(0.0, self._due - self._cell.node.loop.time())
        return self.message, left, self._interval, self._queued

    @classmethod
    def unpacked(
        cls, cell: Cell, message: Message[Any], left: float | None, interval: float | None, queued: bool
    ) -> LoopTimer:
        """Make the timer of an actor that has been moved here again, from its data."""
        left = None if left is None else check_seconds(cell.path, "delay", left, or_zero=True)
        interval = None if interval is None else check_seconds(cell.path, "interval", interval)
        timer = cls(cell, message, left or 0.0, interval)
        timer.pause()
        if left is None:
            timer._handle = None
        else:
            timer._arm()
        if queued:
            timer._queued = True
            cell.push(Tick(timer))
        return timer

    def ended(self, cell: Cell) -> None:
        """Be a timer whose message has come, or never will."""
        self._cell, self._handle, self._queued, self._interval, self._due = cell, None, False, None, 0.0

    def belongs_to(self, cell: Cell) -> None:
        """Bind the timer to another cell: its actor lives there from now on."""
        self._cell = cell

    def _arm(self) -> None:
        self._handle = self._cell.node.loop.call_at(self._due, self._fire)

    def _fire(self) -> None:
        self._handle = None
        if not self._queued:
            self._queued = True
            self._cell.push(Tick(self))
        if self._interval is not None:
            now = self._cell.node.loop.time()
            missed = max(0, int((now - self._due) / self._interval))
            self._due += self._interval * (missed + 1)
            self._arm()

    def taken(self) -> bool:
        """Note that the turn of the timer's message has come; returns whether the message still counts."""
        counts, self._queued = self._queued, False
        if self._interval is None and self._cell.more is not None:
            self._cell.more.belongings.timers.discard(self)
        return counts


class Tick(Item):
    """A timer's message in the mailbox."""

    __slots__ = ("chain", "timer")

    def __init__(self, timer: LoopTimer) -> None:
        self.timer = timer
        self.chain: Chain = ()

    @property
    def is_cancelled(self) -> bool:  # type: ignore[override]  # as with the message
        """Whether its timer was cancelled while it was queued."""
        return not self.timer.is_queued

    @property
    def message(self) -> Message[Any]:
        """The message that the timer sends."""
        return self.timer.message

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        timer: LoopTimer = item.timer
        if not timer.taken():
            return None
        return actor._table[type(timer.message)](actor, timer.message)
