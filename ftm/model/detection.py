"""Settings of failure detection, by which a mechanism has its replicas watched."""

from __future__ import annotations

import dataclasses
import math

from ...actors.errors import SpecError


@dataclasses.dataclass(frozen=True, slots=True)
class Detection:
    """Settings by which replicas are watched.

    Args:
        interval: seconds between two heartbeats.
        threshold: phi from which on a replica is suspected: 8 is one wrong suspicion in 10^8 looks, if delays vary as
            they did before.
        pause: seconds of silence that are always acceptable, besides what the heartbeats so far let expect.
        spread: the least standard deviation that is reckoned with, in seconds.
        hopeless: seconds after which even a replica is given up that nobody could take over from.
        watch_turns: seconds that a turn may take, what it waits for included; None: as many as it wants.
    """

    interval: float = 0.05
    threshold: float = 8.0
    pause: float = 0.5
    spread: float = 0.01
    hopeless: float = 10.0
    watch_turns: float | None = None

    def __post_init__(self) -> None:
        for name in ("interval", "threshold", "spread", "hopeless"):
            value = getattr(self, name)
            if not _number(value) or not 0 < value < math.inf:
                raise SpecError("Detection", f"{name} must be a finite number > 0, not {value!r}")
        turns = self.watch_turns
        if turns is not None and (not _number(turns) or not 0 < turns < math.inf):
            raise SpecError("Detection", f"watch_turns must be seconds > 0 or None, not {turns!r}")
        if not _number(self.pause) or not 0 <= self.pause < math.inf:
            raise SpecError("Detection", f"pause must be seconds >= 0, not {self.pause!r}")


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
