"""Writes events as log records: one for each crash, with a limit on floods."""

from __future__ import annotations

import asyncio
import logging
import math
import sys
from typing import Any

from ...actors.control.trace_tail import tail_of
from ...actors.errors import portable
from ...actors.events import (
    ActorCrashed,
    AutoShutdown,
    BindingAwaited,
    ChildRestarted,
    ChildStartFailed,
    ChildTerminated,
    ConnectionLimited,
    DeadLetter,
    Event,
    HeldMessages,
    HelperStuck,
    HookFailed,
    JournalBlocked,
    JournalFull,
    JournalGoesOn,
    JournalStopped,
    KeptForSystem,
    LeadershipTaken,
    LifeAbandoned,
    LogLine,
    LoopLagged,
    MessageQuarantined,
    Moved,
    OrderHeld,
    ProcessDied,
    RecordsMapped,
    Recovered,
    RecoveryFailed,
    RecoveryHookFailed,
    RecoveryTableUnused,
    RolledBack,
    SafeStateEntered,
    SafeStateKept,
    SafeStateLeft,
    SafeStateMissed,
    SafeStateOverdue,
    ServersAnswer,
    ServersSilent,
    ShutdownError,
    SnapshotDamaged,
    SnapshotFailed,
    StandingBy,
    StopOverdue,
    StopWaits,
    StoreRefused,
    SupervisorGaveUp,
    TrustBreached,
    TurnsLost,
    TurnSlow,
    TurnWaits,
)
from ...actors.exit_reasons import Crash
from ...actors.kernel.envelope import Item, item_name
from ...actors.kernel.message import Message, MessageText, message_of
from ...ftm.alarms import (
    Diverged,
    Masked,
    NondeterminismFound,
    Objected,
    Outvoted,
    ProtectionCostly,
    ProtectionLost,
    RequestsDropped,
    StatesDiffer,
)
from ...ftm.events import (
    BackgroundWorkLost,
    FailedOver,
    MechanismSettled,
    ReplicaFaulty,
    ReplicaJoined,
    ReplicaLost,
    TurnHung,
)
from ..history.writer import HistoryNotKept
from ..last_lines.line_memory import LineLevel, LineMemory
from ..mechanism_notes import AdaptationUndone
from ..specification import SpecificationNotKept
from ..transaction.events import ScriptLoaded, TransactionCommitted, TransactionRolledBack
from .log_recoveries import LogRecoveries

BURST = 10
"""Records of one kind within a second; what is more is counted and told with the next one."""
LETTERS_EVERY = 10.0
"""Seconds between two records of dead letters that are alike: a mailbox that drops by its policy does so all day."""
MOST_LETTERS = 1_000
"""Sorts of dead letters that are remembered for that."""
WAIT = 1.0
"""Seconds after a crash in which its supervisor is expected to say what it knows of it."""

SHOWN = {code: f"\\x{code:02x}" for code in (*range(9), *range(11, 32), *range(127, 160))}
"""Control characters as they are shown: the text of an error is written to terminals, and may not steer them."""
LOGGER = "holdfast"
"""The name of the logger."""
LEVEL_NAMES: dict[int, LineLevel] = {
    logging.DEBUG: "debug",
    logging.INFO: "info",
    logging.WARNING: "warning",
    logging.ERROR: "error",
    logging.CRITICAL: "critical",
}
TOLD_APART = frozenset({"address", "life", "system"})
"""Fields of a record that a line which is kept has beside its text."""

Fields = dict[str, Any]


class LogSink:
    """Writes what an operator wants to see; formats only what is written.

    A crash is told by several events: the actor's, that of its process, and its supervisor's; a recovery that fails by
    its own and its supervisor's. The record waits for the last of them, at most `WAIT` seconds. Of actors that recover
    together there is one record.

    Args:
        system: the system's name.
        log_payloads: write what was in the message that an actor has crashed in, too.
        lines: keeps what is written, but for the output of processes; None: nothing does.
    """

    def __init__(
        self,
        system: str,
        loop: asyncio.AbstractEventLoop,
        *,
        log_payloads: bool = False,
        lines: LineMemory | None = None,
    ) -> None:
        self._system, self._loop, self._log_payloads = system, loop, log_payloads
        self._lines = lines
        self._second: dict[type, tuple[int, int]] = {}
        self._crashes: dict[str, tuple[Event, asyncio.TimerHandle]] = {}  # by address: what waits for its supervisor
        self._recoveries = LogRecoveries(loop, self._write_recovered)
        self._letters: dict[tuple[str, type, str], tuple[float, int]] = {}  # when one was told, and how many not since

    def __call__(self, event: Event) -> None:
        match event:
            case ActorCrashed():
                self._hold(event)
            case ProcessDied(reason=reason, asked=asked):
                if not reason.is_clean and not asked and not self._is_told_by_crash(event):
                    self._hold(event)
            case ChildTerminated():
                self._write(self._crash_at(event.address) or event, restarts=event.restarts, allowed=event.allowed)
            case RecoveryFailed():
                if event.address not in self._crashes:
                    self._hold(event)
                elif not self._is_told_by_crash(event):
                    self._write(event)
            case ChildStartFailed():
                self._write_start(event, self._crash_at(event.address))
            case DeadLetter():
                self._write_letter(event)
            case LogLine():
                if event.is_logged:
                    self._write(event)
            case ChildRestarted():
                self._recoveries.restarted(event.address)
            case Recovered():
                self._recoveries.add(event)
            case _ if type(event) in WRITTEN:
                self._write(event)
            case _:
                pass

    def close(self) -> None:
        """Write the events that still wait."""
        for address in list(self._crashes):
            self._release(address)
        self._recoveries.close()

    # -- crashes ----------------------------------------------------------------------------------------------------

    def _hold(self, event: Event) -> None:
        """Wait for the supervisor's word."""
        self._release(event.address)
        self._crashes[event.address] = event, self._loop.call_later(WAIT, self._release, event.address)

    def _is_told_by_crash(self, event: ProcessDied | RecoveryFailed) -> bool:
        """Whether the process died, or the recovery failed, of the crash that we know already."""
        held, _ = self._crashes.get(event.address, (None, None))
        return isinstance(held, ActorCrashed) and str(held.reason) in str(event.reason)

    def _crash_at(self, address: str) -> Event | None:
        """The crash that waits, which need not do so any longer."""
        event, timer = self._crashes.pop(address, (None, None))
        if timer is not None:
            timer.cancel()
        return event

    def _release(self, address: str) -> None:
        """The supervisor has not said anything: there is none, or it ends itself."""
        crash = self._crash_at(address)
        if crash is not None:
            self._write(crash)

    # -- dead letters -----------------------------------------------------------------------------------------------

    def _write_letter(self, letter: DeadLetter) -> None:
        """Tell of the first of those that are alike, and then once in a while how many there have been (`alike`)."""
        now, sort = self._loop.time(), (letter.address, type(letter.message), letter.why)
        told, left_out = self._letters.get(sort, (-math.inf, 0))
        if now - told < LETTERS_EVERY:
            self._letters[sort] = told, left_out + 1
            return
        if len(self._letters) >= MOST_LETTERS:
            self._letters.clear()
        self._letters[sort] = now, 0
        if left_out:
            self._write(letter, alike=left_out)
        else:
            self._write(letter)

    def _write_start(self, event: ChildStartFailed, crash: Event | None) -> None:
        """A start has failed; of a recovery that has failed for the same reason there is one record."""
        if isinstance(crash, RecoveryFailed):
            self._write(crash)
            if event.reason in crash.reason:
                return
            crash = None
        described = {} if crash is None else self._describe(crash)
        self._write(event, **{**described, "reason": event.reason})  # A process that is of no use is killed.

    # -- recoveries -------------------------------------------------------------------------------------------------

    def _write_recovered(self, above: str, recovered: list[Recovered]) -> None:
        """Tell of what has recovered below an address."""
        if len(recovered) == 1:
            self._write(recovered[0])
            return
        slowest = max(recovered, key=_seconds)
        fields: Fields = {
            "address": above,
            "actors": len(recovered),
            "replayed": sum(one.replayed for one in recovered),
            "slowest": slowest.address,
            "seconds": round(_seconds(slowest), 6),
        }
        self._record(Recovered, "actors recovered", fields)

    # -- records ----------------------------------------------------------------------------------------------------

    def _write(self, event: Event, **more: object) -> None:
        kind = type(event)
        self._record(kind, WRITTEN[kind][1], {**self._describe(event), **more})

    def _record(self, kind: type[Event], name: str, said: Fields) -> None:
        left_out = 0 if kind is LogLine else self._admit(kind)
        if left_out is None:
            return
        level, fields = WRITTEN[kind][0], {**said, "system": self._system}
        if said.get("problems"):  # of a transaction that has come into force
            level = logging.WARNING
        fields.pop("is_logged", None)
        if kind is not LogLine:  # What a program prints is its own affair.
            fields = {key: one.translate(SHOWN) if isinstance(one, str) else one for key, one in fields.items()}
        if left_out:
            fields["left_out"] = left_out
        if self._lines is not None and kind is not LogLine:
            own = {key: one for key, one in fields.items() if key not in TOLD_APART}
            life = fields.get("life", 0)
            self._lines.add(fields["address"], "holdfast", LEVEL_NAMES[level], record_text(name, own), int(life))
        structlog = _structlog()
        if structlog is None:
            _write_standard(level, name, fields)
        else:
            logger = structlog.get_logger(LOGGER)
            if not structlog.is_configured():  # Its own default would mix with what the program prints.
                logger = structlog.wrap_logger(structlog.PrintLogger(sys.stderr))
            logger.log(level, name, **fields)

    def _describe(self, event: Event) -> Fields:
        return describe(event, payloads=self._log_payloads)

    def _admit(self, kind: type) -> int | None:
        """None: this second has had its records. Else how many were left out before."""
        second = int(self._loop.time())
        then, count = self._second.get(kind, (second, 0))
        if then != second:
            self._second[kind] = (second, 1)
            return max(0, count - BURST)
        self._second[kind] = (second, count + 1)
        return 0 if count < BURST else None


WRITTEN: dict[type, tuple[int, str]] = {
    ActorCrashed: (logging.ERROR, "actor crashed"),
    ChildTerminated: (logging.WARNING, "child ended"),
    HookFailed: (logging.ERROR, "hook failed"),
    LifeAbandoned: (logging.ERROR, "life abandoned"),
    DeadLetter: (logging.WARNING, "dead letter"),
    ChildStartFailed: (logging.ERROR, "child not started"),
    ShutdownError: (logging.WARNING, "shutdown error"),
    StopOverdue: (logging.ERROR, "stop overdue"),
    OrderHeld: (logging.WARNING, "order held"),
    HelperStuck: (logging.WARNING, "helper stuck"),
    TrustBreached: (logging.ERROR, "trust breached"),
    BindingAwaited: (logging.WARNING, "binding awaited"),
    AutoShutdown: (logging.INFO, "auto shutdown"),
    SupervisorGaveUp: (logging.ERROR, "supervisor gave up"),
    ProcessDied: (logging.WARNING, "process died"),
    Recovered: (logging.INFO, "actor recovered"),
    RecoveryFailed: (logging.ERROR, "recovery failed"),
    RecoveryHookFailed: (logging.ERROR, "recovery hook failed"),
    RecordsMapped: (logging.INFO, "records mapped"),
    RecoveryTableUnused: (logging.WARNING, "recovery table unused"),
    SafeStateEntered: (logging.WARNING, "safe state entered"),
    SafeStateMissed: (logging.ERROR, "safe state missed"),
    SafeStateLeft: (logging.INFO, "safe state left"),
    SafeStateKept: (logging.ERROR, "safe state kept"),
    SafeStateOverdue: (logging.ERROR, "safe state overdue"),
    HeldMessages: (logging.WARNING, "messages held"),
    RolledBack: (logging.ERROR, "rolled back"),
    TurnsLost: (logging.ERROR, "turns lost"),
    MessageQuarantined: (logging.ERROR, "message quarantined"),
    SnapshotFailed: (logging.ERROR, "snapshot failed"),
    SnapshotDamaged: (logging.ERROR, "snapshot damaged"),
    JournalFull: (logging.WARNING, "journal full"),
    JournalBlocked: (logging.ERROR, "journal blocked"),
    JournalGoesOn: (logging.INFO, "journal goes on"),
    JournalStopped: (logging.CRITICAL, "journal stopped"),
    ConnectionLimited: (logging.WARNING, "connection limited"),
    KeptForSystem: (logging.WARNING, "kept for another system"),
    StandingBy: (logging.INFO, "standing by"),
    ServersSilent: (logging.WARNING, "servers do not answer"),
    ServersAnswer: (logging.INFO, "servers answer again"),
    LeadershipTaken: (logging.INFO, "leadership taken"),
    StoreRefused: (logging.ERROR, "store refused"),
    HistoryNotKept: (logging.WARNING, "history not kept"),
    LogLine: (logging.INFO, "output"),
    Moved: (logging.INFO, "actor moved"),
    ScriptLoaded: (logging.INFO, "code loaded"),
    TransactionCommitted: (logging.INFO, "transaction committed"),
    TransactionRolledBack: (logging.WARNING, "transaction rolled back"),
    SpecificationNotKept: (logging.ERROR, "specification not kept"),
    LoopLagged: (logging.WARNING, "loop lagged"),
    TurnSlow: (logging.WARNING, "turn slow"),
    TurnWaits: (logging.WARNING, "turn waits"),
    StopWaits: (logging.WARNING, "stop waits"),
    AdaptationUndone: (logging.WARNING, "adaptation undone"),
    BackgroundWorkLost: (logging.ERROR, "background work lost"),
    Diverged: (logging.ERROR, "replica diverged"),
    FailedOver: (logging.WARNING, "failed over"),
    Masked: (logging.WARNING, "fault masked"),
    MechanismSettled: (logging.INFO, "mechanism settled"),
    NondeterminismFound: (logging.ERROR, "nondeterminism found"),
    Objected: (logging.WARNING, "outcome objected to"),
    Outvoted: (logging.WARNING, "replica outvoted"),
    ProtectionCostly: (logging.WARNING, "protection costly"),
    ProtectionLost: (logging.ERROR, "protection lost"),
    ReplicaFaulty: (logging.ERROR, "replica faulty"),
    ReplicaJoined: (logging.INFO, "replica joined"),
    ReplicaLost: (logging.WARNING, "replica lost"),
    RequestsDropped: (logging.ERROR, "requests dropped"),
    StatesDiffer: (logging.ERROR, "states differ"),
    TurnHung: (logging.ERROR, "turn hung"),
}
"""Level and name of the record that an event becomes; others are not written."""


CRASHES = (ActorCrashed, ProcessDied, HookFailed, ShutdownError)
"""Events that tell of a crash first; what others make of it they tell without its traceback."""


def describe(event: Event, *, payloads: bool = False) -> Fields:
    """An event's fields as text and numbers; of messages the type, and with `payloads` also what is in them."""
    fields: Fields = {}
    for name in event.__struct_fields__:
        value = getattr(event, name)
        if isinstance(value, (Message, Item, MessageText)):
            fields["message"] = item_name(value)
            if isinstance(value, Item) and (trace := tail_of(value.chain)):
                _, fields["trace_id"], fields["span_id"], *_ = (*trace.split("-"), "", "")
            if payloads:
                message = message_of(value)
                fields["payload"] = portable(str(value if message is None else message))
        elif isinstance(value, Crash):
            fields[name] = str(value)
            if isinstance(event, CRASHES):
                fields["exception"] = value.traceback
        elif isinstance(value, dict):
            fields[name] = {key: round(one, 6) if isinstance(one, float) else one for key, one in value.items()}
        elif isinstance(value, (int, float)):
            fields[name] = value
        elif isinstance(value, tuple) and all(isinstance(one, str) for one in value):
            fields[name] = list(value)
        else:
            fields[name] = str(value)
    return fields


def _seconds(recovered: Recovered) -> float:
    """How long a recovery has taken."""
    return sum(recovered.phases.values())


def record_text(name: str, fields: Fields) -> str:
    """A record in one line, without its traceback.

    >>> record_text("process died", {"pid": 7, "reason": "killed by SIGKILL"})
    "process died pid=7 reason='killed by SIGKILL'"
    """
    shown = " ".join(f"{key}={value!r}" for key, value in fields.items() if key != "exception")
    return f"{name} {shown}"


def _structlog() -> Any:
    """structlog, if the program has set it up, or has set up no logging at all: then it writes to stderr."""
    if "structlog" not in sys.modules and logging.getLogger(LOGGER).hasHandlers():
        return None
    import structlog  # only now: it is a third of the time that importing holdfast would take

    return structlog if structlog.is_configured() or not logging.getLogger(LOGGER).hasHandlers() else None


def _write_standard(level: int, name: str, fields: Fields) -> None:
    """A record of standard logging: the traceback stands where handlers expect it, the fields in `record.holdfast`."""
    logger = logging.getLogger(LOGGER)
    if not logger.isEnabledFor(level):
        return
    record = logger.makeRecord(
        LOGGER, level, __file__, 0, record_text(name, fields), (), None, extra={"holdfast": {"event": name, **fields}}
    )
    record.exc_text = str(fields.get("exception", "")).rstrip() or None
    logger.handle(record)
