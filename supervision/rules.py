"""Restart rules: what follows from an end when its reason decides instead of the restart type."""

from __future__ import annotations

import builtins
import dataclasses
import sys
from typing import Literal, get_args

from ..actors.errors import SpecError, type_name
from ..actors.exit_reasons import Crash, ExitReason, OutOfMemory

Action = Literal["restart", "stop", "escalate"]
"""What a rule may say: start the child again, leave it stopped, or end the supervisor with the child's own reason."""


@dataclasses.dataclass(frozen=True, slots=True)
class Rule:
    """One rule, as plain data: it travels with its spec into another process. Made by `rule`.

    Attributes:
        reason: an exit reason, or the name of a class of exit reasons or exceptions.
        action: what follows.
    """

    reason: str | ExitReason
    action: Action

    def fits(self, reason: ExitReason) -> bool:
        """Say whether the rule is about this end."""
        if isinstance(self.reason, ExitReason):
            return self.reason == reason
        return any(self.reason in (name, name.rpartition(".")[2]) for name in names_of(reason))


def rule(reason: ExitReason | type[ExitReason] | type[BaseException] | str, action: Action) -> Rule:
    """Make a restart rule for a child spec; of several the first that fits decides, then the restart type.

    Args:
        reason: an exit reason (`hf.Signal(9)`), a class of them (`hf.Signal`), an exception class (it stands for the
            classes derived from it too), or the name of a class, with or without its module.
        action: "restart", "stop" or "escalate".

    Raises:
        SpecError: naming what does not fit.

    >>> rule(ValueError, "stop").fits(Crash("ValueError", "boom"))
    True
    >>> from holdfast.actors.exit_reasons import KILLED, Signal
    >>> rule(Signal, "escalate").fits(KILLED), rule(Signal, "escalate").fits(Signal(9))
    (False, True)
    """
    if action not in get_args(Action):
        raise SpecError("rule", f"the action must be one of {', '.join(get_args(Action))}, not {action!r}")
    if isinstance(reason, type) and issubclass(reason, ExitReason):
        return Rule(reason.__name__, action)
    if isinstance(reason, type) and issubclass(reason, BaseException):
        return Rule(type_name(reason), action)
    if isinstance(reason, Crash):
        raise SpecError("rule", "a Crash is never equal to another one: give the exception's class or name")
    if not isinstance(reason, ExitReason) and not (isinstance(reason, str) and reason):
        raise SpecError("rule", f"the reason must be an exit reason, an exception class, or a name, not {reason!r}")
    return Rule(reason, action)


def names_of(reason: ExitReason) -> set[str]:
    """The names of all classes that an end belongs to: of its reason, and of the exception behind it."""
    names = {kind.__name__ for kind in type(reason).__mro__ if issubclass(kind, ExitReason)}
    if isinstance(reason, OutOfMemory):
        names.add("MemoryError")
    if isinstance(reason, Crash):
        names.add(reason.type_name)
        kind = type(reason.error) if reason.error is not None else _loaded(reason.type_name)
        names.update(type_name(base) for base in (kind.__mro__ if kind is not None else ()))
    return names


def _loaded(name: str) -> type[BaseException] | None:
    """The exception class of this name, if it is loaded here: a crash in another process brings its name only."""
    module, _, path = name.rpartition(".")
    while module and module not in sys.modules:  # A class inside another one.
        module, _, outer = module.rpartition(".")
        path = f"{outer}.{path}"
    found: object = sys.modules[module] if module else builtins
    for part in path.split("."):
        found = getattr(found, part, None)
    return found if isinstance(found, type) and issubclass(found, BaseException) else None
