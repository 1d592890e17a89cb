"""Settings of failure detection, by which a mechanism has its replicas watched."""

from __future__ import annotations

import dataclasses

from ...actors.errors import SpecError
from ...actors.seconds import check_seconds, is_seconds


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
        for name in ("interval", "spread", "hopeless"):
            check_seconds("Detection", name, getattr(self, name))
        if not is_seconds(self.threshold):  # It counts something else, but is as positive and finite.
            raise SpecError("Detection", f"threshold must be a finite number > 0, not {self.threshold!r}")
        if self.watch_turns is not None:
            check_seconds("Detection", "watch_turns", self.watch_turns)
        check_seconds("Detection", "pause", self.pause, or_zero=True)
