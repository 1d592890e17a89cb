"""Repair: from a diagnosis to a plan, from a plan to actions, and from observations to whether they have helped.

`Repairer` is the actor; `action` makes a coroutine an action; `stock` has those that come with holdfast.
"""

from .actions import Act, ActionFailed, RepairAction, Repertoire, action
from .actor import Repairer
from .assembly import repairer
from .executor import DENIED, DONE, FAILED, LOST, SKIPPED, UNVERIFIED
from .ledger import Memory
from .messages import (
    TOPIC,
    ActionBegan,
    ActionEnded,
    ApprovalWanted,
    Approve,
    Deny,
    GaveUp,
    GetRepairStatus,
    Held,
    NobodyWaits,
    Planned,
    RepairBegan,
    Repaired,
    RepairGaveUp,
    RepairStatus,
    RetryRepair,
    SetMode,
    Touched,
)
from .policy import NORMAL, SAFE, Policy
from .stock import (
    bind_port,
    change_mechanism,
    power_up,
    restart_child,
    restart_subtree,
    roll_back,
    run_command,
    run_coroutine,
    shutdown,
    start_node,
    stop_node,
)

__all__ = [
    "DENIED",
    "DONE",
    "FAILED",
    "LOST",
    "NORMAL",
    "SAFE",
    "SKIPPED",
    "TOPIC",
    "UNVERIFIED",
    "Act",
    "ActionBegan",
    "ActionEnded",
    "ActionFailed",
    "ApprovalWanted",
    "Approve",
    "Deny",
    "GaveUp",
    "GetRepairStatus",
    "Held",
    "Memory",
    "NobodyWaits",
    "Planned",
    "Policy",
    "RepairAction",
    "RepairBegan",
    "RepairGaveUp",
    "RepairStatus",
    "Repaired",
    "Repairer",
    "Repertoire",
    "RetryRepair",
    "SetMode",
    "Touched",
    "action",
    "bind_port",
    "change_mechanism",
    "power_up",
    "repairer",
    "restart_child",
    "restart_subtree",
    "roll_back",
    "run_command",
    "run_coroutine",
    "shutdown",
    "start_node",
    "stop_node",
]
