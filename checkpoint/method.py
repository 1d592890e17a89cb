"""Recovery methods: what comes back after a crash, as a word in the child spec."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

from ..actors.actor import Actor
from ..actors.errors import SpecError, type_name
from .recovery.settings import (
    SAFE_STATE_TIMEOUT,
    Held,
    RecoveryHooks,
    SafeState,
    as_held,
    as_safe_state,
    check_seconds,
)

Durability = Literal["memory", "os", "fsync"]
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
    safe_state: SafeState | None = None
    safe_state_timeout: float = SAFE_STATE_TIMEOUT
    held: Held | None = None
    held_topics: tuple[tuple[str, Held], ...] = ()
    hooks: RecoveryHooks | None = None

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
            SpecError: the class says it is not deterministic, and this method replays; or it has no such
                binding.
        """
        for port in self.safe_state.to if self.safe_state is not None else ():
            if not port.startswith("/") and port not in kind._bindings:
                raise SpecError(
                    where, f"safe_state: {type_name(kind)} has no binding {port!r}; addresses begin with '/'"
                )
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
    safe_state: str | Sequence[str] | SafeState | None = None,
    safe_state_timeout: float = SAFE_STATE_TIMEOUT,
    held: Held | Mapping[str, Held] | None = None,
    hooks: RecoveryHooks | None = None,
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
        safe_state: who is to be safe while it is recovered: an address, a list of them, the name of a binding of its
            class, or `safe_state(...)` with messages.
        safe_state_timeout: seconds after which a receiver that has not heard of the end raises SafeStateOverdue.
        held: `held(...)`, or a mapping of topics ("*": all else) to that: how many messages are held meanwhile.
        hooks: `recovery_hooks(...)`: what is called before and after the phases, besides those of the system.

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
    if hooks is not None and not isinstance(hooks, RecoveryHooks):
        raise SpecError("hybrid", f"hooks must come from recovery_hooks(...), not be {hooks!r}")
    for_all, by_topic = as_held("hybrid", held)
    return Method(
        "hybrid",
        float(interval),
        max_deliveries,
        journal_limit,
        int(keep),
        on_escalate,
        safe_state=as_safe_state("hybrid", safe_state),
        safe_state_timeout=check_seconds("hybrid", "safe_state_timeout", safe_state_timeout),
        held=for_all,
        held_topics=by_topic,
        hooks=hooks,
    )
