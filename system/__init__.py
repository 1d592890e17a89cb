"""The composition root: `ActorSystem` and `run` hand the parts to each other."""

from ..actors.control.live_state import Opaque
from ..actors.control.orders import Status
from ..actors.control.tracing import Statistics
from ..cluster.lines.inflow import ConnectionLimits
from ..cluster.lines.lines import PeerLook
from .history.evidence import PutAside
from .history.lives import PastLife
from .history.pages import HistoryPage
from .history.past_event import PastEvent
from .last_lines.line_memory import LoggedLine
from .last_lines.line_page import LogPage
from .portal import ThreadPortal
from .system_connection import SystemConnection
from .transaction.change import Change
from .transaction.operation import Operation, Step

__all__ = [
    "Change",
    "ConnectionLimits",
    "HistoryPage",
    "LogPage",
    "LoggedLine",
    "Opaque",
    "Operation",
    "PastEvent",
    "PastLife",
    "PeerLook",
    "PutAside",
    "Statistics",
    "Status",
    "Step",
    "SystemConnection",
    "ThreadPortal",
]
