"""The engine: all minimal diagnoses, ranked, explained, and what to look at next."""

from .diagnoser import Diagnoser
from .explain import Conflict, Consequence, Explanation
from .probe import Probe
from .result import Candidate, Diagnosis, State

__all__ = [
    "Candidate",
    "Conflict",
    "Consequence",
    "Diagnoser",
    "Diagnosis",
    "Explanation",
    "Probe",
    "State",
]
