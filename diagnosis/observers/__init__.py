"""Observers: actors that look at a system from outside, and say what they see as literals on `/observations`.

A new one is one class: derive from `Observer`, override `hear` or `look`, and call `verdict`.
"""

from .diagnostic import Check, DiagnosticObserver
from .flow import Baselines, FlowObserver
from .general import GeneralObserver, Learned
from .hardware import Channel, HardwareObserver
from .multiple import ConditionedObserver, TriggeredObserver
from .node_observer import NodeObserver
from .observer import Look, Manner, Observer
from .property import Bound, Property, PropertyObserver
from .regression import Fit, Regression
from .replicas import ReplicaObserver
from .runtime import RuntimeObserver
from .score import ScoreObserver
from .timeout import TimeoutObserver
from .trends import BinaryQualitativeObserver, QualitativeObserver, Source, trend
from .verdicts import Agreement, Debounce, Limits, Median, Smooth

__all__ = [
    "Agreement",
    "Baselines",
    "BinaryQualitativeObserver",
    "Bound",
    "Channel",
    "Check",
    "ConditionedObserver",
    "Debounce",
    "DiagnosticObserver",
    "Fit",
    "FlowObserver",
    "GeneralObserver",
    "HardwareObserver",
    "Learned",
    "Limits",
    "Look",
    "Manner",
    "Median",
    "NodeObserver",
    "Observer",
    "Property",
    "PropertyObserver",
    "QualitativeObserver",
    "Regression",
    "ReplicaObserver",
    "RuntimeObserver",
    "ScoreObserver",
    "Smooth",
    "Source",
    "TimeoutObserver",
    "TriggeredObserver",
    "trend",
]
