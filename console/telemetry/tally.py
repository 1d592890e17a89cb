"""Counts what events tell. It is called with every event, so it only adds up; nothing is written or formatted here."""

from __future__ import annotations

from ... import events
from ...actors.events import (
    REFUSED,
    TRACED,
    ActorCrashed,
    ChildRestarted,
    DeadLetter,
    Event,
    EventStream,
    HeldMessages,
    JournalBlocked,
    JournalGoesOn,
    JournalStopped,
    Recovered,
    SnapshotTaken,
    TurnSlow,
)
from ...actors.exit_reasons import Crash
from ...ftm.bricks.sealed_frames import FrameRefused
from ...ftm.events import FailedOver
from .series import Labels, Spread, Tallies

QUICK = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
"""Upper bounds in seconds, for what takes a millisecond as a rule and a minute at worst."""


KINDS = tuple(name for name in events.__all__ if name not in {kind.__name__ for kind in (*TRACED, Event, EventStream)})
"""The events that there are. Each is counted from 0 on: an alert sees no increase in what was not there before."""


class Tally:
    """A sink for the events of one system.

    Args:
        most: how many supervisors, and how many types of errors, are told apart.
    """

    def __init__(self, most: int) -> None:
        self._supervisors, self._errors = Labels(most), Labels(most)
        self.events = Tallies((kind,) for kind in KINDS)
        self.restarts, self.crashes = Tallies(), Tallies()
        self.refused, self.phases = Tallies(), Tallies()
        self.replayed = self.snapshot_bytes = self.written_bytes = 0
        self.longest_slow_turn = 0.0
        self.recoveries, self.failovers, self.pauses = Spread(QUICK), Spread(QUICK), Spread(QUICK)
        self.store = 1
        """1: the store writes, 0: it does not at the moment, -1: it does not any more."""

    def __call__(self, event: Event) -> None:
        self.events.add(type(event).__name__)
        match event:
            case ChildRestarted(reason=reason):
                supervisor = event.address.rpartition("/")[0]
                self.restarts.add(self._supervisors.of(supervisor), type(reason).__name__)
            case ActorCrashed(reason=Crash(type_name=name)):
                self.crashes.add(self._errors.of(name))
            case Recovered(replayed=replayed, phases=phases):
                self.replayed += replayed
                self.recoveries.add(sum(phases.values()))
                for phase, seconds in phases.items():
                    self.phases.add(phase, by=seconds)
            case SnapshotTaken():
                self.snapshot_bytes += event.size_bytes
                self.written_bytes += event.written_bytes
                self.pauses.add(event.pause)
            case FailedOver(seconds=seconds):
                self.failovers.add(seconds)
            case HeldMessages(refused=refused):
                self.refused.add("held", by=refused)
            case FrameRefused():
                self.refused.add("frame")
            case DeadLetter(why=why) if why.startswith(REFUSED):
                self.refused.add("message")
            case TurnSlow(seconds=seconds):
                self.longest_slow_turn = max(self.longest_slow_turn, seconds)
            case JournalBlocked():
                self.store = 0
            case JournalGoesOn():
                self.store = 1
            case JournalStopped():
                self.store = -1
            case _:
                pass
