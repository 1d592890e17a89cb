"""Help for testing actors: see docs/testing.md.

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
    from .probes import Down, Exit, Probe, Received, Unexpected, probe
    from .simulation import Simulation, simulate

_HOME = {
    "Down": "probes",
    "Exit": "probes",
    "Faults": "faults",
    "GuardedSystem": "guarded",
    "NotIdle": "barrier",
    "NothingToWaitFor": "clock",
    "POINTS": "faults",
    "Point": "faults",
    "Probe": "probes",
    "Received": "probes",
    "Simulation": "simulation",
    "Strike": "faults",
    "Strikes": "faults",
    "Unexpected": "probes",
    "UnexpectedEnd": "guarded",
    "VirtualClockLoop": "clock",
    "advance": "clock",
    "idle": "barrier",
    "probe": "probes",
    "simulate": "simulation",
    "virtual": "clock",
}

__all__ = [
    "Down",
    "Exit",
    "Faults",
    "GuardedSystem",
    "NotIdle",
    "NothingToWaitFor",
    "POINTS",
    "Point",
    "Probe",
    "Received",
    "Simulation",
    "Strike",
    "Strikes",
    "Unexpected",
    "UnexpectedEnd",
    "VirtualClockLoop",
    "advance",
    "idle",
    "probe",
    "simulate",
    "virtual",
]


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{home}", __name__), name)
