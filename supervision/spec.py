"""Child specs: what a supervisor keeps alive, as plain validated data."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Generic, Literal, Protocol, get_args

from typing_extensions import TypeVar

from ..actors.backoff import Backoff
from ..actors.errors import SpecError, type_name
from ..actors.events import ShutdownError
from ..actors.exit_reasons import KILLED, SHUTDOWN, ExitReason
from ..actors.kernel.actor import Actor, Start, signature_of
from ..actors.kernel.cell import Cell, GivenName, Scope
from ..actors.kernel.lifecycle import GRACE
from ..actors.kernel.mailbox import Bounded
from ..actors.process.resource_limits import Limits
from ..actors.process.wire.start_codec import pack_recipe
from ..actors.seconds import check_seconds, is_seconds
from ..actors.values import UnsavableValue
from ..actors.values.path_parts import check_path_part, has_control
from .decisions import decide, is_as_told
from .patience import end_within
from .rules import Rule

A = TypeVar("A", bound=Actor)
T = TypeVar("T")
A_co = TypeVar("A_co", bound=Actor, default=Any, covariant=True)

Restart = Literal["permanent", "transient", "temporary"]
Strategy = Literal["one_for_one", "one_for_all", "rest_for_one"]
AutoShutdown = Literal["never", "any_significant", "all_significant"]
Isolation = Literal["task", "process"]
Shutdown = float | Literal["brutal_kill", "infinity"]
StartTimeout = float | Literal["infinity"]


class Recovers(Protocol):
    """What a child spec asks of a recovery method, such as `hybrid()`."""

    def check(self, where: str, kind: type[Actor]) -> None:
        """Refuse a class that cannot be recovered so."""


class Protects(Protocol):
    """What a child spec asks of a fault-tolerance mechanism, such as `PBR()`."""

    def check(self, kind: type[Actor], where: str) -> None:
        """Refuse a class that cannot be protected so."""


NAMELESS = "*"
"""The id of a spec without one: a dynamic supervisor makes one up at each start."""
PATIENCE = 5.0
"""Seconds a child may take to stop in good order when its spec does not say; a supervisor takes what it needs."""
START_TIMEOUT = 60.0
"""Seconds a child may take to start when its spec does not say; a supervisor takes what its children need."""


@dataclasses.dataclass(frozen=True, slots=True)
class Flags:
    """A supervisor's own settings: strategy, and at most `intensity` restarts within `period` seconds.

    `auto_shutdown` says whether it ends with its significant children; dynamic ones have `max_children` and `journal`.
    """

    strategy: Strategy = "one_for_one"
    intensity: int = 1
    period: float = 5.0
    auto_shutdown: AutoShutdown = "never"
    max_children: int | None = None
    journal: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.journal, bool):
            raise SpecError("supervisor", f"journal must be True or False, not {self.journal!r}")
        _choose("supervisor", "strategy", self.strategy, Strategy)
        _choose("supervisor", "auto_shutdown", self.auto_shutdown, AutoShutdown)
        most = self.max_children
        if most is not None and (not isinstance(most, int) or isinstance(most, bool) or most < 0):
            raise SpecError("supervisor", f"max_children must be a whole number >= 0 or None, not {most!r}")
        if not isinstance(self.intensity, int) or isinstance(self.intensity, bool) or self.intensity < 0:
            raise SpecError("supervisor", f"intensity must be a whole number >= 0, not {self.intensity!r}")
        check_seconds("supervisor", "period", self.period)


def _own(default: T) -> T:
    """A field that the runtime fills in: the text of a spec leaves it out."""
    return dataclasses.field(default=default, repr=False)


@dataclasses.dataclass(frozen=True, slots=True)
class ChildSpec(Generic[A_co]):
    """One child: how it starts, when it is restarted, how it is stopped, where it lives. Made by `child`.

    It is typed by the actor's class, as the ref is that `ActorSystem.start` makes of it.
    """

    id: str
    start: Start[A_co]
    restart: Restart = "permanent"
    shutdown: Shutdown = 5.0
    isolation: Isolation = "task"
    recovery: Any = None
    mailbox: Bounded | None = None
    backoff: Backoff | None = None
    limits: Limits | None = None
    bindings: Mapping[str, str] = dataclasses.field(default_factory=dict[str, str])
    is_supervisor: bool = False
    significant: bool = False
    rules: tuple[Rule, ...] = ()
    mechanism: Any = None
    comes_back: bool = _own(True)  # whether its supervisor starts it again when that has itself been restarted
    made_up: bool = _own(False)  # whether its supervisor has made its id up
    start_timeout: StartTimeout | None = None  # None becomes what the kind of child has by default
    autostart: bool = True  # whether its supervisor starts it with the others, or only by order
    late: frozenset[str] = _own(
        frozenset()
    )  # ports that transactions have bound: whom they lead to may be started later
    register: GivenName | None = None  # what each life has beside its address
    scope: dataclasses.InitVar[Scope | None] = None  # of a spec that was stored before, beside a text as `register`

    def __post_init__(self, scope: Scope | None) -> None:
        where = f"child {self.id!r}"
        check_path_part(where, "the id", self.id)
        if not isinstance(self.start, Start) or not issubclass(self.start.kind, Actor):
            raise SpecError(where, f"start must come from start(Class, ...), not be {self.start!r}")
        try:
            self.start.check(is_partial=self.id == NAMELESS)  # Of a template: the rest comes with each start.
        except TypeError as error:
            raise SpecError(
                where, f"start({type_name(self.start.kind)}, ...): {error}; it takes {signature_of(self.start.kind)}"
            ) from error
        _choose(where, "restart", self.restart, Restart)
        _choose(where, "isolation", self.isolation, Isolation)
        check_shutdown(where, self.shutdown)
        if self.start_timeout is None:
            object.__setattr__(self, "start_timeout", "infinity" if self.is_supervisor else START_TIMEOUT)
        if self.start_timeout != "infinity" and not is_seconds(self.start_timeout):
            raise SpecError(where, f"start_timeout must be seconds > 0 or 'infinity', not {self.start_timeout!r}")
        if not isinstance(self.autostart, bool):
            raise SpecError(where, f"autostart must be True or False, not {self.autostart!r}")
        object.__setattr__(self, "register", given_name(where, self.register, scope))
        if not isinstance(self.significant, bool):
            raise SpecError(where, f"significant must be True or False, not {self.significant!r}")
        if self.significant and self.restart == "permanent":
            raise SpecError(where, "a permanent child cannot be significant: it never ends; make it transient")
        if not all(isinstance(one, Rule) for one in self.rules):
            raise SpecError(where, f"rules must come from rule(reason, action), not be {self.rules!r}")
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
        if self.mechanism is not None:
            check_mechanism(where, self.mechanism, self.start.kind, is_supervisor=self.is_supervisor)
        if self.isolation == "process" or self.mechanism is not None:
            try:
                pack_recipe(self.start, where)
            except UnsavableValue as error:
                advice = "give plain data, and have `__init__` make the rest of it there"
                raise SpecError(error.where, f"{error.problem} cannot be sent to another process: {advice}") from error

    @property
    def has_home(self) -> bool:
        """Say whether what is sent to the child waits outside of its lives, so that its starts may take their time."""
        return self.recovery is not None or self.mechanism is not None

    def below(self) -> Iterator[ChildSpec]:
        """Yield the children that the spec of a supervisor names, its template among them."""
        return _specs_in((*self.start.args, *self.start.kwargs.values()))

    def restarts(self, reason: ExitReason) -> bool:
        """Say whether an end by itself for this reason is followed by another life."""
        return decide(self.restart, self.rules, reason) == "restart"

    async def stop(self, cell: Cell, reason: ExitReason = SHUTDOWN) -> ExitReason:
        """Stop the child as its spec says: ask, wait, kill. Returns the reason it ended with."""
        gone = self.begin_stop(cell, reason)
        if isinstance(self.shutdown, str):
            ended = await gone
        else:
            timer = cell.node.loop.call_later(self.shutdown, cell.kill)
            try:
                ended = await gone
            finally:
                timer.cancel()
        self.judge(cell, reason, ended)
        return ended

    def begin_stop(self, cell: Cell, reason: ExitReason = SHUTDOWN) -> asyncio.Future[ExitReason]:
        """Tell the child to stop, or kill it if its spec says so; whoever calls keeps the time, if it gives any."""
        gone = cell.ended()
        if self.shutdown == "brutal_kill":
            cell.kill()
        else:
            cell.request_stop(reason)
        if self.is_supervisor and self.shutdown == "infinity":
            end_within(cell, gone)
        elif self.shutdown != "infinity" and not gone.done():
            seconds = GRACE if isinstance(self.shutdown, str) else self.shutdown
            void = cell.node.begin_limit(f"{cell.path} had {seconds:g} s to stop", seconds)
            gone.add_done_callback(lambda _: void())
        return gone

    def judge(self, cell: Cell, told: ExitReason, ended: ExitReason) -> None:
        """Report a child that was told to stop and ended for another reason."""
        expected = KILLED if self.shutdown == "brutal_kill" else told
        if not is_as_told(self.restart, expected, ended):
            cell.node.emit(ShutdownError(cell.path, ended))


def given_name(where: str, register: object, scope: Any) -> GivenName | None:
    """The name that a spec gives, of a text and who finds it by that; None scopes are "system".

    Raises:
        SpecError: it is no name, nobody is in that scope, or there is a scope and no name.
    """
    if isinstance(register, GivenName):
        scope = register.scope
        register = register.text
    if register is not None and (
        not isinstance(register, str) or not register or register.startswith("/") or has_control(register)
    ):
        problem = "must be text without control characters that does not begin with '/', or left out"
        raise SpecError(where, f"register {problem}, not {register!r}")
    scope = "system" if scope is None else scope
    _choose(where, "scope", scope, Scope)
    if register is None and scope != "system":
        raise SpecError(where, f"scope={scope!r} says who finds it by a name, and register='NAME' is missing")
    return None if register is None else GivenName(register, scope)


def _specs_in(values: Iterable[Any]) -> Iterator[ChildSpec]:
    for value in values:
        if isinstance(value, ChildSpec):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from _specs_in(value)


def child(
    id: str | None,
    start: Start[A],
    *,
    restart: Restart = "permanent",
    shutdown: Shutdown | None = None,
    isolation: Isolation = "task",
    recovery: Recovers | None = None,
    mailbox: Bounded | None = None,
    backoff: Backoff | None = None,
    limits: Limits | None = None,
    bindings: Mapping[str, str] | None = None,
    significant: bool = False,
    rules: Iterable[Rule] = (),
    mechanism: Protects | tuple[Protects, ...] | None = None,
    start_timeout: StartTimeout | None = None,
    autostart: bool = True,
    register: str | None = None,
    scope: Scope = "system",
) -> ChildSpec[A]:
    """Describe one child of a supervisor: how it starts, lives, comes back, and is stopped.

    Args:
        id: the last part of the address, unique among siblings; None lets a dynamic supervisor make one up.
        start: the recipe, from `start(Class, ...)`.
        restart: "permanent" always, "transient" after an abnormal end, "temporary" never.
        shutdown: seconds for an orderly stop before the kill, "brutal_kill" or "infinity"; if left out 5 seconds, and
            "infinity" for a supervisor.
        isolation: "task" in this process, "process" in an OS process of its own.
        recovery: `fresh()` (the default), `hybrid(...)`: what comes back after a crash.
        mailbox: `bounded(...)`; unbounded if left out.
        backoff: waits before restarts; none if left out.
        limits: of the OS process.
        bindings: port name to address, bound at each start.
        significant: its end by itself can end its supervisor (`auto_shutdown`); not for permanent children.
        rules: from `rule(...)`; the first that fits an end decides, then `restart`.
        mechanism: a fault-tolerance mechanism such as `PBR()`, or several, outermost first: the actor is lived by
            replicas in processes of their own.
        start_timeout: seconds that `__init__` and `on_start` may take (with a process of its own, that too), or
            "infinity"; if left out 60, and "infinity" for a supervisor, whose children have limits of their own. A
            start that takes longer is killed, and has failed. A child that is brought back may take longer altogether,
            but not longer without having handled one more input again; pauses that a paced replay repeats do not count.
        autostart: whether its supervisor starts it with the others. If not, it is known and stopped, at each start of
            its supervisor, until it is started by order (`RestartChild`, or `start` in a transaction).
        register: a name that each of its lives has, as `system.register` gives it to one; nobody has it between two.
            If it is taken, the start fails.
        scope: who finds it by that name: "system", or "fleet": other systems and clients that are connected, too.

    Raises:
        MechanismRefused: the class does not have what the mechanism needs.
        SpecError: naming the child, the option, and what it may be.
    """
    is_supervisor = isinstance(start, Start) and start.kind._supervises
    if shutdown is None:
        shutdown = "infinity" if is_supervisor else PATIENCE
    return ChildSpec(
        NAMELESS if id is None else id,
        start,
        restart,
        shutdown,
        isolation,
        recovery,
        mailbox,
        backoff,
        limits,
        dict(bindings) if isinstance(bindings, Mapping) else bindings or {},
        is_supervisor,
        significant,
        tuple(rules),
        mechanism,
        start_timeout=start_timeout,
        autostart=autostart,
        register=given_name(f"child {NAMELESS if id is None else id!r}", register, scope),
    )


@dataclasses.dataclass(frozen=True, slots=True, init=False)
class Plan:
    """The children of a supervisor in start order, and its flags: its `init` returns them. Checked when it is made.

    Raises:
        SpecError: naming the option, or the child, and what it may be.
    """

    children: tuple[ChildSpec, ...]
    flags: Flags

    def __init__(
        self,
        children: Iterable[ChildSpec] = (),
        *,
        strategy: Strategy = "one_for_one",
        intensity: int = 1,
        period: float = 5.0,
        auto_shutdown: AutoShutdown = "never",
        max_children: int | None = None,
        journal: bool = False,
    ) -> None:
        flags = Flags(strategy, intensity, period, auto_shutdown, max_children, journal)
        object.__setattr__(self, "flags", flags)
        object.__setattr__(self, "children", checked("supervisor", children, auto_shutdown, nameless=True))

    @classmethod
    def of(cls, flags: Flags, children: Iterable[ChildSpec]) -> Plan:
        """Make a plan from flags that are there already."""
        return cls(children, **{field.name: getattr(flags, field.name) for field in dataclasses.fields(flags)})


def check_children(children: Iterable[ChildSpec], auto_shutdown: AutoShutdown | None = None) -> None:
    """Check child specs as a supervisor would, without starting anything.

    Args:
        children: the specs.
        auto_shutdown: that of the supervisor; None leaves out whether significant children go with it.

    Raises:
        SpecError: naming the child and what is wrong.
    """
    if auto_shutdown is not None:
        _choose("check_children", "auto_shutdown", auto_shutdown, AutoShutdown)
    checked("check_children", children, auto_shutdown)


def checked(
    where: str, children: Iterable[ChildSpec], auto_shutdown: AutoShutdown | None, *, nameless: bool = False
) -> tuple[ChildSpec, ...]:
    """The children, if each is a spec, no id comes twice, and significant ones fit their supervisor.

    Raises:
        SpecError: naming the child and what is wrong.
    """
    if isinstance(children, (str, bytes, ChildSpec)) or not isinstance(children, Iterable):
        raise SpecError(where, f"children must be a list of child specs, not {children!r}")
    specs = tuple(children)
    seen: set[str] = set()
    for spec in specs:
        check_spec(where, spec, auto_shutdown, nameless=nameless)
        if spec.id in seen:
            if spec.id == NAMELESS:
                raise SpecError(where, "a dynamic supervisor takes one template, the child without an id, and not two")
            raise SpecError(where, f"two children have the id {spec.id!r}")
        seen.add(spec.id)
    return specs


def check_spec(where: str, spec: object, auto_shutdown: AutoShutdown | None, *, nameless: bool = False) -> None:
    """Whether a supervisor can take this child.

    Raises:
        SpecError: it is no spec, has no id, or is significant where nothing can follow from that.
    """
    if not isinstance(spec, ChildSpec):
        raise SpecError(where, f"children must come from child(...) or supervisor(...), not be {spec!r}")
    if spec.id == NAMELESS and not nameless:
        raise SpecError(where, "only children of a dynamic supervisor can go without an id")
    if spec.significant and auto_shutdown == "never":
        raise SpecError(where, f"child {spec.id!r} is significant, but auto_shutdown is 'never'")


def check_mechanism(where: str, mechanism: Any, kind: type[Actor], *, is_supervisor: bool) -> None:
    """Whether an actor of this class can be protected so.

    Raises:
        SpecError: it is no mechanism, or the child is a supervisor. MechanismRefused: what is missing.
    """
    layers = mechanism if isinstance(mechanism, tuple) else (mechanism,)
    for layer in layers:
        if isinstance(layer, type) or not hasattr(layer, "check") or not hasattr(layer, "replicas"):
            hint = (
                "; a class by its name is `find(name)` of `holdfast.ftm.model.mechanism`"
                if isinstance(layer, str)
                else ""
            )
            problem = f"mechanism must be one such as PBR(), a tuple of them or left out, not {layer!r}{hint}"
            raise SpecError(where, problem)
        layer.check(kind, where)
    if not layers:
        raise SpecError(where, "mechanism must not be empty: leave it out")
    if is_supervisor:
        raise SpecError(where, "a supervisor cannot be protected by a mechanism: protect its children")


def check_shutdown(where: str, shutdown: object) -> None:
    """Refuse what does not say how long to wait before something that ends is killed. Raises SpecError."""
    if shutdown not in ("brutal_kill", "infinity") and not is_seconds(shutdown, or_zero=True):
        raise SpecError(where, f"shutdown must be seconds >= 0, 'brutal_kill' or 'infinity', not {shutdown!r}")


def _of_kind(where: str, name: str, value: object, kind: type, form: str) -> None:
    if value is not None and not isinstance(value, kind):
        raise SpecError(where, f"{name} must be {form} or left out, not {value!r}")


def _choose(where: str, name: str, value: object, choices: Any) -> None:
    if value not in get_args(choices):
        raise SpecError(where, f"{name} must be one of {', '.join(get_args(choices))}, not {value!r}")
