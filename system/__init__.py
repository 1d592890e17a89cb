"""The composition root: `ActorSystem` and `run` hand the parts to each other."""

from ..actors.control.live_state import Opaque
from ..actors.control.orders import Status
from ..actors.control.tracing import Statistics
from .connection import Connection
from .history.evidence import PutAside
from .history.lives import PastLife
from .history.pages import HistoryPage
from .history.past_event import PastEvent
from .portal import ThreadPortal
from .transaction.change import Change
from .transaction.operation import Operation, Step

__all__ = [
    "Change",
    "Connection",
    "HistoryPage",
    "Opaque",
    "Operation",
    "PastEvent",
    "PastLife",
    "PutAside",
    "Statistics",
    "Status",
    "Step",
    "ThreadPortal",
]
