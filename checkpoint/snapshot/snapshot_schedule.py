"""The schedule of snapshots: what a home knows (data), and whether one is due (a pure decision).

The checkpoint handler acts on this and may die at any moment; what it needs stands here.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from ...actors.errors import HoldfastError
from ...actors.events import SnapshotFailed

if TYPE_CHECKING:
    from ..home.switch import Switch

FIRST_RETRY, LONGEST_RETRY = 0.25, 60.0
"""Seconds until a failed snapshot is tried again; doubled each time, and never more often than the interval."""


class CheckpointFailed(HoldfastError, text="{actor} could not be saved: {reason}"):
    """The snapshot that was asked for could not be made or kept; what was there before still is."""

    actor: str
    reason: str


def retry_after(failures: int, interval: float) -> float:
    """Seconds to wait after so many failures in a row.

    >>> [retry_after(times, 2.0) for times in (1, 4, 5, 50)], retry_after(3, 3600.0)
    ([2.0, 2.0, 4.0, 60.0], 60.0)
    """
    return min(max(FIRST_RETRY * 2.0 ** min(failures - 1, 20), min(interval, LONGEST_RETRY)), LONGEST_RETRY)


class SnapshotSchedule:
    """What one home knows of its next snapshot."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self.asked_at = -1.0  # a snapshot is on its way since then, on the loop's clock; -1: none
        self.not_before = 0.0
        self.failures = 0
        self.last_at = home.node.loop.time()  # when the last one was kept, or looked for
        self.is_wanted = False  # so many messages or bytes since the last one
        self.wishes: list[tuple[int, asyncio.Future[None]]] = []  # who waits, and for which turn
        self.on_want = nobody

    def count(self, turn: int) -> None:
        """A turn has ended, of an actor that is saved every so many of them."""
        every = self._home.method.every
        if every is not None and turn - self._home.ledger.state_turn >= every and not self.is_wanted:
            self.want()

    def want(self) -> None:
        """A snapshot is due now, not only when the interval is over."""
        self.is_wanted = True
        self.on_want(self._home)

    def wish(self) -> asyncio.Future[None]:
        """A future that ends when a snapshot of all turns up to now is safe."""
        home = self._home
        future: asyncio.Future[None] = home.node.loop.create_future()
        if not home.method.snapshots:
            future.set_exception(CheckpointFailed(home.path, f"{home.method.name} takes no snapshots"))
        elif home.ledger.turn <= home.ledger.state_turn:
            future.set_result(None)
        else:
            self.wishes.append((home.ledger.turn, future))
            self.on_want(home)
        return future

    def kept(self, turn: int) -> None:
        """A snapshot after this turn is safe."""
        self.asked_at, self.failures, self.not_before = -1.0, 0, 0.0
        self.last_at = self._home.node.loop.time()
        self.is_wanted = False
        left: list[tuple[int, asyncio.Future[None]]] = []
        for wanted, future in self.wishes:
            if wanted > turn:
                left.append((wanted, future))
            elif not future.done():
                future.set_result(None)
        self.wishes = left
        if left:
            self.on_want(self._home)

    def failed(self, why: str) -> None:
        """No snapshot came of it: tell of it, and try again later."""
        home = self._home
        self.asked_at = -1.0
        self.failures += 1
        self.not_before = home.node.loop.time() + retry_after(self.failures, home.method.interval)
        wishes, self.wishes = self.wishes, []
        for _, future in wishes:
            if not future.done():
                future.set_exception(CheckpointFailed(home.path, why))
                future.exception()  # Whoever wished may be gone.
        if not home.homes.journal.engine.has_failed():  # What has ended the store tells more.
            home.node.emit(SnapshotFailed(home.path, why))

    def missed(self) -> None:
        """What was asked for was given up by the life: another one is on its way, or is asked for after a while."""
        self.asked_at = -1.0
        self.not_before = self._home.node.loop.time() + FIRST_RETRY
        self.on_want(self._home)

    def restarted(self) -> None:
        """Another life begins: what was asked of the last one will not come."""
        self.asked_at = -1.0

    def abandon(self, why: str) -> None:
        """Nobody lives here any more."""
        wishes, self.wishes = self.wishes, []
        for _, future in wishes:
            if not future.done():
                future.set_exception(CheckpointFailed(self._home.path, why))
                future.exception()

    def when(self, now: float) -> float | None:
        """When to ask for a snapshot: now if that has passed; None: nothing is to be saved, or one is on its way."""
        home = self._home
        if home.life.port is None or not home.life.is_released or home.ledger.turn <= home.ledger.state_turn:
            return None
        if home.images.is_saving or (self.asked_at >= 0 and now - self.asked_at < home.method.interval):
            return None
        if self.is_wanted or self.wishes:
            return self.not_before if not self.wishes else now
        return max(self.not_before, self.last_at + home.method.interval)


def nobody(home: Switch) -> None:
    """Stands for the handler while there is none: it looks at all homes when it comes."""
