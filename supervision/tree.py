"""Supervisors as data: built in Python, from a mapping, or from a TOML file."""

from __future__ import annotations

from collections.abc import Iterable

from ..actors.errors import SpecError
from ..actors.kernel.actor import Start
from ..actors.process.resource_limits import Limits
from .rules import Rule
from .spec import AutoShutdown, ChildSpec, Flags, Isolation, Restart, Shutdown, Strategy, checked
from .supervisor import Supervisor
from .supervisor_changes import check_subtree


def supervisor(
    name: str,
    *,
    strategy: Strategy = "one_for_one",
    intensity: int = 1,
    period: float = 5.0,
    auto_shutdown: AutoShutdown = "never",
    children: Iterable[ChildSpec] = (),
    restart: Restart = "permanent",
    shutdown: Shutdown = "infinity",
    isolation: Isolation = "task",
    limits: Limits | None = None,
    significant: bool = False,
    rules: Iterable[Rule] = (),
    kind: type[Supervisor] = Supervisor,
) -> ChildSpec:
    """Describe a supervisor with its children: start the spec with `system.start`, or nest it in another one.

    Args:
        name: the last part of its address.
        strategy: "one_for_one", "one_for_all" or "rest_for_one".
        intensity: restarts allowed within `period` seconds; one more and it gives up.
        period: seconds, > 0.
        auto_shutdown: it ends when "any_significant" or "all_significant" children have ended by themselves, or
            "never".
        children: specs, in start order.
        restart, shutdown, significant, rules: as a child of its own supervisor.
        isolation: "process" puts the whole subtree into one OS process.
        limits: of that process.
        kind: a supervisor class of its own that takes flags and children.

    Raises:
        SpecError: naming the option and what it may be.
    """
    where = f"supervisor {name!r}"
    try:
        flags = Flags(strategy, intensity, period, auto_shutdown)
    except SpecError as error:
        raise SpecError(where, error.problem) from None
    specs = checked(where, children, auto_shutdown)
    if isolation == "process":
        check_subtree(where, specs)
    start = Start(kind, (flags, specs))
    return ChildSpec(
        name,
        start,
        restart,
        shutdown,
        isolation,
        limits=limits,
        is_supervisor=True,
        significant=significant,
        rules=tuple(rules),
    )
