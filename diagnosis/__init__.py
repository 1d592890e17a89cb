"""Diagnosis: what observers see and a model of the system, put together, name what is faulty; repair acts on it.

    from holdfast import diagnosis

    watching = await diagnosis.watch(system, repair="on")
    print(await watching.diagnosis())

`tree(...)` is the same in single parts, as the supervision tree that a user adds to a system.
"""

from importlib.util import find_spec

if missing := [name for name in ("clingo", "yaml") if find_spec(name) is None]:
    raise ImportError(f"holdfast.diagnosis needs {' and '.join(missing)}: pip install 'holdfast[diagnosis]'")

from .assembly import observer, tree
from .diagnoser import DiagnoserActor
from .generate import Generated, Wired, generate, observers_for
from .live_limits import expecting, property_observers
from .messages import (
    DIAGNOSIS,
    EXPLANATION,
    GRACE,
    MODEL,
    OBSERVATIONS,
    REPAIR,
    ROS_DIAGNOSTICS,
    TOUCHED,
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
from .model_server import (
    ChangeModel,
    GetModel,
    GetVersions,
    LoadModel,
    ModelRefused,
    ModelServer,
    RollBackModel,
    ValidateModel,
)
from .system_watch import Watch, watch

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
    "TOUCHED",
    "Touched",
    "ValidateModel",
    "Watch",
    "Wired",
    "expecting",
    "generate",
    "observer",
    "observers_for",
    "property_observers",
    "tree",
    "watch",
]
