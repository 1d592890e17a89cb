"""An observer of the replicas of protected actors: does one lead, are all of them there, do they catch up?"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Final

from ...actors.kernel.cell import RUNNING
from ..literals import caught_up, led, whole
from .node_observer import at_root
from .observer import Manner, Observer

LONGER: Final = 4.0
"""Times the longest absence, or the longest catching up, that was seen to end, after which one is too long."""
FALLS: Final = 4
"""Lives that a replica may lose, one after another, before it has caught up once."""
WELL: Final = ("leads", "follows")


@dataclasses.dataclass(slots=True)
class _Replica:
    """What was seen of one replica."""

    well: float
    """When it was seen to lead or to follow for the last time."""
    joining: float | None = None
    """Since when it catches up, without an end of its life between."""
    falls: int = 0
    """Lives that it has lost since it was well."""
    is_there: bool = True


@dataclasses.dataclass(slots=True)
class _Watched:
    """What was seen of one group.

    Attributes:
        led: when one led for the last time.
        absence, catching: seconds of the longest absence of a replica, and of the longest catching up, that have ended.
    """

    led: float
    absence: float = 0.0
    catching: float = 0.0
    replicas: dict[str, _Replica] = dataclasses.field(default_factory=dict[str, _Replica])


class ReplicaObserver(Observer):
    """Says whether each protected actor is led and whole, and whether its replicas catch up.

    A replica is missed when it was gone for `patience` seconds, and for four times as long as it ever was before it
    came back; or when it has lost four lives without having caught up once. Catching up may take `catching` seconds,
    and four times as long as it ever took. Of an actor that was stopped nothing is said, nor of one whose supervisor
    lives in another process: what its replicas do is known there.

    Args:
        protected: component to address; it may change.
        patience: seconds for which a replica, or a leader, may be missing whatever was usual.
        catching: seconds for which a replica may catch up whatever was usual.
        manner: see `Observer`.
    """

    def __init__(
        self,
        protected: Mapping[str, str],
        *,
        patience: float = 5.0,
        catching: float = 30.0,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(manner=manner or Manner(every=0.5))
        if not (patience > 0 and catching > 0):
            raise ValueError(f"patience is {patience!r} and catching {catching!r}; both must be > 0 seconds")
        self._protected, self._patience, self._catching = protected, patience, catching
        self._groups: dict[str, _Watched] = {}

    def on_start(self, restored: bool) -> None:
        """Begin. Raises SpecError in a process of its own."""
        at_root(self)
        super().on_start(restored)

    def afresh(self, names: Collection[str]) -> None:
        """Who was missing before somebody acted has time to come back."""
        now = self.now
        for group in (group for component, group in self._groups.items() if component in names):
            group.led = now
            for replica in group.replicas.values():
                replica.well, replica.falls = now, 0
                replica.joining = None if replica.joining is None else now

    def look(self) -> None:
        """Look at all groups."""
        node, now = self.ctx._cell.node, self.now
        for gone in self._groups.keys() - self._protected.keys():
            del self._groups[gone]
        for component, path in self._protected.items():
            cell = node.find(path)
            states = None if cell is None or cell.state is not RUNNING else cell.host.place.replica_states()
            if states is None:
                self._groups.pop(component, None)
                for atom in (led(component), whole(component), caught_up(component)):
                    self.verdict(atom, None)
            else:
                self._judge(component, self._groups.setdefault(component, _Watched(now)), states, now)

    def _judge(self, component: str, group: _Watched, states: Mapping[str, str], now: float) -> None:
        is_led = "leads" in states.values()
        if is_led:
            group.led = now
        self.verdict(led(component), True if is_led else False if now - group.led > self._patience else None)
        for gone in group.replicas.keys() - states.keys():
            del group.replicas[gone]
        for name, state in states.items():
            _note(group, group.replicas.setdefault(name, _Replica(now)), state, now)
        late = max(self._patience, LONGER * group.absence)
        slow = max(self._catching, LONGER * group.catching)
        missed = [each.falls >= FALLS or (each.joining is None and now - each.well > late) for each in _ill(group, now)]
        behind = [each.joining is not None and now - each.joining > slow for each in _ill(group, now)]
        if states:  # Without any, it is being recovered: who leads is the question then.
            self.verdict(whole(component), _whether(missed))
            self.verdict(caught_up(component), _whether(behind))


def _note(group: _Watched, replica: _Replica, state: str, now: float) -> None:
    """Take down how a replica does now."""
    is_there = state in WELL or state == "joining"
    if replica.is_there and not is_there:
        replica.falls += 1
    if state in WELL:
        if replica.joining is not None:
            group.catching = max(group.catching, now - replica.joining)
        if replica.falls:
            group.absence = max(group.absence, now - replica.well)
        replica.well, replica.joining, replica.falls = now, None, 0
    elif state == "joining":
        replica.joining = now if replica.joining is None else replica.joining
    else:
        replica.joining = None
    replica.is_there = is_there


def _ill(group: _Watched, now: float) -> list[_Replica]:
    return [replica for replica in group.replicas.values() if replica.well < now]


def _whether(problems: list[bool]) -> bool | None:
    """That all are well, that one is too late, or that it is not known yet."""
    return True if not problems else False if any(problems) else None
