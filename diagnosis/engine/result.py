"""The result of a diagnosis: messages for `/diagnosis`, and the same for ROS diagnostics."""

from __future__ import annotations

import enum
import time
from typing import Any, Final, TypeAlias

import msgspec

from ...actors.kernel.message import Message
from ..literals import Literal
from ..observations import Contradiction

Plain: TypeAlias = dict[str, Any]
"""A message of another system, as plain data."""


MOST_NAMES: Final = 5
"""Unknown components that are named in a text."""


class State(enum.Enum):
    """The four ways in which a system may look by a diagnosis."""

    HEALTHY = "healthy"
    FAULTY = "faulty"
    CONTRADICTORY = "contradictory"
    """The observations cannot all be true, and the rest shows no fault: no repair may start."""
    BLIND = "blind"
    """Nothing is observed: nothing is known, and no repair may start."""


class Candidate(Message, gc=False):
    """One minimal diagnosis: what is faulty. Everything else works (`Diagnosis.good`)."""

    bad: tuple[str, ...]
    probability: float = 1.0
    """Among the candidates that are listed, by the priors alone."""


class Diagnosis(Message):
    """All minimal diagnoses within the limits, best first; what observers and repair act on.

    If "time" or "contested" is in `truncated`, candidates are what is known so far: of the rest nothing is in any.
    """

    state: State
    components: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    symptoms: tuple[Literal, ...] = ()
    """Literals that contradict "all components work"."""
    contradictions: tuple[Contradiction, ...] = ()
    found: int = 0
    """Minimal diagnoses that were found; `candidates` may hold fewer."""
    truncated: tuple[str, ...] = ()
    """"count", "time" and "contested" (sources contradict each other on a suspect): what kept further ones from being
    listed; empty if these are all."""
    version: int = 1
    """Of the model."""
    seconds: float = 0.0
    convicted: tuple[str, ...] = ()
    """Components that are faulty whatever else is: known even where `truncated` says that candidates are missing."""
    unknown: tuple[str, ...] = ()
    """Components of whose work nothing is seen at the moment, or not what is expected of them, or that are `uncleared`:
    that they are healthy is not said."""
    set_aside: tuple[str, ...] = ()
    """Sources of observations that are not believed, because they contradict several others that agree."""
    uncleared: tuple[str, ...] = ()
    """Those of `unknown` that were suspected by symptoms that nobody has seen to have gone, as in a grace."""
    crashed_observers: dict[str, str] = msgspec.field(default_factory=dict)
    """Observers that have crashed within the last minute, each with the reason: what they look at may not be seen."""
    since: dict[str, float] = msgspec.field(default_factory=dict)
    """Since when each suspect has been one without a break, in Unix seconds."""
    known_until: dict[str, float] = msgspec.field(default_factory=dict)
    """Until when something was known of those that are unknown, in Unix seconds; who never was known is left out."""

    def __str__(self) -> str:
        """In words: `faulty: ja, or jn`."""
        crashed = (f"; observer {path} has crashed: {why}" for path, why in self.crashed_observers.items())
        return "".join((self._found(), *crashed))

    def _found(self) -> str:
        words = ", or ".join(" and ".join(one.bad) for one in self.candidates if one.bad)
        more = f", or others ({' and '.join(self.truncated)} ran out)" if self.truncated else ""
        if words:
            return f"{self.state.value}: {words}{more}"
        if self.state is State.FAULTY:
            return f"{self.state.value}: no candidate yet ({' and '.join(self.truncated)} ran out)"
        is_partly = self.state is State.HEALTHY and self.unknown
        some = f", as far as is known: {len(self.unknown)} unknown ({self.unknown_in_words()})" if is_partly else ""
        return f"{self.state.value}{some}"

    def unknown_in_words(self) -> str:
        """Name a few that are unknown, and until when each was not, in local time: who was known last first."""
        latest = sorted(self.unknown, key=lambda name: -self.known_until.get(name, 0.0))
        said = [f"{name} {self._known_until(name)}" for name in latest[:MOST_NAMES]]
        more = len(latest) - len(said)
        return ", ".join([*said, f"and {more} more"] if more else said)

    def _known_until(self, name: str) -> str:
        until = self.known_until.get(name)
        if until is None:
            return "never seen"
        return f"known until {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(until))}"

    @property
    def is_complete(self) -> bool:
        """No minimal diagnosis is missing."""
        return not self.truncated and self.state in (State.HEALTHY, State.FAULTY)

    @property
    def suspects(self) -> tuple[str, ...]:
        """Every component that is faulty in a candidate, those of better candidates first."""
        return tuple(dict.fromkeys(name for candidate in self.candidates for name in candidate.bad))

    @property
    def certain(self) -> tuple[str, ...]:
        """The components that are faulty in each diagnosis; while candidates are missing, those that are convicted."""
        shared = set(self.convicted)
        if self.is_complete and self.candidates:
            shared |= set.intersection(*(set(candidate.bad) for candidate in self.candidates))
        return tuple(name for name in self.components if name in shared)

    def good(self, candidate: Candidate) -> tuple[str, ...]:
        """Return all components that work if `candidate` is right: good and bad together are all (D32)."""
        bad = set(candidate.bad)
        return tuple(name for name in self.components if name not in bad)

    def sets(self) -> list[Plain]:
        """Each candidate as its set of bad and its set of good components, in plain data."""
        return [{"bad": list(one.bad), "good": list(self.good(one))} for one in self.candidates]

    def ros(self, stamp: float) -> Plain:
        """Make a `diagnostic_msgs/DiagnosticArray`: error if surely faulty, warning if perhaps, stale if unknown (D33).

        Args:
            stamp: seconds since 1970.
        """
        certain, suspects = set(self.certain), set(self.suspects)
        is_known, unknown = self.state in (State.HEALTHY, State.FAULTY), set(self.unknown)
        nanoseconds = round(stamp * 1e9)
        return {
            "header": {"stamp": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}, "frame_id": ""},
            "status": [
                self._status(name, is_known, name in certain, name in suspects, name in unknown)
                for name in self.components
            ],
        }

    def _status(self, name: str, is_known: bool, is_certain: bool, is_suspect: bool, is_unseen: bool) -> Plain:
        if not is_known:
            level, message = 3, f"unknown: the observations are {self.state.value}"
        elif is_certain:
            level, message = 2, "faulty"
        elif is_suspect:
            level, message = 1, "perhaps faulty"
        elif is_unseen:
            level, message = 3, "unknown: nothing is seen of its work"
        else:
            level, message = 0, "works"
        chance = sum(one.probability for one in self.candidates if name in one.bad) if is_suspect else 0.0
        values = [{"key": "probability", "value": f"{chance:.3f}"}] if is_suspect else []
        return {"level": level, "name": name, "message": message, "hardware_id": name, "values": values}
