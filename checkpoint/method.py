"""Recovery methods: what comes back after a crash, as a word in the child spec."""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

from ..actors.actor import Actor
from ..actors.errors import SpecError, type_name

Durability = Literal["memory", "os", "fsync"]
Rules = tuple[bool, bool]
"""What a method asks of a life, besides snapshots: whether it is strict, and whether its replay is checked."""
OnEscalate = Literal["restore", "older_snapshot", "fresh"]


@dataclasses.dataclass(frozen=True, slots=True)
class Method:
    """How an actor is recovered; made by `fresh` or `hybrid`."""

    name: str
    interval: float = 0.0
    max_deliveries: int = 5
    journal_limit: int = 256_000_000
    keep: int = 2
    on_escalate: OnEscalate | None = None
    durability: Durability | None = None
    strict: bool = False
    check_replay: bool = False

    @property
    def rules(self) -> Rules:
        """What it asks of a life, besides snapshots."""
        return self.strict, self.check_replay

    def after_escalation(self, times: int) -> OnEscalate:
        """How an actor comes back whose supervisor has ended because of it for the `times`-th time in the window.

        >>> [hybrid().after_escalation(times) for times in (1, 2, 3)]
        ['restore', 'older_snapshot', 'restore']
        """
        if self.on_escalate is not None:
            return self.on_escalate
        return "older_snapshot" if times == 2 else "restore"

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
    keep: int = 2,
    on_escalate: OnEscalate | None = None,
    durability: Durability | None = None,
    strict: bool = False,
    check_replay: bool = False,
) -> Method:
    """State comes back from the last snapshot and the messages since: nothing accepted is lost (RORY).

    Args:
        interval: seconds between snapshots, > 0 and finite; only a changed actor is saved.
        pacing: "fast" replays as quickly as the handlers run.
        max_deliveries: process deaths in the turn of one and the same message after which it is quarantined.
        journal_limit: bytes of messages kept since the last snapshot; when it is reached, sends wait or are refused.
        keep: snapshots that are kept: 2, or 1 to save the memory or disk of the older one.
        on_escalate: what happens when its supervisor has ended because of it and was restarted: "restore" what there
            is; go back to the "older_snapshot", without the turns since; begin "fresh". In all cases what has not been
            handled stays queued. Left out: an older snapshot the second time within the window of whoever restarted
            the supervisor, else restore.
        durability: what an admission, and with it a reply, outlives when it is told of: "memory" any process but the
            root, "os" the root too, "fsync" the machine. The last two need a store, whose own setting is the default.

        strict: a turn that calls the clock, chance or a background task of the world instead of its `ctx` raises
            NotDeterministic at that call. It makes handlers several times slower: for tests and for the search.
        check_replay: the state after each turn gets a digest, and a replay that leaves another one is stopped with the
            number of the first such turn and its message. Costs a pass over the state per turn: for tests, too.

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
    if keep not in (1, 2) or isinstance(keep, bool):
        raise SpecError("hybrid", f"keep must be 1 or 2, not {keep!r}")
    if on_escalate is not None and on_escalate not in get_args(OnEscalate):
        known = ", ".join(map(repr, get_args(OnEscalate)))
        raise SpecError("hybrid", f"on_escalate must be one of {known} or left out, not {on_escalate!r}")
    if durability is not None and durability not in get_args(Durability):
        known = ", ".join(map(repr, get_args(Durability)))
        raise SpecError("hybrid", f"durability must be one of {known} or left out, not {durability!r}")
    for name, value in (("strict", strict), ("check_replay", check_replay)):
        if not isinstance(value, bool):
            raise SpecError("hybrid", f"{name} must be True or False, not {value!r}")
    return Method(
        "hybrid", float(interval), max_deliveries, journal_limit, int(keep), on_escalate, durability,
        strict, check_replay,
    )  # fmt: skip
