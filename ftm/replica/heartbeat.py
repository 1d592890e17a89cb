"""The heart of a replica: it beats for as long as the bricks run."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.message import Message
from ...checkpoint.protocol import START
from ..bricks.replica_orders import ReplicaBeat, Stalled
from ..bricks.sealed_frames import tell_over
from ..model.mechanism import detection_in
from .replica_life import ServerLife

if TYPE_CHECKING:
    from ..bricks.standing import Standing
    from .protected_actor import Server


class HeartbeatDue(Message):
    """It is time for a heartbeat."""


Turn = tuple[int, ServerLife, int]
"""A turn in hand: epoch, life, input."""


class Heart(Actor):
    """Tells the failure detector that the bricks of this replica run, and that a turn does not end."""

    _is_part: ClassVar[bool] = True

    detector: Binding[Actor]
    proxy: Binding[Actor]

    def __init__(self, standing: Standing, name: str, interval: float, watch_turns: float) -> None:
        self._standing, self._name, self._usual = standing, name, (interval, watch_turns)
        self._interval, self._longest = self._usual
        self._turns: dict[Server, tuple[Turn, float]] = {}  # with the seconds that they have taken
        self._seen = 0.0

    def on_start(self, restored: bool) -> None:
        """Beat at once, then regularly."""
        if self._interval > 0:
            self._take_pace()
            self._timer = self.ctx.every(self._interval, HeartbeatDue())
            self._beat(HeartbeatDue())

    def _take_pace(self) -> None:
        said = detection_in(self._standing.layers)
        self._interval, longest = self._usual if said is None else (said.interval, said.watch_turns or 0.0)
        self._longest = longest or self._standing.server.turn_timeout

    @on(HeartbeatDue)
    def _beat(self, message: HeartbeatDue) -> None:
        standing, before = self._standing, self._interval
        self._take_pace()
        if self._interval != before:  # A change of mechanism has said so.
            self._timer.cancel()
            self._timer = self.ctx.every(self._interval, HeartbeatDue())
        try:
            self.detector.tell(ReplicaBeat(self._name, standing.epoch))
            if self._longest:
                self._watch_turns()
        except HoldfastError:
            return  # They are between two lives.

    def _watch_turns(self) -> None:
        """Tell of a turn that takes too long; a run that is only one of several has failed then."""
        standing = self._standing
        now = self.ctx._cell.node.loop.time()
        gap, self._seen = min(now - self._seen, 2 * self._interval), now  # While this process stood still, no turn ran.
        before, self._turns = self._turns, {}
        for server in (standing.server, *standing.server.shadows):
            life = server.life
            feed = None if life is None else life.feed
            if life is None or feed is None or feed.kind == START:
                continue
            turn = standing.epoch, life, feed.id
            known, seconds = before.get(server, (None, 0.0))
            if not life.waits.resting:  # Else nothing of it is at work.
                seconds += gap
            seconds = seconds if known == turn else 0.0
            if seconds > self._longest:
                seconds /= 2  # It is said again then, if that has not helped.
                if server is standing.server:
                    self._say(Stalled(self._name, standing.epoch, feed.id), turn)
                else:
                    server.end_turn(feed.id, again=False)
            self._turns[server] = turn, seconds

    def _say(self, stalled: Stalled, turn: Turn) -> None:
        link, server = self._standing.link, self._standing.server
        if link is None:
            self.proxy.tell(stalled)
        else:
            tell_over(link, self.proxy._cell, stalled, lambda: self._turns.get(server, (None, 0.0))[0] == turn)
