"""Recovery methods: what comes back after a crash, as a word in the child spec."""

from __future__ import annotations

import dataclasses
from typing import Literal

from ..actors.actor import Actor
from ..actors.errors import SpecError, type_name

Durability = Literal["memory", "os", "fsync"]


@dataclasses.dataclass(frozen=True, slots=True)
class Method:
    """How an actor is recovered; made by `fresh` or `hybrid`."""

    name: str
    interval: float = 0.0
    max_deliveries: int = 5
    journal_limit: int = 256_000_000

    @property
    def records(self) -> bool:
        """Whether inputs are journaled and state is saved."""
        return self.name != "fresh"

    def check(self, where: str, kind: type[Actor]) -> None:
        """Refuse what cannot work for this class.

        Raises:
            SpecError: the class says it is not deterministic, and this method replays.
        """
        if self.records and not kind.deterministic:
            raise SpecError(where, f"{type_name(kind)} is not deterministic, so {self.name} cannot replay its messages")


def fresh() -> Method:
    """A new life starts from nothing, as a restarted ROS node does; queued messages are kept."""
    return Method("fresh")


def hybrid(
    interval: float = 2.0,
    *,
    pacing: Literal["fast"] = "fast",
    max_deliveries: int = 5,
    journal_limit: int = 256_000_000,
) -> Method:
    """State comes back from the last snapshot and the messages since: nothing accepted is lost (RORY).

    Args:
        interval: seconds between snapshots, > 0 and finite; only a changed actor is saved.
        pacing: "fast" replays as quickly as the handlers run.
        max_deliveries: process deaths in the turn of one and the same message after which it is quarantined.
        journal_limit: bytes of messages kept since the last snapshot; when it is reached, sends wait or are refused.

    Source:
        Zou and Bai, checkpoint and replay combined.
    """
    if not isinstance(interval, (int, float)) or isinstance(interval, bool) or not 0 < interval < float("inf"):
        raise SpecError("hybrid", f"interval must be seconds > 0, not {interval!r}")
    if pacing != "fast":
        raise SpecError("hybrid", f"pacing must be 'fast', not {pacing!r}")
    if not isinstance(max_deliveries, int) or isinstance(max_deliveries, bool) or max_deliveries < 1:
        raise SpecError("hybrid", f"max_deliveries must be a whole number >= 1, not {max_deliveries!r}")
    if not isinstance(journal_limit, int) or isinstance(journal_limit, bool) or journal_limit < 1:
        raise SpecError("hybrid", f"journal_limit must be bytes > 0, not {journal_limit!r}")
    return Method("hybrid", float(interval), max_deliveries, journal_limit)
