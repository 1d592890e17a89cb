"""holdfast keeps stateful asyncio programs running.

Actors live in supervision trees, each in a task or in an OS process of its own. When one crashes, its state and its
mailbox come back as if nothing had happened.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING
from typing import Any as _Any

from holdfast.actors.adapters import Bus, Calls, Wrapped, calls, wrap
from holdfast.actors.control.live_state import Opaque
from holdfast.actors.control.orders import Status
from holdfast.actors.control.tracing import Statistics
from holdfast.actors.errors import (
    ActorRestarting,
    ActorStopped,
    AskDeadlock,
    AskFailed,
    AskTimeout,
    BadMessage,
    CannotMove,
    ControlFailed,
    HoldfastError,
    Ignore,
    MailboxFull,
    NameTaken,
    NoSuchActor,
    NotGranted,
    NotSuspended,
    ProcessUnavailable,
    Quarantined,
    RemoteCrash,
    ReplayDiverged,
    SendError,
    SpecError,
    StartFailed,
    StartIgnored,
    StoreError,
    TreeFailed,
    UnknownMessage,
    WrongActor,
    WrongThread,
)
from holdfast.actors.events import (
    ActorCrashed,
    ActorStarted,
    AutoShutdown,
    ChildRestarted,
    ChildStartFailed,
    ChildTerminated,
    DeadLetter,
    Event,
    EventStream,
    HeldMessages,
    JournalBlocked,
    JournalFull,
    JournalGoesOn,
    JournalStopped,
    LogLine,
    LoopLagged,
    MessageIn,
    MessageOut,
    MessageQuarantined,
    Moved,
    ProcessDied,
    ProcessStarted,
    Recovered,
    RecoveryFailed,
    RecoveryHookFailed,
    RecoveryPhase,
    RecoveryTableUnused,
    ReplayPaced,
    RolledBack,
    SafeStateEntered,
    SafeStateKept,
    SafeStateLeft,
    SafeStateMissed,
    SafeStateOverdue,
    ShutdownError,
    SnapshotDamaged,
    SnapshotFailed,
    SnapshotTaken,
    StopOverdue,
    StoreRefused,
    SupervisorGaveUp,
    TrustBreached,
    TurnBegan,
    TurnEnded,
    TurnsLost,
    TurnSlow,
    TurnsSkipped,
)
from holdfast.actors.exit_reasons import (
    KILLED,
    NOPROC,
    NORMAL,
    SHUTDOWN,
    Crash,
    Exited,
    ExitReason,
    Hung,
    Killed,
    NoProc,
    Normal,
    OutOfMemory,
    Shutdown,
    Signal,
)
from holdfast.actors.kernel.actor import Actor, Start, on, start, subscribe
from holdfast.actors.kernel.bindings import Binding, Unbound
from holdfast.actors.kernel.context import ActorContext
from holdfast.actors.kernel.envelope import ReplyHandle
from holdfast.actors.kernel.links import Monitor
from holdfast.actors.kernel.mailbox import bounded
from holdfast.actors.kernel.message import Message, Refusal
from holdfast.actors.kernel.ref import ActorRef
from holdfast.actors.kernel.timers import Timer
from holdfast.actors.process.program.external_program import ProgramFailed
from holdfast.actors.process.resource_limits import Limits
from holdfast.checkpoint.home.quarantine import NotQuarantined, QuarantinedMessage
from holdfast.checkpoint.journal import DamagedStore, ForeignStore, StaleEpoch, StoreFailed, StoreInUse
from holdfast.checkpoint.life.determinism_guard import NotDeterministic
from holdfast.checkpoint.life.readonly_guard import NotReadonly
from holdfast.checkpoint.life.replay_guard import StateDiverged
from holdfast.checkpoint.method import Method, checkpoint_only, fresh, hybrid, replay_only
from holdfast.checkpoint.recovery_file import RecoveryFile, load_recovery
from holdfast.checkpoint.recovery_settings import (
    Held,
    RecoveryHooks,
    RecoveryStep,
    SafeState,
    held,
    recovery_hooks,
    safe_state,
)
from holdfast.checkpoint.snapshot.snapshot_groups import NoSuchGroup
from holdfast.checkpoint.snapshot.snapshot_schedule import CheckpointFailed
from holdfast.supervision.admin import (
    AlreadyPresent,
    AlreadyStarted,
    ChangeSupervisor,
    ChildBusy,
    ChildCounts,
    ChildInfo,
    ChildParked,
    CountChildren,
    DeleteChild,
    GetChildSpec,
    MaxChildren,
    NoPartitions,
    NoSuchChild,
    NotSupported,
    RestartChild,
    StartChild,
    TerminateChild,
    WhichChildren,
)
from holdfast.supervision.backoff import Backoff
from holdfast.supervision.config import load_tree, tree_from
from holdfast.supervision.dynamic import DynamicSupervisor, dynamic
from holdfast.supervision.rules import Rule, rule
from holdfast.supervision.services.awaited_jobs import Failed, Job, Ok
from holdfast.supervision.services.jobs import TaskSupervisor
from holdfast.supervision.services.partition import (
    CountPartitions,
    PartitionSupervisor,
    ResizePartitions,
    Route,
    partition_of,
    partitions,
)
from holdfast.supervision.services.pool import PoolInfo, PoolStatus, PoolSupervisor, ResizePool, pool, pool_of
from holdfast.supervision.services.program import (
    InputRefused,
    Program,
    ProgramInfo,
    ProgramInput,
    ProgramStatus,
    program,
)
from holdfast.supervision.services.registrar import KeyFreed, KeyRegistered, NotAnActor, NotUnique, RegistryActor
from holdfast.supervision.services.registry import AlreadyRegistered, Registry, RegistryEntry, registry
from holdfast.supervision.services.router import NoRoute
from holdfast.supervision.services.tasks import Tasks, tasks
from holdfast.supervision.spec import ChildSpec, Flags, Plan, check_children, child
from holdfast.supervision.supervisor import Supervisor
from holdfast.supervision.tree import supervisor
from holdfast.system.portal import ThreadPortal
from holdfast.system.run import run
from holdfast.system.script import UntrustedFile
from holdfast.system.specification import SpecificationNotKept, SpecificationSuperseded
from holdfast.system.system import ActorSystem
from holdfast.system.transaction.change import Change
from holdfast.system.transaction.errors import TransactionFailed, TransactionRefused
from holdfast.system.transaction.events import (
    ScriptLoaded,
    TransactionBegan,
    TransactionCommitted,
    TransactionRolledBack,
)
from holdfast.system.transaction.operation import Operation, Step

if TYPE_CHECKING:
    from holdfast.ftm.alarms import Diverged, Masked, ProtectionLost
    from holdfast.ftm.bricks.sealed_frames import FrameRefused
    from holdfast.ftm.events import (
        BackgroundWorkLost,
        FailedOver,
        MechanismAttached,
        MechanismChanged,
        MechanismDetached,
        MechanismSettled,
        ReplicaFaulty,
        ReplicaJoined,
        ReplicaLost,
        TurnHung,
        WrongSuspicion,
    )
    from holdfast.ftm.group.protected import ProtectionStatus
    from holdfast.ftm.group.reconfiguration import CannotAdapt
    from holdfast.ftm.mechanisms.ad import AD
    from holdfast.ftm.mechanisms.lfr import LFR
    from holdfast.ftm.mechanisms.nvp import NVP
    from holdfast.ftm.mechanisms.pbr import PBR
    from holdfast.ftm.mechanisms.rb import RB
    from holdfast.ftm.mechanisms.sec import SEC
    from holdfast.ftm.mechanisms.tmr import TMR
    from holdfast.ftm.mechanisms.tr import TR
    from holdfast.ftm.model.detection import Detection
    from holdfast.ftm.model.mechanism import Mechanism, MechanismRefused, compose
    from holdfast.ftm.sec.authority import CertificationAuthority as CertificationAuthority  # not in `__all__`
    from holdfast.ftm.votes.voters import NoMajority
    from holdfast.system.mechanism_notes import AdaptationUndone

__version__ = "0.1.0"

__all__ = [
    "AD",
    "Actor",
    "ActorContext",
    "ActorCrashed",
    "ActorRef",
    "ActorRestarting",
    "ActorStarted",
    "ActorStopped",
    "ActorSystem",
    "AdaptationUndone",
    "AlreadyPresent",
    "AlreadyRegistered",
    "AlreadyStarted",
    "AskDeadlock",
    "AskFailed",
    "AskTimeout",
    "AutoShutdown",
    "BackgroundWorkLost",
    "Backoff",
    "BadMessage",
    "Binding",
    "Bus",
    "Calls",
    "CannotAdapt",
    "CannotMove",
    "Change",
    "ChangeSupervisor",
    "CheckpointFailed",
    "ChildBusy",
    "ChildCounts",
    "ChildInfo",
    "ChildParked",
    "ChildRestarted",
    "ChildSpec",
    "ChildStartFailed",
    "ChildTerminated",
    "ControlFailed",
    "CountChildren",
    "CountPartitions",
    "Crash",
    "DamagedStore",
    "DeadLetter",
    "DeleteChild",
    "Detection",
    "Diverged",
    "DynamicSupervisor",
    "Event",
    "EventStream",
    "ExitReason",
    "Exited",
    "Failed",
    "FailedOver",
    "Flags",
    "ForeignStore",
    "FrameRefused",
    "GetChildSpec",
    "Held",
    "HeldMessages",
    "HoldfastError",
    "Hung",
    "Ignore",
    "InputRefused",
    "Job",
    "JournalBlocked",
    "JournalFull",
    "JournalGoesOn",
    "JournalStopped",
    "KILLED",
    "KeyFreed",
    "KeyRegistered",
    "Killed",
    "LFR",
    "Limits",
    "LogLine",
    "LoopLagged",
    "MailboxFull",
    "Masked",
    "MaxChildren",
    "Mechanism",
    "MechanismAttached",
    "MechanismChanged",
    "MechanismDetached",
    "MechanismRefused",
    "MechanismSettled",
    "Message",
    "MessageIn",
    "MessageOut",
    "MessageQuarantined",
    "Method",
    "Monitor",
    "Moved",
    "NOPROC",
    "NORMAL",
    "NVP",
    "NameTaken",
    "NoMajority",
    "NoPartitions",
    "NoProc",
    "NoRoute",
    "NoSuchActor",
    "NoSuchChild",
    "NoSuchGroup",
    "Normal",
    "NotAnActor",
    "NotDeterministic",
    "NotGranted",
    "NotQuarantined",
    "NotReadonly",
    "NotSupported",
    "NotSuspended",
    "NotUnique",
    "Ok",
    "Opaque",
    "Operation",
    "OutOfMemory",
    "PBR",
    "PartitionSupervisor",
    "Plan",
    "PoolInfo",
    "PoolStatus",
    "PoolSupervisor",
    "ProcessDied",
    "ProcessStarted",
    "ProcessUnavailable",
    "Program",
    "ProgramFailed",
    "ProgramInfo",
    "ProgramInput",
    "ProgramStatus",
    "ProtectionLost",
    "ProtectionStatus",
    "Quarantined",
    "QuarantinedMessage",
    "RB",
    "Recovered",
    "RecoveryFailed",
    "RecoveryFile",
    "RecoveryHookFailed",
    "RecoveryHooks",
    "RecoveryPhase",
    "RecoveryStep",
    "RecoveryTableUnused",
    "Refusal",
    "Registry",
    "RegistryActor",
    "RegistryEntry",
    "RemoteCrash",
    "ReplayDiverged",
    "ReplayPaced",
    "ReplicaFaulty",
    "ReplicaJoined",
    "ReplicaLost",
    "ReplyHandle",
    "ResizePartitions",
    "ResizePool",
    "RestartChild",
    "RolledBack",
    "Route",
    "Rule",
    "SEC",
    "SHUTDOWN",
    "SafeState",
    "SafeStateEntered",
    "SafeStateKept",
    "SafeStateLeft",
    "SafeStateMissed",
    "SafeStateOverdue",
    "ScriptLoaded",
    "SendError",
    "Shutdown",
    "ShutdownError",
    "Signal",
    "SnapshotDamaged",
    "SnapshotFailed",
    "SnapshotTaken",
    "SpecError",
    "SpecificationNotKept",
    "SpecificationSuperseded",
    "StaleEpoch",
    "Start",
    "StartChild",
    "StartFailed",
    "StartIgnored",
    "StateDiverged",
    "Statistics",
    "Status",
    "Step",
    "StopOverdue",
    "StoreError",
    "StoreFailed",
    "StoreInUse",
    "StoreRefused",
    "Supervisor",
    "SupervisorGaveUp",
    "TMR",
    "TR",
    "TaskSupervisor",
    "Tasks",
    "TerminateChild",
    "ThreadPortal",
    "Timer",
    "TransactionBegan",
    "TransactionCommitted",
    "TransactionFailed",
    "TransactionRefused",
    "TransactionRolledBack",
    "TreeFailed",
    "TrustBreached",
    "TurnBegan",
    "TurnEnded",
    "TurnHung",
    "TurnSlow",
    "TurnsLost",
    "TurnsSkipped",
    "Unbound",
    "UnknownMessage",
    "UntrustedFile",
    "WhichChildren",
    "Wrapped",
    "WrongActor",
    "WrongSuspicion",
    "WrongThread",
    "__version__",
    "bounded",
    "calls",
    "check_children",
    "checkpoint_only",
    "child",
    "compose",
    "dynamic",
    "fresh",
    "held",
    "hybrid",
    "load_recovery",
    "load_tree",
    "on",
    "partition_of",
    "partitions",
    "pool",
    "pool_of",
    "program",
    "recovery_hooks",
    "registry",
    "replay_only",
    "rule",
    "run",
    "safe_state",
    "start",
    "subscribe",
    "supervisor",
    "tasks",
    "tree_from",
    "wrap",
]

# Most programs protect nobody: what they do not use is not imported. What needs an extra is not in `__all__`, so that
# `from holdfast import *` needs none.
_LAZY = {
    "AD": "holdfast.ftm.mechanisms.ad",
    "CertificationAuthority": "holdfast.ftm.sec.authority",
    "BackgroundWorkLost": "holdfast.ftm.events",
    "Detection": "holdfast.ftm.model.detection",
    "Diverged": "holdfast.ftm.alarms",
    "FailedOver": "holdfast.ftm.events",
    "FrameRefused": "holdfast.ftm.bricks.sealed_frames",
    "LFR": "holdfast.ftm.mechanisms.lfr",
    "Masked": "holdfast.ftm.alarms",
    "Mechanism": "holdfast.ftm.model.mechanism",
    "MechanismAttached": "holdfast.ftm.events",
    "MechanismDetached": "holdfast.ftm.events",
    "CannotAdapt": "holdfast.ftm.group.reconfiguration",
    "MechanismChanged": "holdfast.ftm.events",
    "AdaptationUndone": "holdfast.system.mechanism_notes",
    "MechanismRefused": "holdfast.ftm.model.mechanism",
    "MechanismSettled": "holdfast.ftm.events",
    "NVP": "holdfast.ftm.mechanisms.nvp",
    "NoMajority": "holdfast.ftm.votes.voters",
    "PBR": "holdfast.ftm.mechanisms.pbr",
    "ProtectionLost": "holdfast.ftm.alarms",
    "ProtectionStatus": "holdfast.ftm.group.protected",
    "RB": "holdfast.ftm.mechanisms.rb",
    "ReplicaFaulty": "holdfast.ftm.events",
    "ReplicaJoined": "holdfast.ftm.events",
    "ReplicaLost": "holdfast.ftm.events",
    "SEC": "holdfast.ftm.mechanisms.sec",
    "TMR": "holdfast.ftm.mechanisms.tmr",
    "TR": "holdfast.ftm.mechanisms.tr",
    "TurnHung": "holdfast.ftm.events",
    "WrongSuspicion": "holdfast.ftm.events",
    "compose": "holdfast.ftm.model.mechanism",
}


def __getattr__(name: str) -> _Any:
    if name in _LAZY:
        value = globals()[name] = getattr(_import_module(_LAZY[name]), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
