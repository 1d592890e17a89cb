"""Child specs: what a supervisor keeps alive, as plain validated data."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeGuard, get_args

from ..actors.actor import Actor, Start
from ..actors.cell import Cell
from ..actors.errors import SpecError, type_name
from ..actors.exits import SHUTDOWN, ExitReason
from ..actors.mailbox import Bounded
from ..actors.process.limits import Limits
from ..actors.process.recipe import pack_recipe
from ..actors.values import UnsavableValue
from .backoff import Backoff

Restart = Literal["permanent", "transient", "temporary"]
Strategy = Literal["one_for_one", "one_for_all", "rest_for_one"]
Isolation = Literal["task", "process"]
Shutdown = float | Literal["brutal_kill", "infinity"]


@dataclasses.dataclass(frozen=True, slots=True)
class Flags:
    """A supervisor's own settings: strategy, and at most `intensity` restarts within `period` seconds."""

    strategy: Strategy = "one_for_one"
    intensity: int = 1
    period: float = 5.0

    def __post_init__(self) -> None:
        _choose("supervisor", "strategy", self.strategy, Strategy)
        if not isinstance(self.intensity, int) or isinstance(self.intensity, bool) or self.intensity < 0:
            raise SpecError("supervisor", f"intensity must be a whole number >= 0, not {self.intensity!r}")
        if not _number(self.period) or not 0 < self.period < float("inf"):
            raise SpecError("supervisor", f"period must be a finite number of seconds > 0, not {self.period!r}")


@dataclasses.dataclass(frozen=True, slots=True)
class ChildSpec:
    """One child: how it starts, when it is restarted, how it is stopped, where it lives. Made by `child`."""

    id: str
    start: Start[Any]
    restart: Restart = "permanent"
    shutdown: Shutdown = 5.0
    isolation: Isolation = "task"
    recovery: Any = None
    mailbox: Bounded | None = None
    backoff: Backoff | None = None
    limits: Limits | None = None
    bindings: Mapping[str, str] = dataclasses.field(default_factory=dict[str, str])
    is_supervisor: bool = False

    def __post_init__(self) -> None:
        where = f"child {self.id!r}"
        if not isinstance(self.id, str) or not self.id or "/" in self.id:
            raise SpecError(where, "the id must be text without '/'")
        if not isinstance(self.start, Start) or not issubclass(self.start.kind, Actor):
            raise SpecError(where, f"start must come from start(Class, ...), not be {self.start!r}")
        try:
            self.start.check()
        except TypeError as error:
            raise SpecError(where, f"start({type_name(self.start.kind)}, ...): {error}") from error
        _choose(where, "restart", self.restart, Restart)
        _choose(where, "isolation", self.isolation, Isolation)
        if self.shutdown not in ("brutal_kill", "infinity") and not (_number(self.shutdown) and self.shutdown >= 0):
            raise SpecError(where, f"shutdown must be seconds >= 0, 'brutal_kill' or 'infinity', not {self.shutdown!r}")
        _of_kind(where, "mailbox", self.mailbox, Bounded, "bounded(...)")
        _of_kind(where, "backoff", self.backoff, Backoff, "Backoff(...)")
        _of_kind(where, "limits", self.limits, Limits, "Limits(...)")
        _of_kind(where, "bindings", self.bindings, Mapping, "a mapping of port names to addresses")
        unknown = sorted(set(self.bindings) - self.start.kind._bindings, key=str)
        if unknown:
            raise SpecError(where, f"{type_name(self.start.kind)} has no binding {unknown[0]!r}")
        for port, path in self.bindings.items():
            if not isinstance(path, str) or not path.startswith("/"):
                raise SpecError(where, f"bindings must name an address such as '/app/bank' for {port!r}, not {path!r}")
        if self.recovery is not None:
            if not hasattr(self.recovery, "check"):
                raise SpecError(
                    where, f"recovery must be a method such as hybrid(...) or left out, not {self.recovery!r}"
                )
            self.recovery.check(where, self.start.kind)
        if self.isolation == "process":
            try:
                pack_recipe(self.start, where)
            except UnsavableValue as error:
                raise SpecError(error.where, f"{error.problem} cannot be sent to another process") from error

    async def stop(self, cell: Cell, reason: ExitReason = SHUTDOWN) -> ExitReason:
        """Stop the child as its spec says: ask, wait, kill. Returns the reason it ended with."""
        gone = cell.ended()
        if self.shutdown == "brutal_kill":
            cell.kill()
            return await gone
        cell.request_stop(reason)
        if self.shutdown == "infinity":
            return await gone
        timer = cell.node.loop.call_later(float(self.shutdown), cell.kill)
        try:
            return await gone
        finally:
            timer.cancel()


def child(
    id: str,
    start: Start[Any],
    *,
    restart: Restart = "permanent",
    shutdown: Shutdown = 5.0,
    isolation: Isolation = "task",
    recovery: Any = None,
    mailbox: Bounded | None = None,
    backoff: Backoff | None = None,
    limits: Limits | None = None,
    bindings: Mapping[str, str] | None = None,
) -> ChildSpec:
    """A child spec.

    Args:
        id: the last part of the address, unique among siblings.
        start: the recipe, from `start(Class, ...)`.
        restart: "permanent" always, "transient" after an abnormal end, "temporary" never.
        shutdown: seconds for an orderly stop before the kill, "brutal_kill" or "infinity".
        isolation: "task" in this process, "process" in an OS process of its own.
        recovery: `fresh()` (the default), `hybrid(...)`: what comes back after a crash.
        mailbox: `bounded(...)`; unbounded if left out.
        backoff: waits before restarts; none if left out.
        limits: of the OS process.
        bindings: port name to address, bound at each start.

    Raises:
        SpecError: naming the child, the option, and what it may be.
    """
    return ChildSpec(
        id,
        start,
        restart,
        shutdown,
        isolation,
        recovery,
        mailbox,
        backoff,
        limits,
        dict(bindings) if isinstance(bindings, Mapping) else bindings or {},
    )


def check_ids(where: str, children: Iterable[ChildSpec]) -> tuple[ChildSpec, ...]:
    """The children, if each is a spec and no id comes twice."""
    specs = tuple(children)
    seen: set[str] = set()
    for spec in specs:
        if not isinstance(spec, ChildSpec):
            raise SpecError(where, f"children must come from child(...) or supervisor(...), not be {spec!r}")
        if spec.id in seen:
            raise SpecError(where, f"two children have the id {spec.id!r}")
        seen.add(spec.id)
    return specs


def _of_kind(where: str, name: str, value: object, kind: type, form: str) -> None:
    if value is not None and not isinstance(value, kind):
        raise SpecError(where, f"{name} must be {form} or left out, not {value!r}")


def _number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _choose(where: str, name: str, value: object, choices: Any) -> None:
    if value not in get_args(choices):
        raise SpecError(where, f"{name} must be one of {', '.join(get_args(choices))}, not {value!r}")
