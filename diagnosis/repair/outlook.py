"""A repairer's view of the world: observations, the present diagnosis, and until when each says nothing.

Plain data: whoever owns it gives the time, in seconds on one clock; -inf is a time that never was.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Final

from ...supervision.intensity import admit_restart
from ..engine import Diagnosis, State
from ..literals import Literal, Vocabulary
from ..model import Model
from ..observations import ObservationSet

OURS: Final = 5.0
"""Seconds after an action in which a start that is seen is taken for its work."""


FREE: Final = 3
"""Lives within `WITHIN` seconds after which a start is given no more time."""
WITHIN: Final = 10.0


@dataclasses.dataclass(slots=True)
class Outlook:
    """What is known of the world, apart from any case of repair.

    Attributes:
        diagnosed: when the present diagnosis came.
        graced: until when nobody counts as found bad: what was started has not been seen to work yet.
        looks_until: until when repair only looks.
        ours: when each component was touched by repair.
        lives: when the last lives of each component began.
        theirs: until when each component counts as just started by somebody else.
    """

    observations: ObservationSet
    diagnosis: Diagnosis = dataclasses.field(default_factory=lambda: Diagnosis(State.BLIND))
    diagnosed: float = -math.inf
    graced: float = -math.inf
    looks_until: float = -math.inf
    ours: dict[str, float] = dataclasses.field(default_factory=dict[str, float])
    theirs: dict[str, float] = dataclasses.field(default_factory=dict[str, float])
    lives: dict[str, tuple[float, ...]] = dataclasses.field(default_factory=dict[str, tuple[float, ...]])

    def set_diagnosis(self, diagnosis: Diagnosis, now: float) -> None:
        """Take a new diagnosis for the present one."""
        self.diagnosis, self.diagnosed = diagnosis, now

    def set_vocabulary(self, vocabulary: Vocabulary) -> None:
        """Keep the observations whose atoms another model has, too."""
        old, self.observations = self.observations, ObservationSet(vocabulary)
        for atom in vocabulary:
            for word in old.words(atom):
                self.observations.add(word)

    def seen(self, atom: Literal, now: float) -> tuple[bool | None, float]:
        """Whether an atom holds, None if that is not known; and when it was last observed."""
        words = self.observations.words(atom)
        said = {word.literal.positive for word in words if word.is_current(now)}
        return (said.pop() if len(said) == 1 else None), max((word.time for word in words), default=-math.inf)

    def settles(self, model: Model, now: float) -> float:
        """Until when no plan is made: somebody else has started one who may be faulty, or on whom a symptom depends.

        Whom others ask is no better for a new life of those who ask.
        """
        symptoms, suspects = {one.atom for one in self.diagnosis.symptoms}, set(self.diagnosis.suspects)
        counts = (
            until
            for name, until in self.theirs.items()
            if until > now and (name in suspects or not symptoms.isdisjoint(model.dependents((name,))))
        )
        return max(counts, default=-math.inf)

    def stood(self, now: float) -> float:
        """When the youngest symptom of the present diagnosis began; inf if of one that is not known."""
        began = -math.inf
        for symptom in self.diagnosis.symptoms:
            words = (one for one in self.observations.words(symptom) if one.literal == symptom and one.is_current(now))
            began = max(began, min((one.since for one in words if one.since is not None), default=math.inf))
        return began if self.diagnosis.symptoms else math.inf

    def note_start(self, components: Iterable[str], seconds: float, now: float) -> bool:
        """Somebody has started components, which takes so long; False if it was repair that did.

        Whom somebody else has started is not blamed for what was seen before.
        """
        theirs = [name for name in components if now - self.ours.get(name, -math.inf) > OURS]
        if theirs:
            self.theirs |= dict.fromkeys(theirs, now + seconds)
            self.graced = max(self.graced, now + seconds)
        return bool(theirs)

    def note_life(self, components: Iterable[str], seconds: float, now: float) -> bool:
        """A life of these has begun; False if repair began it, or if it is one of too many to be given time.

        Who is started again and again has a fault that a start does not mend.
        """
        for name in components:
            window = admit_restart(self.lives.get(name, ()), now, intensity=FREE, period=WITHIN)
            if window is None:
                return False
            self.lives[name] = window
        return self.note_start(components, seconds, now)

    def note_touch(self, components: Iterable[str], now: float, grace: float = 0.0) -> None:
        """Repair touches components; for `grace` seconds nobody counts as found bad."""
        self.ours |= dict.fromkeys(components, now)
        if grace > 0:
            self.graced = max(self.graced, now + grace)

    def found_good(self, given_up: Iterable[str], now: float) -> set[str]:
        """Of those that were given up the ones that somebody has repaired; in a grace period nobody is found good."""
        if now < self.graced or not self.diagnosis.is_complete:
            return set()
        return set(given_up) - set(self.diagnosis.suspects)
