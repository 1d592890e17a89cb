"""The composition root: `ActorSystem` and `run` hand the parts to each other."""

from ..actors.control.live_state import Opaque
from ..actors.control.orders import Status
from ..actors.control.tracing import Statistics
from .portal import ThreadPortal
from .transaction.change import Change
from .transaction.operation import Operation, Step

__all__ = [
    "Change",
    "Opaque",
    "Operation",
    "Statistics",
    "Status",
    "Step",
    "ThreadPortal",
]
