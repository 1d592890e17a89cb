"""holdfast keeps stateful asyncio programs running.

Actors live in supervision trees, each in a task or in an OS process of its own. When one crashes, its state and its
mailbox come back as if nothing had happened.
"""

from holdfast.actors.actor import Actor, Start, on, start, subscribe
from holdfast.actors.bindings import Binding, Unbound
from holdfast.actors.context import ActorContext
from holdfast.actors.control.orders import Status
from holdfast.actors.control.state import Opaque
from holdfast.actors.control.tap import Statistics
from holdfast.actors.errors import (
    ActorRestarting,
    ActorStopped,
    AskDeadlock,
    AskFailed,
    AskTimeout,
    BadMessage,
    ControlFailed,
    HoldfastError,
    MailboxFull,
    NameTaken,
    NoSuchActor,
    NotSuspended,
    ProcessUnavailable,
    Quarantined,
    RemoteCrash,
    ReplayDiverged,
    SendError,
    SpecError,
    StartFailed,
    TreeFailed,
    UnknownMessage,
    WrongActor,
)
from holdfast.actors.events import (
    ActorCrashed,
    ActorStarted,
    ChildRestarted,
    DeadLetter,
    Event,
    EventStream,
    LogLine,
    MessageIn,
    MessageOut,
    MessageQuarantined,
    ProcessDied,
    ProcessStarted,
    Recovered,
    RecoveryFailed,
    SnapshotFailed,
    SnapshotTaken,
    SupervisorGaveUp,
    TurnBegan,
    TurnEnded,
)
from holdfast.actors.exits import (
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
from holdfast.actors.links import Monitor
from holdfast.actors.mail import ReplyHandle
from holdfast.actors.mailbox import bounded
from holdfast.actors.message import Message, Refusal
from holdfast.actors.process.limits import Limits
from holdfast.actors.ref import ActorRef
from holdfast.actors.timers import Timer
from holdfast.checkpoint.method import Method, fresh, hybrid
from holdfast.supervision.backoff import Backoff
from holdfast.supervision.spec import ChildSpec, child
from holdfast.supervision.supervisor import Supervisor, supervisor
from holdfast.system.run import run
from holdfast.system.system import ActorSystem

__all__ = [
    "Actor",
    "ActorContext",
    "ActorCrashed",
    "ActorRef",
    "ActorRestarting",
    "ActorStarted",
    "ActorStopped",
    "ActorSystem",
    "AskDeadlock",
    "AskFailed",
    "AskTimeout",
    "Backoff",
    "BadMessage",
    "Binding",
    "ChildRestarted",
    "ChildSpec",
    "ControlFailed",
    "Crash",
    "DeadLetter",
    "Event",
    "EventStream",
    "ExitReason",
    "Exited",
    "HoldfastError",
    "Hung",
    "KILLED",
    "Killed",
    "Limits",
    "LogLine",
    "MailboxFull",
    "Message",
    "MessageIn",
    "MessageOut",
    "MessageQuarantined",
    "Method",
    "Monitor",
    "NOPROC",
    "NORMAL",
    "NameTaken",
    "NoProc",
    "NoSuchActor",
    "Normal",
    "NotSuspended",
    "Opaque",
    "OutOfMemory",
    "ProcessDied",
    "ProcessStarted",
    "ProcessUnavailable",
    "Quarantined",
    "Recovered",
    "RecoveryFailed",
    "Refusal",
    "RemoteCrash",
    "ReplayDiverged",
    "ReplyHandle",
    "SHUTDOWN",
    "SendError",
    "Shutdown",
    "Signal",
    "SnapshotFailed",
    "SnapshotTaken",
    "SpecError",
    "Start",
    "StartFailed",
    "Statistics",
    "Status",
    "Supervisor",
    "SupervisorGaveUp",
    "Timer",
    "TreeFailed",
    "TurnBegan",
    "TurnEnded",
    "Unbound",
    "UnknownMessage",
    "WrongActor",
    "bounded",
    "child",
    "fresh",
    "hybrid",
    "on",
    "run",
    "start",
    "subscribe",
    "supervisor",
]
