"""The model of a system: declared in Python or YAML, checked, linted, and kept in versions."""

from .check import Model, ModelError
from .clauses import Rule
from .declaration import Clause, Component, Declaration, Expectation, Kind, Relation, Spelling, System, Value
from .file import load, read
from .lint import Finding, Flaw, lint
from .model_history import (
    Add,
    Change,
    Declare,
    Drop,
    Expect,
    History,
    NoSuchVersion,
    Put,
    Relate,
    Remove,
    Replace,
    Version,
)

__all__ = [
    "Add",
    "Change",
    "Clause",
    "Component",
    "Declaration",
    "Declare",
    "Drop",
    "Expect",
    "Expectation",
    "Finding",
    "Flaw",
    "History",
    "Kind",
    "Model",
    "ModelError",
    "NoSuchVersion",
    "Put",
    "Relate",
    "Relation",
    "Remove",
    "Replace",
    "Rule",
    "Spelling",
    "System",
    "Value",
    "Version",
    "lint",
    "load",
    "read",
]
