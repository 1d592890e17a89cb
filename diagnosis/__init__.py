"""Diagnosis: what observers see and a model of the system, put together, name what is faulty; repair acts on it.

`tree(...)` is the supervision tree that a user adds to a system; the parts are in the folders.
"""

from .assembly import observer, tree
from .diagnoser import DiagnoserActor
from .generate import Generated, Wired, generate, observers_for
from .messages import (
    DIAGNOSIS,
    EXPLANATION,
    GRACE,
    MODEL,
    OBSERVATIONS,
    REPAIR,
    ROS_DIAGNOSTICS,
    Explained,
    GetDiagnosis,
    GetExplanation,
    GetObserved,
    Grace,
    ModelChanged,
    NextBest,
    RosDiagnostics,
    Touched,
)
from .server import (
    ChangeModel,
    GetModel,
    GetVersions,
    LoadModel,
    ModelRefused,
    ModelServer,
    RollBackModel,
    ValidateModel,
)

__all__ = [
    "ChangeModel",
    "DIAGNOSIS",
    "DiagnoserActor",
    "EXPLANATION",
    "Explained",
    "GRACE",
    "Generated",
    "GetDiagnosis",
    "GetExplanation",
    "GetModel",
    "GetObserved",
    "GetVersions",
    "Grace",
    "LoadModel",
    "MODEL",
    "ModelChanged",
    "ModelRefused",
    "ModelServer",
    "NextBest",
    "OBSERVATIONS",
    "REPAIR",
    "ROS_DIAGNOSTICS",
    "RollBackModel",
    "RosDiagnostics",
    "Touched",
    "ValidateModel",
    "Wired",
    "generate",
    "observer",
    "observers_for",
    "tree",
]
