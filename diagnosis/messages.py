"""The words that observers, the diagnoser and repair exchange, and the topics they are published on."""

from __future__ import annotations

from typing import Final

from ..actors.kernel.message import Message, RuntimeCall
from .engine import Diagnosis
from .literals import Literal
from .model import Declaration
from .observations import Observed

DIAGNOSER: Final = "diagnoser"
"""The last part of the diagnoser's address."""
OBSERVATIONS: Final = "/observations"
"""`Observation`, one for each literal (D7)."""
DIAGNOSIS: Final = "/diagnosis"
"""`Diagnosis`, when it changes (D8)."""
EXPLANATION: Final = "/explanation"
"""`Explained`, after each diagnosis that is published."""
ROS_DIAGNOSTICS: Final = "/diagnostics"
"""`RosDiagnostics`, after each diagnosis that is published (D33)."""
MODEL: Final = "/model"
"""`ModelChanged`."""
GRACE: Final = "/grace"
"""`Grace`, from whoever acts upon the system."""
STARTS: Final = "/starts"
"""`ComponentsStarted`, from whoever sees that a component has begun a new life."""
OBSERVERS: Final = "/observers"
"""`ObserverCrashed`, from an observer that has crashed."""
REPAIR: Final = "/repair"
"""Whatever repair tells of its cases."""
TOUCHED: Final = "/touched"
"""`Touched`, after each action: a topic of its own, since the diagnoser hears nothing else of what repair tells."""


class Grace(Message):
    """Something is about to start: for `seconds` nothing bad is said of these components, topics and values (T51).

    What was said of them before is taken back: it is unknown. What is good is said at once. Not for actions that are
    expected to make something false, such as a stop.
    """

    names: tuple[str, ...]
    seconds: float
    is_counted: bool = False
    """It was started by others: how often that happens is still counted."""


class Touched(RuntimeCall):
    """A repair action upon these components has ended: among equals they are suspected last for a while (O3).

    `grace` asks for so many seconds of grace for them and for what depends on them; 0 after a stop, whose effect is
    that something does not hold.
    """

    components: tuple[str, ...]
    action: str
    time: float
    grace: float = 0.0


class ComponentsStarted(RuntimeCall):
    """These components have begun a new life: their supervisor, or a person, has started them again.

    `seconds`: how long what is seen of them, and of what depends on them, says nothing yet.
    """

    components: tuple[str, ...]
    seconds: float


class ObserverCrashed(RuntimeCall):
    """An observer has crashed: it may be that nobody sees any more what it was to look at."""

    source: str
    why: str


class ModelChanged(RuntimeCall):
    """The model has another version now."""

    version: int
    declaration: Declaration
    reason: str = ""


class NextBest(Message):
    """An atom that is worth observing: how many bits that would tell."""

    atom: Literal
    gain: float


class Explained(Message):
    """An explanation of a diagnosis in plain words, with what to look at next."""

    text: str
    conflicts: tuple[str, ...] = ()
    consequences: tuple[str, ...] = ()
    next_best: tuple[NextBest, ...] = ()
    refused: tuple[str, ...] = ()
    """Observations that the model has no words for, with their sources (T53)."""


class RosDiagnostics(Message):
    """A `diagnostic_msgs/DiagnosticArray` as plain data."""

    array: dict[str, object]


class GetDiagnosis(Message[Diagnosis]):
    """The newest diagnosis; answered when all that was observed before has been thought through."""


class GetExplanation(Message[Explained]):
    """Ask why the diagnosis is what it is."""


class GetObserved(Message[Observed]):
    """Asks for what is observed at the moment."""


__all__ = [
    "DIAGNOSER",
    "DIAGNOSIS",
    "EXPLANATION",
    "GRACE",
    "MODEL",
    "OBSERVATIONS",
    "OBSERVERS",
    "REPAIR",
    "ROS_DIAGNOSTICS",
    "STARTS",
    "TOUCHED",
    "ComponentsStarted",
    "Explained",
    "GetDiagnosis",
    "GetExplanation",
    "GetObserved",
    "Grace",
    "ModelChanged",
    "NextBest",
    "ObserverCrashed",
    "RosDiagnostics",
    "Touched",
]
