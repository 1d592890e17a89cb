"""Recovery methods: what comes back after a crash, as a word in the child spec."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import msgspec

from ..actors.errors import SpecError, type_name
from ..actors.kernel.actor import Actor
from ..actors.seconds import check_seconds
from .encoding.compression import check_compress
from .recovery_settings import (
    NOTHING_MEANWHILE,
    SAFE_STATE_TIMEOUT,
    Held,
    Meanwhile,
    RecoveryHooks,
    SafeState,
    meanwhile,
)

Durability = Literal["memory", "os", "fsync"]
OnEscalate = Literal["restore", "older_snapshot", "fresh"]
Pacing = Literal["fast", "original"] | float
JOURNAL_LIMIT = 256_000_000
HUNG_DELIVERIES = 2
"""Turns of one message, in a row, that did not end, after which it is the message, and not who handles it."""
WITH_SNAPSHOTS = ("hybrid", "checkpoint_only")
"""Names of the methods that save the state now and then."""
OF_LIVES = ("name", "interval", "check_readonly", "key_variables", "origin", "strict", "check_replay")
"""The settings that concern a life, not its home."""


@dataclasses.dataclass(frozen=True, slots=True)
class Method:
    """A recovery method; made by `fresh`, `checkpoint_only`, `replay_only` or `hybrid`, or by a recovery file.

    `key_variables` are those that a recovery file names, and `origin` is where it does; else the class says.
    """

    name: str
    interval: float = 0.0
    max_deliveries: int = 3
    journal_limit: int = JOURNAL_LIMIT
    keep: int = 2
    on_escalate: OnEscalate = "restore"
    pacing: Pacing = "fast"
    skip: bool = True
    check_readonly: bool = False
    key_variables: tuple[str, ...] | None = None
    origin: str = ""
    meanwhile: Meanwhile = NOTHING_MEANWHILE
    every: int | None = None
    journal_bytes: int | None = None
    compress: bool | int = False
    durability: Durability | None = None
    strict: bool = False
    check_replay: bool = False

    def __post_init__(self) -> None:
        """Raises SpecError: naming the method, the setting, and what it may be."""
        where = self.name
        if self.snapshots:
            check_seconds(where, "interval", self.interval)
        if self.pacing not in ("fast", "original") and (
            not _number(self.pacing) or not 0 < float(self.pacing) < float("inf")
        ):
            raise SpecError(where, f"pacing must be 'fast', 'original' or a factor > 0, not {self.pacing!r}")
        if not _whole(self.max_deliveries) or self.max_deliveries < 1:
            raise SpecError(where, f"max_deliveries must be a whole number >= 1, not {self.max_deliveries!r}")
        if not _whole(self.journal_limit) or self.journal_limit < 1:
            raise SpecError(where, f"journal_limit must be bytes > 0, not {self.journal_limit!r}")
        if not _whole(self.keep) or not 1 <= self.keep <= 100:
            raise SpecError(where, f"keep must be a whole number from 1 to 100, not {self.keep!r}")
        for name, value in (("every", self.every), ("journal_bytes", self.journal_bytes)):
            if value is not None and (not _whole(value) or value < 1):
                raise SpecError(where, f"{name} must be a whole number >= 1 or left out, not {value!r}")
        check_compress(where, self.compress)
        if self.on_escalate not in get_args(OnEscalate):
            known = ", ".join(map(repr, get_args(OnEscalate)))
            raise SpecError(where, f"on_escalate must be one of {known}, not {self.on_escalate!r}")
        if self.durability is not None and self.durability not in get_args(Durability):
            known = ", ".join(map(repr, get_args(Durability)))
            raise SpecError(where, f"durability must be one of {known} or left out, not {self.durability!r}")
        flags = {"skip": self.skip, "check_readonly": self.check_readonly, "strict": self.strict}
        for name, flag in {**flags, "check_replay": self.check_replay}.items():
            if not isinstance(flag, bool):
                raise SpecError(where, f"{name} must be True or False, not {flag!r}")

    @property
    def trigger(self) -> int:
        """Bytes of journal at which something has to be done."""
        return min(self.journal_limit, self.journal_bytes or self.journal_limit)

    def most_deliveries(self, *, has_hung: bool) -> int:
        """Ends in the turn of one message after which it is put aside; `has_hung`: the last turn did not end."""
        return min(HUNG_DELIVERIES, self.max_deliveries) if has_hung else self.max_deliveries

    @property
    def records(self) -> bool:
        """Say whether inputs are journaled, and something comes back."""
        return self.name != "fresh"

    @property
    def snapshots(self) -> bool:
        """Say whether the state is saved now and then."""
        return self.name in WITH_SNAPSHOTS

    @property
    def replays(self) -> bool:
        """Say whether what was handled since the last snapshot is handled again."""
        return self.name in ("hybrid", "replay_only")

    @property
    def speed(self) -> float:
        """Return how many times faster than they came replayed inputs are fed; 0: without waiting at all."""
        if self.pacing == "fast":
            return 0.0
        return 1.0 if self.pacing == "original" else float(self.pacing)

    def data(self) -> dict[str, Any]:
        """Return as plain data what a life in another process has to know of the method."""
        return {name: msgspec.to_builtins(getattr(self, name)) for name in OF_LIVES}

    @classmethod
    def of(cls, data: dict[str, Any]) -> Method:
        """Make the method again from its data, as far as a life has to know it."""
        return msgspec.convert(data, cls)

    def check(self, where: str, kind: type[Actor]) -> None:
        """Refuse what cannot work for this class.

        Raises:
            SpecError: the class says it is not deterministic, and this method replays; or it has no such
                binding.
        """
        state = self.meanwhile.safe_state
        for port in state.to if state is not None else ():
            if not port.startswith("/") and port not in kind._bindings:
                raise SpecError(
                    where, f"safe_state: {type_name(kind)} has no binding {port!r}; addresses begin with '/'"
                )
        if self.replays and not kind.deterministic:
            raise SpecError(
                where,
                f"{type_name(kind)} is not deterministic, so {self.name} cannot replay its messages; "
                "use checkpoint_only or fresh",
            )


def fresh() -> Method:
    """Start a new life from nothing, as a restarted ROS node does; queued messages are kept."""
    return Method("fresh")


def checkpoint_only(
    interval: float = 2.0,
    *,
    max_deliveries: int = 3,
    journal_limit: int = JOURNAL_LIMIT,
    keep: int = 2,
    on_escalate: OnEscalate = "restore",
    every: int | None = None,
    journal_bytes: int | None = None,
    compress: bool | int = False,
    durability: Durability | None = None,
    safe_state: str | Sequence[str] | SafeState | None = None,
    safe_state_timeout: float = SAFE_STATE_TIMEOUT,
    held: Held | Mapping[str, Held] | None = None,
    hooks: RecoveryHooks | None = None,
) -> Method:
    """State comes back from the last snapshot alone; what was handled since is lost from it (`TurnsLost` counts it).

    Nothing is replayed, so the class need not be deterministic. What was not handled stays queued. The turn that the
    crash interrupted begins anew, unless it has let something out already: then it ends with that, and who asked gets
    AskFailed. The arguments are those of `hybrid`.

    Source:
        Zou and Bai, the first of the two methods they compare theirs with.
    """
    return Method(
        "checkpoint_only",
        interval,
        max_deliveries,
        journal_limit,
        keep,
        on_escalate,
        every=every,
        journal_bytes=journal_bytes,
        compress=compress,
        durability=durability,
        meanwhile=meanwhile("checkpoint_only", safe_state, safe_state_timeout, held, hooks),
    )


def replay_only(
    *,
    pacing: Pacing = "fast",
    max_deliveries: int = 3,
    journal_limit: int = JOURNAL_LIMIT,
    on_escalate: OnEscalate = "restore",
    skip: bool = True,
    check_readonly: bool = False,
    durability: Durability | None = None,
    strict: bool = False,
    check_replay: bool = False,
    safe_state: str | Sequence[str] | SafeState | None = None,
    safe_state_timeout: float = SAFE_STATE_TIMEOUT,
    held: Held | Mapping[str, Held] | None = None,
    hooks: RecoveryHooks | None = None,
) -> Method:
    """State comes back by handling everything again since the very first start; no snapshot is ever taken.

    So a recovery takes as long as the actor has worked, and the journal only grows: at `journal_limit` nothing is
    admitted any more (`JournalFull` says so). The arguments are those of `hybrid`.

    Source:
        Zou and Bai, the second of the two methods they compare theirs with.
    """
    return Method(
        "replay_only",
        max_deliveries=max_deliveries,
        journal_limit=journal_limit,
        on_escalate=on_escalate,
        pacing=pacing,
        skip=skip,
        check_readonly=check_readonly,
        durability=durability,
        strict=strict,
        check_replay=check_replay,
        meanwhile=meanwhile("replay_only", safe_state, safe_state_timeout, held, hooks),
    )


def hybrid(
    interval: float = 2.0,
    *,
    pacing: Pacing = "fast",
    max_deliveries: int = 3,
    journal_limit: int = JOURNAL_LIMIT,
    keep: int = 2,
    on_escalate: OnEscalate = "restore",
    skip: bool = True,
    check_readonly: bool = False,
    safe_state: str | Sequence[str] | SafeState | None = None,
    safe_state_timeout: float = SAFE_STATE_TIMEOUT,
    held: Held | Mapping[str, Held] | None = None,
    hooks: RecoveryHooks | None = None,
    every: int | None = None,
    journal_bytes: int | None = None,
    compress: bool | int = False,
    durability: Durability | None = None,
    strict: bool = False,
    check_replay: bool = False,
) -> Method:
    """State comes back from the last snapshot and the messages since: nothing accepted is lost (RORY).

    Args:
        interval: seconds between snapshots, > 0 and finite; only a changed actor is saved.
        pacing: "fast" replays as quickly as the handlers run; "original" waits between messages as long as there was
            between them when they came; a number is a speed-up, 2.0 waits half as long. New messages are held
            meanwhile: at 1.0 or below, an actor that gets more than it can handle never catches up.
        max_deliveries: deaths and kills in the turn of one message, in a row and without progress, after which it is
            quarantined. A new outcome of an ask, an effect or a long wait is progress; an end that a supervisor has
            ordered does not count, nor does the death of a process while the turn merely waits.
        journal_limit: bytes of messages kept since the last snapshot; when it is reached, sends wait or are refused.
        keep: snapshots that are kept in a store that lasts, newest first; 1 saves the memory or disk of the older one.
            In memory two are kept at most.
        on_escalate: what happens when its supervisor has ended because of it and was restarted: "restore" what there
            is; go back to the "older_snapshot", without the turns since; begin "fresh". In all cases what has not been
            handled stays queued. All but "restore" lose what was acknowledged since.
        skip: leave out of the replay what changes nothing: messages of `@on(readonly=True)`, and of
            `@on(supersedes=...)` those that a later one has made useless.
        check_readonly: end the life (NotReadonly) when a handler that is declared readonly changes the state. This
            saves the state twice for each of its turns: for tests and for finding faults.
        safe_state: who is to be safe while it is recovered: an address, a list of them, the name of a binding of its
            class, or `safe_state(...)` with messages.
        safe_state_timeout: seconds after which a receiver that has not heard of the end raises SafeStateOverdue.
        held: `held(...)`, or a mapping of topics ("*": all else) to that: how many messages are held meanwhile.
        hooks: `recovery_hooks(...)`: what is called before and after the phases, besides those of the system.
        every: a snapshot also after so many handled messages, whatever the time.
        journal_bytes: a snapshot also when so many bytes of messages have been journaled since the last one.
        compress: True, or a level from 1 to 22: what goes to a store is compressed, with the library zstandard.
        durability: what an admission, and with it a reply, outlives when it is told of: "memory" any process but the
            root, "os" the root too, "fsync" the machine. The last two need a store, whose own setting is the default.
        strict: a turn that calls the clock, chance or a background task of the world instead of its `ctx` raises
            NotDeterministic at that call. It makes handlers several times slower: for tests and for the search.
        check_replay: the state after each turn gets a digest, and a replay that leaves another one is stopped with the
            number of the first such turn and its message. Costs a pass over the state per turn, and nothing is
            left out of the replay: for tests, too.

    Source:
        Zou and Bai, checkpoint and replay combined.
    """
    return Method(
        "hybrid",
        interval,
        max_deliveries,
        journal_limit,
        keep,
        on_escalate,
        pacing=pacing,
        skip=skip,
        check_readonly=check_readonly,
        every=every,
        journal_bytes=journal_bytes,
        compress=compress,
        durability=durability,
        strict=strict,
        check_replay=check_replay,
        meanwhile=meanwhile("hybrid", safe_state, safe_state_timeout, held, hooks),
    )


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
