"""The tracks of the history: kinds of events that are bounded apart, so that none of them drives out the others."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

from .intake.quota import EventQuota
from .past_event import PastEvent
from .ring import EventRing

TrackName: TypeAlias = Literal["rare", "others", "letters"]


class TrackBounds(NamedTuple):
    """What is kept of one track.

    Attributes:
        most: events in memory, at most.
        most_bytes: bytes that they may take there, about.
        stored_bytes: bytes that the store keeps of them.
        burst: events that are recorded at once.
        per_second: events that are recorded each second for as long as they go on.
    """

    most: int
    most_bytes: int
    stored_bytes: int
    burst: int
    per_second: float


MIB = 1024 * 1024
BOUNDS: Mapping[TrackName, TrackBounds] = MappingProxyType(
    {
        "rare": TrackBounds(2_000, 2 * MIB, 256 * 1024, 1_000, 100.0),
        "others": TrackBounds(5_000, 4 * MIB, 512 * 1024, 1_000, 100.0),
        "letters": TrackBounds(1_000, MIB, 128 * 1024, 500, 50.0),
    }
)
COUNTED = 0.1
"""What an event takes of the quota that is not recorded, but counted."""
LETTERS = frozenset({"DeadLetter"})
RARE = frozenset(
    {
        "AdaptationUndone",
        "AutoShutdown",
        "EventsLeftOut",
        "FailedOver",
        "HistoryNotKept",
        "JournalBlocked",
        "JournalFull",
        "JournalGoesOn",
        "JournalStopped",
        "MechanismAttached",
        "MechanismChanged",
        "MechanismDetached",
        "MechanismSettled",
        "MessageQuarantined",
        "ProtectionLost",
        "RecordsMapped",
        "RecoveryFailed",
        "ReplicaFaulty",
        "ReplicaJoined",
        "ReplicaLost",
        "RolledBack",
        "ScriptLoaded",
        "SnapshotDamaged",
        "SpecificationNotKept",
        "SpecificationSuperseded",
        "SupervisorGaveUp",
        "SystemStarted",
        "SystemStopped",
        "TransactionBegan",
        "TransactionCommitted",
        "TransactionRolledBack",
        "TrustBreached",
        "TurnsLost",
    }
)
"""Events that weigh much and come seldom; what comes by the thousand does not drive them out."""


def track_of(kind: str) -> TrackName:
    """The track of an event of this kind.

    >>> track_of("SupervisorGaveUp"), track_of("DeadLetter"), track_of("ActorCrashed")
    ('rare', 'letters', 'others')
    """
    if kind in RARE:
        return "rare"
    return "letters" if kind in LETTERS else "others"


class EventTrack:
    """The events of one track: the newest ones, and how many more are recorded at the moment.

    Args:
        bounds: what is kept.
        now: seconds on the clock of the loop.

    Attributes:
        ring: the events that are kept.
    """

    def __init__(self, bounds: TrackBounds, now: float) -> None:
        self.ring = EventRing[PastEvent](bounds.most, bounds.most_bytes)
        self._burst = bounds.burst
        self._quota = EventQuota(bounds.burst, bounds.per_second, now)

    def admits(self, now: float, *, leaving: float = 0.0) -> bool:
        """Whether one more is recorded, if so large a part of the quota is to be left to others behind it."""
        return self._quota.take(now, least=max(1.0, leaving * self._burst))

    def counts(self, now: float) -> bool:
        """Whether one more is counted, which takes a tenth of what it takes to record it."""
        return self._quota.take(now, cost=COUNTED)

    def is_quiet(self, now: float) -> bool:
        """Whether hardly anything has come lately."""
        return self._quota.has(now, self._burst / 4)
