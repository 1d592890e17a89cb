"""holdfast keeps stateful asyncio programs running.

Actors live in supervision trees, each in a task or in an OS process of its own. When one crashes, its state and its
mailbox come back as if nothing had happened.
"""

from holdfast import adapters as adapters
from holdfast import checkpoint as checkpoint
from holdfast import errors as errors
from holdfast import events as events
from holdfast import ftm as ftm
from holdfast import supervision as supervision
from holdfast import system as system
from holdfast.actors.backoff import Backoff
from holdfast.actors.effects import Retry, fencing_token
from holdfast.actors.errors import (
    ActorStopped,
    AskFailed,
    AskTimeout,
    HoldfastError,
    Ignore,
    MailboxFull,
    Quarantined,
    RemoteCrash,
    SendError,
    SpecError,
    StartFailed,
    TreeFailed,
    UnknownMessage,
    Unreachable,
)
from holdfast.actors.exit_reasons import (
    KILLED,
    NOPROC,
    NORMAL,
    SHUTDOWN,
    Crash,
    Exited,
    ExitReason,
    ForkServerDied,
    Hung,
    Killed,
    NoConnection,
    NoProc,
    Normal,
    OutOfMemory,
    Shutdown,
    Signal,
    TrustBreach,
)
from holdfast.actors.kernel.actor import Actor, Start, on, start, subscribe
from holdfast.actors.kernel.bindings import Binding
from holdfast.actors.kernel.context import ActorContext
from holdfast.actors.kernel.envelope import ReplyHandle
from holdfast.actors.kernel.links import Monitor
from holdfast.actors.kernel.mailbox import bounded
from holdfast.actors.kernel.message import Message, Refusal
from holdfast.actors.kernel.ref import ActorRef
from holdfast.actors.kernel.timers import Timer
from holdfast.actors.process.resource_limits import Limits
from holdfast.actors.values.renamed import renamed
from holdfast.checkpoint.method import Method, checkpoint_only, fresh, hybrid, replay_only
from holdfast.supervision.admin import DeleteChild, RestartChild, StartChild, TerminateChild, WhichChildren
from holdfast.supervision.config import load_tree
from holdfast.supervision.dynamic import dynamic
from holdfast.supervision.rules import rule
from holdfast.supervision.spec import ChildSpec, Plan, child
from holdfast.supervision.supervisor import Supervisor
from holdfast.supervision.tree import supervisor
from holdfast.system.run import run
from holdfast.system.system import ActorSystem
from holdfast.system.system_connection import connect
from holdfast.system.transaction.errors import TransactionFailed, TransactionRefused

__version__ = "0.2.0.dev0"

__all__ = [
    "Actor",
    "ActorContext",
    "ActorRef",
    "ActorStopped",
    "ActorSystem",
    "AskFailed",
    "AskTimeout",
    "Backoff",
    "Binding",
    "ChildSpec",
    "Crash",
    "DeleteChild",
    "ExitReason",
    "Exited",
    "ForkServerDied",
    "HoldfastError",
    "Hung",
    "Ignore",
    "KILLED",
    "Killed",
    "Limits",
    "MailboxFull",
    "Message",
    "Method",
    "Monitor",
    "NOPROC",
    "NORMAL",
    "NoConnection",
    "NoProc",
    "Normal",
    "OutOfMemory",
    "Plan",
    "Quarantined",
    "Refusal",
    "RemoteCrash",
    "ReplyHandle",
    "RestartChild",
    "Retry",
    "SHUTDOWN",
    "SendError",
    "Shutdown",
    "Signal",
    "SpecError",
    "Start",
    "StartChild",
    "StartFailed",
    "Supervisor",
    "TerminateChild",
    "Timer",
    "TransactionFailed",
    "TransactionRefused",
    "TreeFailed",
    "TrustBreach",
    "UnknownMessage",
    "Unreachable",
    "WhichChildren",
    "__version__",
    "bounded",
    "checkpoint_only",
    "child",
    "connect",
    "dynamic",
    "fencing_token",
    "fresh",
    "hybrid",
    "load_tree",
    "on",
    "renamed",
    "replay_only",
    "rule",
    "run",
    "start",
    "subscribe",
    "supervisor",
]
