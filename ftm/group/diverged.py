"""Followers that have lost the leader's state: they join again, and are ended if that does not help.

A transient fault is over when the state was taken once more. Who diverges again and again is faulty: its process ends,
and what is started in its place joins, each time later than the time before.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from ..events import ReplicaFaulty

if TYPE_CHECKING:
    from .group import Group

MOST = 3
"""Times in a row that a follower may stray."""
STEADY = 1000
"""Turns after which it has not strayed again: the next time is the first one."""
FIRST_PAUSE, LONGEST_PAUSE = 0.02, 2.0
"""Seconds until it joins again; doubled each time in a row."""


@dataclasses.dataclass
class Record:
    """What is known of one life of a follower."""

    life: int
    turn: int  # at which it joined last
    times: int = 0  # in a row
    until: float = 0.0  # it does not join before that, on the loop's clock


class Strays:
    """Who has strayed, how often, and since when."""

    def __init__(self, group: Group) -> None:
        self._group = group
        self._known: dict[str, Record] = {}
        self.faulty: dict[str, int] = {}  # name to life, of those to be ended
        self.count = 0

    def joined(self, name: str, life: int) -> None:
        """It has the leader's state."""
        self._of(name, life).turn = self._group.switch.turn

    def told(self, path: str) -> None:
        """The leader says that the one at this path has lost it."""
        group, name = self._group, path.rpartition("/")[2]
        life = group.members.get(name, 0) or group.joining.get(name, 0)
        if not life:
            return  # It does not count as it is; or that life is over, and the next one has to join anyway.
        self.count += 1
        record = self._of(name, life)
        record.times = 1 if group.switch.turn - record.turn > STEADY else record.times + 1
        pause = min(FIRST_PAUSE * 2 ** (record.times - 1), LONGEST_PAUSE)
        record.until = group.node.loop.time() + pause
        if record.times >= MOST:
            self.faulty[name] = life
            group.node.emit(ReplicaFaulty(group.path, name, group.epoch, record.times))
        group.lost(name, "it has diverged from the one that leads")
        group.wake()

    def pause(self, name: str, life: int) -> float:
        """Seconds until it may join again."""
        record = self._of(name, life)
        return record.until - self._group.node.loop.time()

    def _of(self, name: str, life: int) -> Record:
        record = self._known.get(name)
        if record is None or record.life != life:
            record = self._known[name] = Record(life, self._group.switch.turn)
        return record
