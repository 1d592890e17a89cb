"""Events that are alike, and may come as often as messages do: the first are recorded, and of more only how many."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TypeAlias

from ....actors.events import (
    DeadLetter,
    EffectRepeated,
    EffectRetried,
    Event,
    LoopLagged,
    SnapshotFailed,
    StoreRefused,
    TurnSlow,
)
from ....actors.overflow import is_of_policy
from ....checkpoint.addresses import is_at
from ....ftm.alarms import Diverged, Masked, Objected, Outvoted, RequestsDropped, StatesDiffer
from ....ftm.bricks.sealed_frames import FrameRefused
from ....ftm.events import TurnHung, WrongSuspicion
from ..past_event import Plain, dotted, message_type, shortened
from .quota import EventQuota

Sort: TypeAlias = "tuple[type[Event], str, tuple[str, ...]]"
"""What events have in common that are alike: their class, their address, and the texts by which they are told apart."""

FIRST = 100
"""Events of one sort that are recorded one by one."""
EVERY = 60.0
"""Seconds until one more of them is, and between two rows that say how many there were beside these."""
MOST_SORTS = 500
"""Sorts that are told apart; of more, the oldest is told of and begins anew."""
LONGEST_TEXT = 200
"""Characters of a text by which events are told apart."""
TOLD_APART_BY: Mapping[type[Event], tuple[str, ...]] = MappingProxyType(
    {
        DeadLetter: ("message", "why"),
        Diverged: ("replica", "name"),
        EffectRepeated: ("message",),
        EffectRetried: ("effect",),
        FrameRefused: ("place", "reason"),
        LoopLagged: (),
        Masked: ("replica",),
        Objected: ("replica", "why"),
        Outvoted: ("replica",),
        RequestsDropped: ("replica",),
        SnapshotFailed: ("reason",),
        StatesDiffer: ("replica",),
        StoreRefused: ("reason",),
        TurnHung: ("message",),
        TurnSlow: ("message",),
        WrongSuspicion: ("replica",),
    }
)
"""Events that may come as often as messages do, and the fields by which those of one address are told apart."""


@dataclasses.dataclass(slots=True)
class AlikeEvents:
    """What may still be recorded of one sort, and how many events were only counted since the last row."""

    quota: EventQuota
    fields: dict[str, Plain]
    counted: int = 0


class AlikeCounter:
    """Counts events that are like many before them.

    Of a sort the first 100 are recorded one by one, and then one a minute; of what a mailbox drops by the overflow
    policy that it was given the first only. The others are counted.
    """

    def __init__(self) -> None:
        self._sorts: dict[Sort, AlikeEvents] = {}
        self._crowded: list[tuple[str, str, dict[str, Plain]]] = []

    def counts(self, event: Event, now: float) -> bool:
        """Whether an event is only counted; else it is to be recorded.

        Args:
            event: that was told.
            now: seconds on any clock that does not go back.
        """
        kind = type(event)
        names = TOLD_APART_BY.get(kind)
        if names is None:
            return False
        texts = tuple(_text(event, name) for name in names)
        sort = kind, event.address, texts
        known = self._sorts.get(sort)
        if known is None:
            self._make_room()
            is_meant = isinstance(event, DeadLetter) and is_of_policy(event.why)
            quota = EventQuota(1 if is_meant else FIRST, 1.0 / EVERY, now)
            known = self._sorts[sort] = AlikeEvents(quota, dict(zip(names, texts, strict=True)))
        if known.quota.take(now):
            return False
        known.counted += 1
        return True

    def _make_room(self) -> None:
        if len(self._sorts) >= MOST_SORTS:
            oldest = next(iter(self._sorts))
            self._crowded += _rows(oldest, self._sorts.pop(oldest))

    def take_rows(self) -> list[tuple[str, str, dict[str, Plain]]]:
        """Kind, address and fields of one row for each sort of which some were counted since the last call."""
        rows, self._crowded = self._crowded, []
        for sort, known in self._sorts.items():
            rows += _rows(sort, known)
        return rows

    def forget(self, top: str) -> None:
        """Forget what was counted of an address, of those below it, and of whoever names it."""
        for sort in [sort for sort in self._sorts if is_at(sort[1], top) or any(top in text for text in sort[2])]:
            del self._sorts[sort]
        self._crowded = [row for row in self._crowded if not is_at(row[1], top) and top not in str(row[2])]


def _rows(sort: Sort, known: AlikeEvents) -> Iterator[tuple[str, str, dict[str, Plain]]]:
    if known.counted:
        yield sort[0].__name__, sort[1], {**known.fields, "alike": known.counted}
        known.counted = 0


def _text(event: Event, name: str) -> str:
    value: object = getattr(event, name)
    if not isinstance(value, str):
        value = message_type(value)
    return shortened(dotted(value) if name == "message" else value, LONGEST_TEXT)
