"""The heart of a replica: it beats as long as the bricks run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..actors.actor import Actor, on
from ..actors.bindings import Binding
from ..actors.errors import HoldfastError
from ..actors.message import Message
from ..checkpoint.records import START
from .orders import Beat, Stalled
from .sealed import tell_over

if TYPE_CHECKING:
    from .standing import Standing


class Tick(Message):
    """It is time for a heartbeat."""


class Heart(Actor):
    """Tells the failure detector that the bricks of this replica run, and that a turn does not end."""

    detector: Binding[Actor]
    proxy: Binding[Actor]

    def __init__(self, standing: Standing, name: str, interval: float, watch_turns: float) -> None:
        self._standing, self._name, self._interval, self._longest = standing, name, interval, watch_turns
        self._turn: tuple[int, int, int] | None = None  # that was in hand when last seen: epoch, turn, input
        self._seen = self._seconds = 0.0

    def on_start(self, restored: bool) -> None:
        """Beat at once, then regularly."""
        if self._interval > 0:
            self._beat(Tick())
            self.ctx.every(self._interval, Tick())

    @on(Tick)
    def _beat(self, message: Tick) -> None:
        standing = self._standing
        try:
            self.detector.tell(Beat(self._name, standing.epoch))
            if self._longest and (number := self._hung()) >= 0:
                self._say(Stalled(self._name, standing.epoch, number))
        except HoldfastError:
            return  # They are between two lives.

    def _hung(self) -> int:
        """The input whose turn takes too long, -1 if none does. While this process stood still, nothing is counted."""
        life = self._standing.server.life
        feed = None if life is None else life.feed
        if life is None or feed is None or feed.kind == START:
            self._turn = None
            return -1
        now, turn = self.ctx.cell.node.loop.time(), (self._standing.epoch, life.turn, feed.id)
        gap, self._seen = min(now - self._seen, 2 * self._interval), now
        if turn != self._turn:
            self._turn, self._seconds = turn, 0.0
            return -1
        self._seconds += gap
        if self._seconds <= self._longest:
            return -1
        self._seconds -= self._longest / 2  # It is said again then, if that has not helped.
        return feed.id

    def _say(self, stalled: Stalled) -> None:
        link, turn = self._standing.link, self._turn
        if link is None:
            self.proxy.tell(stalled)
        else:
            tell_over(link, self.proxy._cell, stalled, lambda: self._turn == turn)
