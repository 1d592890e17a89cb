"""The failure detector: heartbeats judged by phi accrual, on a clock that stands still while the observer does.

A late observer sees all heartbeats late. What it was late itself is no silence of theirs, so its lag is taken out. So
is the time for which a replica had no processor to beat with, and what going through its state may take it.

Source:
    Hayashibara, Defago, Yared and Katayama, "The phi accrual failure detector" (2004).
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from ...actors.kernel.actor import on
from ...actors.observer_clock import OwnClock
from ..bricks.replica_orders import Broken, ReplicaBeat
from ..model.detection import Detection
from .membership import is_within
from .replicas import GroupPart

if TYPE_CHECKING:
    from .replicas import Replicas

KEPT = 200
"""Intervals between heartbeats that are remembered."""
HIGHEST = 1000.0
"""Phi when the silence is longer than can be told."""


class Accrual:
    """What is known of one replica's heartbeats, and how much its silence means."""

    def __init__(self, detection: Detection, now: float, starved: float = 0.0) -> None:
        self._detection, self.last, self.starved = detection, now, starved
        self._gaps: deque[float] = deque(maxlen=KEPT)
        self._sum = self._squares = 0.0

    def watch_as(self, detection: Detection) -> None:
        """It is watched like this from now on."""
        if detection.interval != self._detection.interval:  # What the heartbeats so far let expect is over.
            self._gaps.clear()
            self._sum = self._squares = 0.0
        self._detection = detection

    def heard(self, now: float, starved: float = 0.0) -> None:
        """A heartbeat has come, from one that had no processor for so many seconds of its life."""
        gap, self.last, self.starved = max(0.0, now - self.last), now, starved
        if len(self._gaps) == KEPT:
            oldest = self._gaps[0]
            self._sum -= oldest
            self._squares -= oldest * oldest
        self._gaps.append(gap)
        self._sum += gap
        self._squares += gap * gap

    def phi(self, now: float) -> float:
        """Minus the decimal logarithm of the chance that a heartbeat still comes after this silence."""
        detection, count = self._detection, len(self._gaps)
        mean = detection.interval if not count else max(self._sum / count, detection.interval)
        variance = 0.0 if not count else max(0.0, self._squares / count - (self._sum / count) ** 2)
        deviation = max(math.sqrt(variance), detection.spread)
        late = (now - self.last - mean - detection.pause) / deviation
        chance = 0.5 * math.erfc(late / math.sqrt(2.0))
        return min(HIGHEST, -math.log10(chance)) if chance > 0 else HIGHEST

    def is_suspect(self, now: float) -> bool:
        """Whether its silence is too long."""
        return self.phi(now) >= self._detection.threshold


class Detector(GroupPart):
    """The root's side: hears the heartbeats of a group's replicas, and tells the failover manager whom it suspects."""

    def __init__(self, replicas: Replicas) -> None:
        self._replicas = replicas
        self._known: dict[tuple[str, int], Accrual] = {}
        self._period = replicas.detection.interval / 2

    def on_start(self, restored: bool) -> None:
        """Nothing is known yet: whoever is silent from now on is suspected in its time."""
        self._clock = OwnClock(self.ctx._cell.node.loop.time(), self._period)
        self._look()

    @on(ReplicaBeat)
    def heard(self, beat: ReplicaBeat) -> None:
        """Take down that a replica is alive."""
        replicas, name = self._replicas, beat.name
        life = replicas.life_of(name)
        if not life or not is_within(replicas.place(name), self.ctx.sender):
            return  # It has died since it said so; or another one has said it.
        accrual = self._known.get((name, life))
        now = self._clock.at(self.ctx._cell.node.loop.time())
        if replicas.heard(name, life) or accrual is None:  # It may be another replica of that name.
            self._known = {key: one for key, one in self._known.items() if key[0] != name}
            self._known[name, life] = Accrual(replicas.detection, now, replicas.starved(name))
        else:
            accrual.heard(now, replicas.starved(name))

    @on(Broken)
    def broken(self, message: Broken) -> None:
        """A replica is ending: nobody needs to wait for that."""
        replicas = self._replicas
        if replicas.life_of(message.name) == message.life and is_within(replicas.place(message.name), self.ctx.sender):
            replicas.blame(message.name, message.life, message.why)

    def _look(self) -> None:
        if self.ctx._closed:
            return  # This life was killed: the next one looks, and this one hears nothing any more.
        loop = self.ctx._cell.node.loop
        detection = self._replicas.detection
        if detection.interval / 2 != self._period:  # A change of mechanism has said so.
            self._period = detection.interval / 2
            self._clock.look_every(self._period)
        now = self._clock.tick(loop.time())
        for known in self._known.values():
            known.watch_as(detection)
        for name, life in self._replicas.watched():
            accrual = self._known.get((name, life))
            if accrual is None:  # Not heard yet by this life of ours.
                self._known[name, life] = Accrual(self._replicas.detection, now, self._replicas.starved(name))
            elif accrual.is_suspect(now) and self._is_silent(name, accrual, now):
                self._replicas.silent(name, life, f"no heartbeat for {now - accrual.last:.3f} s")
        self.call_later(self._period, self._look)

    def _is_silent(self, name: str, accrual: Accrual, now: float) -> bool:
        """Whether it would also be suspected if it had had a processor, and no large state to go through."""
        heard = now - self._replicas.starved(name) + accrual.starved
        return accrual.is_suspect(heard) and accrual.is_suspect(heard - self._replicas.at_work(name))
