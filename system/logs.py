"""Events as structlog records, with a limit on floods."""

from __future__ import annotations

from collections.abc import Callable

from ..actors.errors import type_name
from ..actors.events import (
    ActorCrashed,
    AutoShutdown,
    ChildRestarted,
    ChildStartFailed,
    DeadLetter,
    Event,
    HeldMessages,
    HookFailed,
    JournalBlocked,
    JournalFull,
    JournalGoesOn,
    JournalStopped,
    LifeAbandoned,
    LogLine,
    MessageQuarantined,
    Moved,
    ProcessDied,
    Recovered,
    RecoveryFailed,
    RecoveryHookFailed,
    RolledBack,
    SafeStateEntered,
    SafeStateKept,
    SafeStateLeft,
    SafeStateMissed,
    SafeStateOverdue,
    ShutdownError,
    SnapshotFailed,
    StoreRefused,
    SupervisorGaveUp,
)
from ..actors.exits import Crash
from ..actors.node import message_of
from .transaction.events import ScriptLoaded, TransactionCommitted, TransactionRolledBack

BURST = 10
"""Records of one kind within a second; what is more is counted and told with the next one."""


class LogSink:
    """Writes what an operator wants to see; formats only what is written."""

    def __init__(self, system: str, clock: Callable[[], float]) -> None:
        import structlog  # only now: it is a third of the time that importing holdfast would take

        self._log = structlog.get_logger("holdfast", system=system)
        self._clock = clock  # the loop's
        self._second: dict[type, tuple[int, int]] = {}

    def __call__(self, event: Event) -> None:
        level = LEVELS.get(type(event))
        if level is None or (isinstance(event, ProcessDied) and event.reason.is_clean):
            return
        left_out = 0 if type(event) is LogLine else self._admit(type(event))
        if left_out is None:
            return
        fields = describe(event)
        if left_out:
            fields["left_out"] = left_out
        getattr(self._log, level)(NAMES[type(event)], **fields)

    def _admit(self, kind: type) -> int | None:
        """None: this second has had its records. Else how many were left out before."""
        second = int(self._clock())
        then, count = self._second.get(kind, (second, 0))
        if then != second:
            self._second[kind] = (second, 1)
            return max(0, count - BURST)
        self._second[kind] = (second, count + 1)
        return 0 if count < BURST else None


LEVELS: dict[type, str] = {
    ActorCrashed: "error",
    HookFailed: "error",
    LifeAbandoned: "error",
    DeadLetter: "warning",
    ChildRestarted: "warning",
    ChildStartFailed: "error",
    ShutdownError: "warning",
    AutoShutdown: "info",
    SupervisorGaveUp: "error",
    ProcessDied: "warning",
    Recovered: "info",
    RecoveryFailed: "error",
    RecoveryHookFailed: "error",
    SafeStateEntered: "warning",
    SafeStateMissed: "error",
    SafeStateLeft: "info",
    SafeStateKept: "error",
    SafeStateOverdue: "error",
    HeldMessages: "warning",
    RolledBack: "error",
    MessageQuarantined: "error",
    SnapshotFailed: "error",
    JournalFull: "warning",
    JournalBlocked: "error",
    JournalGoesOn: "info",
    JournalStopped: "critical",
    StoreRefused: "error",
    LogLine: "info",
    Moved: "info",
    ScriptLoaded: "info",
    TransactionCommitted: "info",
    TransactionRolledBack: "warning",
}
NAMES: dict[type, str] = {
    ActorCrashed: "actor crashed",
    HookFailed: "hook failed",
    LifeAbandoned: "life abandoned",
    DeadLetter: "dead letter",
    ChildRestarted: "child restarted",
    ChildStartFailed: "child not started",
    ShutdownError: "shutdown error",
    AutoShutdown: "auto shutdown",
    SupervisorGaveUp: "supervisor gave up",
    ProcessDied: "process died",
    Recovered: "actor recovered",
    RecoveryFailed: "recovery failed",
    RecoveryHookFailed: "recovery hook failed",
    SafeStateEntered: "safe state entered",
    SafeStateMissed: "safe state missed",
    SafeStateLeft: "safe state left",
    SafeStateKept: "safe state kept",
    SafeStateOverdue: "safe state overdue",
    HeldMessages: "messages held",
    RolledBack: "rolled back",
    MessageQuarantined: "message quarantined",
    SnapshotFailed: "snapshot failed",
    JournalFull: "journal full",
    JournalBlocked: "journal blocked",
    JournalGoesOn: "journal goes on",
    JournalStopped: "journal stopped",
    StoreRefused: "store refused",
    LogLine: "output",
    Moved: "actor moved",
    ScriptLoaded: "code loaded",
    TransactionCommitted: "transaction committed",
    TransactionRolledBack: "transaction rolled back",
}


def describe(event: Event) -> dict[str, object]:
    """An event's fields as text and numbers."""
    fields: dict[str, object] = {}
    for name in event.__struct_fields__:
        value = getattr(event, name)
        if name in ("item", "message") and not isinstance(value, str):
            message = message_of(value)
            fields["message"] = type_name(type(value if message is None else message))
        elif isinstance(value, Crash):
            fields[name] = str(value)
            fields["traceback"] = value.traceback
        elif isinstance(value, (int, float, dict)):
            fields[name] = value
        else:
            fields[name] = str(value)
    return fields
