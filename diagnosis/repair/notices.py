"""The messages that repair publishes on `/repair`, and those that it takes."""

from __future__ import annotations

import msgspec

from ...actors.events import RepairGaveUp, RepairTold
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
    """An action has ended. `outcome`: done, failed, unverified, skipped or lost; `why` in words."""

    case: int
    step: Step
    outcome: str
    why: str
    time: float


class ApprovalWanted(Message):
    """The plan of this case waits for `Approve` or `Deny`, for so many seconds; `steps` are all it would do."""

    case: int
    steps: tuple[Step, ...]
    reason: str
    seconds: float


class Undone(Message):
    """An action has not helped and was taken back, or could not be: `why` in words."""

    case: int
    step: Step
    why: str


class AdviceScored(Message):
    """A fault has gone for which repair had only advised: `verdict` is right, wrong or needless.

    `seconds_saved`: how long the advice came before somebody did what it said.
    """

    case: int
    verdict: str
    seconds_saved: float


class Held(Message):
    """Repair does nothing for now, and why: the mode forbids it, or the observations are contradictory."""

    case: int
    why: str


class Repaired(Message):
    """The symptoms are gone, and that was observed. `actions`: those that were done, without what has not helped."""

    case: int
    actions: tuple[Step, ...]
    seconds: float


class GaveUp(Message):
    """These components are beyond repair; `actions`: all that was tried. They are left alone from now on.

    They are tried again after `RetryRepair`, or when a diagnosis has found them good. `plan`: what a person should try.
    """

    case: int
    components: tuple[str, ...]
    symptoms: tuple[Literal, ...]
    why: str
    actions: tuple[Step, ...]
    seconds: float
    plan: tuple[str, ...] = ()


class Approve(RuntimeOrder[None]):
    """A person allows the plan of a case. Refused with NobodyWaits."""

    case: int


class Deny(RuntimeOrder[None]):
    """A person forbids the plan of a case: nobody whom it is for is touched before `RetryRepair`.

    Refused with NobodyWaits.
    """

    case: int
    why: str = "a person said no"


class NobodyWaits(Refusal, text="no plan of case {case} waits for approval: it was decided, or the case is over"):
    """No plan of this case waits for approval."""

    case: int


class SetStance(RuntimeOrder[None]):
    """How far repair goes from now on: "off", "advise", "ask" or "on". Refused with BadStance."""

    stance: str


class BadStance(Refusal, text="{problem}"):
    """There is no such stance."""

    problem: str


class SetMode(RuntimeOrder[None]):
    """The mode the system is in from now on; what may be done in it is in the policy."""

    mode: str


class RetryRepair(RuntimeOrder[None]):
    """Try components again that were given up or denied: the cause was seen to. All of them, if none are named."""

    components: tuple[str, ...] = ()


class StoryEntry(msgspec.Struct, frozen=True):
    """One thing that happened: `time` in Unix seconds, `what` is the kind of the notice, `text` a sentence."""

    time: float
    what: str
    text: str
    components: tuple[str, ...] = ()


class Story(msgspec.Struct, frozen=True):
    """A case with all that happened in it, oldest first."""

    case: int
    entries: tuple[StoryEntry, ...]


class CaseStories(Message):
    """The last cases, the oldest first, each with all that was told of it."""

    stories: tuple[Story, ...]


class GetStories(Message[CaseStories]):
    """Asks for what was told of the last cases, as plain sentences."""


class RepairStatus(Message):
    """Tells how repair stands: stance, mode, cases, whom it has given up or is forbidden to touch, and its score.

    `waiting` is the case whose plan waits for approval, 0: none. `useless` counts plans that have not helped. The score
    is of advice: how many were right, wrong or needless, what was missed, and by how many seconds advice came first.
    """

    mode: str
    is_repairing: bool
    given_up: tuple[str, ...]
    cases: int
    stance: str = "on"
    denied: tuple[str, ...] = ()
    waiting: int = 0
    useless: int = 0
    right: int = 0
    wrong: int = 0
    needless: int = 0
    missed: int = 0
    seconds_saved: float = 0.0
    reasons: dict[str, str] = msgspec.field(default_factory=dict)
    """Why, of each component that is given up or denied."""


class GetRepairStatus(Message[RepairStatus]):
    """Asks how repair stands at the moment."""


CaseNotice = (
    RepairBegan
    | Planned
    | ActionBegan
    | ActionEnded
    | ApprovalWanted
    | Undone
    | AdviceScored
    | Held
    | Repaired
    | GaveUp
)
"""What repair tells of a case; each has its number."""

__all__ = [
    "TOPIC",
    "ActionBegan",
    "ActionEnded",
    "AdviceScored",
    "ApprovalWanted",
    "Approve",
    "BadStance",
    "CaseNotice",
    "CaseStories",
    "Deny",
    "GaveUp",
    "GetRepairStatus",
    "GetStories",
    "Held",
    "Message",
    "NobodyWaits",
    "Planned",
    "RepairBegan",
    "RepairGaveUp",
    "RepairStatus",
    "RepairTold",
    "Repaired",
    "RetryRepair",
    "SetMode",
    "SetStance",
    "Story",
    "StoryEntry",
    "Touched",
    "Undone",
]
