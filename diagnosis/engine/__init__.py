"""The engine: all minimal diagnoses, ranked, explained, and what to look at next."""

from .explain import Conflict, Consequence, Explanation
from .minimal_diagnoses import Diagnoser
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
