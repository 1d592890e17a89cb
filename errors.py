"""All errors that the library raises, of every room. Each is a `HoldfastError`, and its text says what to do."""

from .actors.errors import (
    ActorRestarting,
    ActorStopped,
    AskDeadlock,
    AskFailed,
    AskTimeout,
    BadMessage,
    BadReply,
    CannotMove,
    ConnectionFull,
    ConnectionLost,
    ControlFailed,
    EffectFailed,
    EffectInDoubt,
    HoldfastError,
    Ignore,
    MailboxFull,
    NameTaken,
    NoSuchActor,
    NoSuchEvent,
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
    StillEnding,
    StoreError,
    TreeFailed,
    TurnTimeout,
    UnknownMessage,
    Unreachable,
    UnsavableValue,
    WaitTimeout,
    WrongActor,
    WrongLoop,
    WrongThread,
)
from .actors.kernel.bindings import Unbound
from .actors.kernel.context import StashError
from .actors.kernel.message import Refusal, UnknownRefusal
from .actors.process.program.external_program import ProgramFailed
from .actors.state_hooks import StateMismatch
from .checkpoint.home.quarantine import NotQuarantined
from .checkpoint.journal import (
    DamagedStore,
    ForeignStore,
    NotCopied,
    StaleEpoch,
    StoreFailed,
    StoreInUse,
    WrongStoreKey,
)
from .checkpoint.life.determinism_guard import NotDeterministic
from .checkpoint.life.readonly_guard import NotReadonly
from .checkpoint.life.replay_guard import StateDiverged
from .checkpoint.snapshot.snapshot_groups import NoSuchGroup
from .checkpoint.snapshot.snapshot_schedule import CheckpointFailed
from .checkpoint.upgrade.mapping import NotMapped
from .cluster.leadership import LeadershipLost
from .cluster.ports import AccessRefused, UnsafeServer
from .ftm.group.reconfiguration import CannotAdapt
from .ftm.mechanisms.rb import NotAccepted
from .ftm.model.mechanism import MechanismRefused
from .ftm.votes.assertions import AssertionFailed
from .ftm.votes.voters import NoMajority
from .supervision.admin import (
    AlreadyPresent,
    AlreadyStarted,
    ChildBusy,
    ChildParked,
    MaxChildren,
    NoPartitions,
    NoSuchChild,
    NotSupported,
)
from .supervision.arbiter import GrantLost, InOtherHands
from .supervision.services.program import InputRefused
from .supervision.services.registrar import NotAnActor, NotUnique
from .supervision.services.registry import AlreadyRegistered
from .supervision.services.router import NoRoute
from .system.script import UntrustedFile
from .system.transaction.errors import TransactionFailed, TransactionRefused

__all__ = [
    "AccessRefused",
    "ActorRestarting",
    "ActorStopped",
    "AlreadyPresent",
    "AlreadyRegistered",
    "AlreadyStarted",
    "AskDeadlock",
    "AskFailed",
    "AskTimeout",
    "AssertionFailed",
    "BadMessage",
    "BadReply",
    "CannotAdapt",
    "CannotMove",
    "CheckpointFailed",
    "ChildBusy",
    "ChildParked",
    "ConnectionFull",
    "ConnectionLost",
    "ControlFailed",
    "DamagedStore",
    "EffectFailed",
    "EffectInDoubt",
    "ForeignStore",
    "GrantLost",
    "HoldfastError",
    "Ignore",
    "InOtherHands",
    "InputRefused",
    "LeadershipLost",
    "MailboxFull",
    "MaxChildren",
    "MechanismRefused",
    "NameTaken",
    "NoMajority",
    "NoPartitions",
    "NoRoute",
    "NoSuchActor",
    "NoSuchChild",
    "NoSuchEvent",
    "NoSuchGroup",
    "NotAccepted",
    "NotAnActor",
    "NotCopied",
    "NotDeterministic",
    "NotGranted",
    "NotMapped",
    "NotQuarantined",
    "NotReadonly",
    "NotSupported",
    "NotSuspended",
    "NotUnique",
    "ProcessUnavailable",
    "ProgramFailed",
    "Quarantined",
    "Refusal",
    "RemoteCrash",
    "ReplayDiverged",
    "SendError",
    "SpecError",
    "StaleEpoch",
    "StartFailed",
    "StartIgnored",
    "StashError",
    "StateDiverged",
    "StateMismatch",
    "StillEnding",
    "StoreError",
    "StoreFailed",
    "StoreInUse",
    "TransactionFailed",
    "TransactionRefused",
    "TreeFailed",
    "TurnTimeout",
    "Unbound",
    "UnknownMessage",
    "UnknownRefusal",
    "Unreachable",
    "UnsafeServer",
    "UnsavableValue",
    "UntrustedFile",
    "WaitTimeout",
    "WrongActor",
    "WrongLoop",
    "WrongStoreKey",
    "WrongThread",
]
