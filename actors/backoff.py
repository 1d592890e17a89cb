"""Back-off: how long to wait before a child is started again."""

from __future__ import annotations

import dataclasses
import math
import random

from .errors import SpecError


@dataclasses.dataclass(frozen=True, slots=True)
class Backoff:
    """Exponential back-off with jitter, for a child spec.

    Attributes:
        initial: seconds before the first restart, >= 0.
        maximum: seconds at most, >= initial.
        factor: growth per restart, >= 1.
        jitter: each delay is lengthened by a random part of up to this share of it, 0 to 1.
        reset_after: seconds of healthy life after which the count starts anew.
    """

    initial: float = 0.05
    maximum: float = 5.0
    factor: float = 2.0
    jitter: float = 0.2
    reset_after: float = 10.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
                raise SpecError("Backoff", f"{field.name} must be a finite number, not {value!r}")
        if not 0 <= self.initial <= self.maximum:
            raise SpecError("Backoff", f"0 <= initial <= maximum must hold, not {self.initial!r}, {self.maximum!r}")
        if not self.factor >= 1:
            raise SpecError("Backoff", f"factor must be >= 1, not {self.factor!r}")
        if not 0 <= self.jitter <= 1:
            raise SpecError("Backoff", f"jitter must be between 0 and 1, not {self.jitter!r}")
        if not self.reset_after >= 0:
            raise SpecError("Backoff", f"reset_after must be >= 0 seconds, not {self.reset_after!r}")

    def delay(self, attempt: int, rng: random.Random) -> float:
        """Seconds before restart number `attempt` (from 0) of a row without a healthy life between.

        >>> Backoff(initial=0.1, jitter=0.0).delay(3, random.Random(0))
        0.8
        """
        try:
            grown = self.initial * self.factor**attempt
        except OverflowError:
            grown = self.maximum if self.initial else 0.0
        return min(self.maximum, grown) * (1.0 + rng.random() * self.jitter)
