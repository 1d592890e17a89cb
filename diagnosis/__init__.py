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
from .engine import Diagnoser, Diagnosis, State
from .generate import Generated, Wired, generate, observers_for
from .literals import ok, parse
from .live_limits import expecting, property_observers
from .messages import (
    DIAGNOSIS,
    EXPLANATION,
    GRACE,
    MODEL,
    OBSERVATIONS,
    OBSERVERS,
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
    ObserverCrashed,
    RosDiagnostics,
    Touched,
)
from .model import Expectation, Model, System, lint
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
from .observations import Observation
from .observers import GeneralObserver, Limits, Manner, Observer, Property
from .repair import Policy
from .system_watch import Watch, watch

__all__ = [
    "ChangeModel",
    "DIAGNOSIS",
    "Diagnoser",
    "DiagnoserActor",
    "Diagnosis",
    "EXPLANATION",
    "Expectation",
    "Explained",
    "GRACE",
    "GeneralObserver",
    "Generated",
    "GetDiagnosis",
    "GetExplanation",
    "GetModel",
    "GetObserved",
    "GetVersions",
    "Grace",
    "Limits",
    "LoadModel",
    "MODEL",
    "Manner",
    "Model",
    "ModelChanged",
    "ModelRefused",
    "ModelServer",
    "NextBest",
    "OBSERVATIONS",
    "OBSERVERS",
    "Observation",
    "Observer",
    "ObserverCrashed",
    "Policy",
    "Property",
    "REPAIR",
    "ROS_DIAGNOSTICS",
    "RollBackModel",
    "RosDiagnostics",
    "State",
    "System",
    "TOUCHED",
    "Touched",
    "ValidateModel",
    "Watch",
    "Wired",
    "expecting",
    "generate",
    "lint",
    "observer",
    "observers_for",
    "ok",
    "parse",
    "property_observers",
    "tree",
    "watch",
]
