"""holdfast keeps stateful asyncio programs running.

Actors live in supervision trees, each in a task or in an OS process of its own. When one crashes, its state and its
mailbox come back as if nothing had happened.
"""

from holdfast.actors.actor import Actor, Start, on, start, subscribe
from holdfast.actors.bindings import Binding, Unbound
from holdfast.actors.context import ActorContext
from holdfast.actors.errors import (
    ActorStopped,
    AskDeadlock,
    AskFailed,
    AskTimeout,
    BadMessage,
    HoldfastError,
    MailboxFull,
    NameTaken,
    NoSuchActor,
    ProcessUnavailable,
    RemoteCrash,
    ReplayDiverged,
    SendError,
    SpecError,
    StartFailed,
    TreeFailed,
    UnknownMessage,
    WrongActor,
)
from holdfast.actors.events import Event, EventStream
from holdfast.actors.exits import (
    KILLED,
    NOPROC,
    NORMAL,
    SHUTDOWN,
    Crash,
    ExitReason,
    Exited,
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
from holdfast.supervision.backoff import Backoff
from holdfast.supervision.spec import ChildSpec, child
from holdfast.supervision.supervisor import Supervisor, supervisor
from holdfast.system.run import run
from holdfast.system.system import ActorSystem

__all__ = [
    "Actor",
    "ActorContext",
    "ActorRef",
    "ActorStopped",
    "ActorSystem",
    "AskDeadlock",
    "AskFailed",
    "AskTimeout",
    "Backoff",
    "BadMessage",
    "Binding",
    "ChildSpec",
    "Crash",
    "Event",
    "EventStream",
    "ExitReason",
    "Exited",
    "HoldfastError",
    "Hung",
    "KILLED",
    "Killed",
    "Limits",
    "MailboxFull",
    "Message",
    "Monitor",
    "NOPROC",
    "NORMAL",
    "NameTaken",
    "NoProc",
    "NoSuchActor",
    "Normal",
    "OutOfMemory",
    "ProcessUnavailable",
    "Refusal",
    "RemoteCrash",
    "ReplayDiverged",
    "ReplyHandle",
    "SHUTDOWN",
    "SendError",
    "Shutdown",
    "Signal",
    "SpecError",
    "Start",
    "StartFailed",
    "Supervisor",
    "Timer",
    "TreeFailed",
    "Unbound",
    "UnknownMessage",
    "WrongActor",
    "bounded",
    "child",
    "on",
    "run",
    "start",
    "subscribe",
    "supervisor",
]
