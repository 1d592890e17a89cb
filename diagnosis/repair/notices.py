"""The messages that repair publishes on `/repair`, and those that it takes."""

from __future__ import annotations

from ...actors.events import Event
from ...actors.kernel.message import Message, Refusal, RuntimeOrder
from ..literals import Literal
from ..messages import REPAIR, Touched
from ..planning import Step

TOPIC = REPAIR


class RepairBegan(Message):
    """Something is to be repaired: the case's number, what is blamed, and what was seen."""

    case: int
    bad: tuple[str, ...]
    symptoms: tuple[Literal, ...]


class Planned(Message):
    """What will be done, stage after stage; with `is_dry` nothing will. `unmet`: who is beyond repair."""

    case: int
    bad: tuple[str, ...]
    stages: tuple[tuple[Step, ...], ...]
    unmet: tuple[str, ...] = ()
    is_dry: bool = False


class ActionBegan(Message):
    """An action begins; `epoch` is the arbiter's."""

    case: int
    step: Step
    epoch: int
    reason: str
    time: float


class ActionEnded(Message):
    """An action has ended. `outcome`: done, failed, unverified, skipped, denied or lost; `why` in words."""

    case: int
    step: Step
    outcome: str
    why: str
    time: float


class ApprovalWanted(Message):
    """A dangerous action waits for `Approve` or `Deny` with this number, for so many seconds."""

    number: int
    step: Step
    reason: str
    seconds: float


class Held(Message):
    """Repair does nothing for now, and why: the mode forbids it, or the observations are contradictory."""

    case: int
    why: str


class Repaired(Message):
    """The symptoms are gone, and that was observed. `actions`: all that were done."""

    case: int
    actions: tuple[Step, ...]
    seconds: float


class GaveUp(Message):
    """These components are beyond repair; `actions`: all that was tried. They are left alone from now on.

    They are tried again after `RetryRepair`, or when a diagnosis has found them good.
    """

    case: int
    components: tuple[str, ...]
    symptoms: tuple[Literal, ...]
    why: str
    actions: tuple[Step, ...]
    seconds: float


class RepairGaveUp(Event, frozen=True, eq=False):
    """Repair has given components up: a person has to look at them."""

    components: tuple[str, ...]
    why: str


class Approve(RuntimeOrder[None]):
    """A person allows a dangerous action. Refused with NobodyWaits."""

    number: int


class Deny(RuntimeOrder[None]):
    """A person forbids a dangerous action. Refused with NobodyWaits."""

    number: int
    why: str = "a person said no"


class NobodyWaits(
    Refusal, text="no action waits for approval under the number {number}: it was decided, or its case is over"
):
    """No action waits under this number."""

    number: int


class SetMode(RuntimeOrder[None]):
    """The mode the system is in from now on; what may be done in it is in the policy."""

    mode: str


class RetryRepair(RuntimeOrder[None]):
    """Try components again that were given up: the cause was seen to. All of them, if none are named."""

    components: tuple[str, ...] = ()


class RepairStatus(Message):
    """Tells how repair stands: mode, cases, and whom it has given up."""

    mode: str
    is_repairing: bool
    given_up: tuple[str, ...]
    cases: int


class GetRepairStatus(Message[RepairStatus]):
    """Asks how repair stands at the moment."""


__all__ = [
    "TOPIC",
    "ActionBegan",
    "ActionEnded",
    "ApprovalWanted",
    "Approve",
    "Deny",
    "GaveUp",
    "GetRepairStatus",
    "Held",
    "Message",
    "NobodyWaits",
    "Planned",
    "RepairBegan",
    "RepairGaveUp",
    "RepairStatus",
    "Repaired",
    "RetryRepair",
    "SetMode",
    "Touched",
]
