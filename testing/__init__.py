"""Tools for testing actors: see docs/testing.md.

The names below are imported when they are first used: pytest loads `holdfast.testing.plugin`, and with it this module,
before coverage begins to measure.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .barrier import NotIdle, idle
    from .clock import NothingToWaitFor, VirtualClockLoop, advance, virtual
    from .faults import POINTS, Faults, Point, Strike, Strikes
    from .guarded import GuardedSystem, UnexpectedEnd
    from .histories.checker import ImpureModel, Linearization, NotLinearizable, TooHard, Violation, linearizable
    from .histories.history import UNKNOWN, History, Model, Operation
    from .machines.machine import ActorMachine
    from .probes import Down, Exit, Probe, Unexpected, probe
    from .simulation import Simulation, simulate

_HOME = {
    "ActorMachine": "machines.machine",
    "Down": "probes",
    "Exit": "probes",
    "Faults": "faults",
    "GuardedSystem": "guarded",
    "History": "histories.history",
    "ImpureModel": "histories.checker",
    "Linearization": "histories.checker",
    "Model": "histories.history",
    "NotIdle": "barrier",
    "NotLinearizable": "histories.checker",
    "NothingToWaitFor": "clock",
    "Operation": "histories.history",
    "POINTS": "faults",
    "Point": "faults",
    "Probe": "probes",
    "Simulation": "simulation",
    "Strike": "faults",
    "Strikes": "faults",
    "TooHard": "histories.checker",
    "UNKNOWN": "histories.history",
    "Unexpected": "probes",
    "UnexpectedEnd": "guarded",
    "Violation": "histories.checker",
    "VirtualClockLoop": "clock",
    "advance": "clock",
    "idle": "barrier",
    "linearizable": "histories.checker",
    "probe": "probes",
    "simulate": "simulation",
    "virtual": "clock",
}

__all__ = [
    "ActorMachine",
    "Down",
    "Exit",
    "Faults",
    "GuardedSystem",
    "History",
    "ImpureModel",
    "Linearization",
    "Model",
    "NotIdle",
    "NotLinearizable",
    "NothingToWaitFor",
    "Operation",
    "POINTS",
    "Point",
    "Probe",
    "Simulation",
    "Strike",
    "Strikes",
    "TooHard",
    "UNKNOWN",
    "Unexpected",
    "UnexpectedEnd",
    "Violation",
    "VirtualClockLoop",
    "advance",
    "idle",
    "linearizable",
    "probe",
    "simulate",
    "virtual",
]


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f".{home}", __name__), name)
    except ModuleNotFoundError as missing:
        package = (missing.name or "").partition(".")[0]
        if package == __name__.partition(".")[0]:
            raise
        raise ImportError(f"holdfast.testing needs the package {package}: pip install 'holdfast[testing]'") from missing
