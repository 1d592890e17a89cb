"""What speaks against "healthy": symptoms that nobody has seen to have gone, and observers that have crashed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from .engine import Diagnosis
from .literals import Literal, Vocabulary
from .observations import Observed

CRASHED: Final = 60.0
"""Seconds for which an observer that has crashed is named."""


class _End(NamedTuple):
    """Why an observer has crashed, and until when it is named."""

    why: str
    until: float


class Doubts:
    """Holds what must be cleared up before a system is healthy. Plain data: whoever owns it gives the time."""

    def __init__(self) -> None:
        self._accused: dict[Literal, tuple[str, ...]] = {}
        self._crashed: dict[str, _End] = {}

    @property
    def crashed(self) -> Mapping[str, str]:
        """The observers that have crashed lately, each with the reason."""
        return {path: one.why for path, one in sorted(self._crashed.items())}

    def note_crash(self, source: str, why: str, now: float) -> float:
        """Name an observer from now on; returns until when."""
        self._crashed[source] = _End(why, now + CRASHED)
        return now + CRASHED

    def expire(self, now: float) -> bool:
        """Name observers no longer that have not crashed for a while; returns whether there was one."""
        before = len(self._crashed)
        self._crashed = {path: one for path, one in self._crashed.items() if one.until > now}
        return len(self._crashed) < before

    def next_expiry(self) -> float | None:
        """When an observer is named no longer, if it does not crash before; None if none is named."""
        return min((one.until for one in self._crashed.values()), default=None)

    def keep(self, vocabulary: Vocabulary) -> None:
        """Forget symptoms that another model has no words for."""
        self._accused = {symptom: names for symptom, names in self._accused.items() if symptom in vocabulary}

    def uncleared(self, diagnosis: Diagnosis, observed: Observed) -> tuple[str, ...]:
        """Who was suspected by symptoms that nobody has seen to have gone, as behind a grace, and is not any more."""
        accused = self._accused | dict.fromkeys(diagnosis.symptoms, diagnosis.suspects)
        self._accused = {symptom: names for symptom, names in accused.items() if not observed.has_gone(symptom)}
        names = set[str]().union(*self._accused.values()) - set(diagnosis.suspects)
        return tuple(name for name in diagnosis.components if name in names)
