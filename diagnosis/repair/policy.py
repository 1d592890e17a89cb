"""The policy of repair: attempts, waits, modes, and components to leave alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Final, Literal

NORMAL: Final = "normal"
SAFE: Final = "safe"

Stance = Literal["off", "advise", "ask", "on"]
"""How far repair goes: it does nothing, says what it would do, has a person approve each plan, or acts."""
STANCES: Final[tuple[Stance, ...]] = ("off", "advise", "ask", "on")


def check_stance(stance: str) -> Stance:
    """Return the stance itself. Raises ValueError: it is none of "off", "advise", "ask" and "on"."""
    for one in STANCES:
        if stance == one:
            return one
    raise ValueError(f"repair is one of {', '.join(map(repr, STANCES))}, not {stance!r}; rules are given by policy=")


@dataclasses.dataclass(frozen=True, slots=True)
class Caution:
    """How repair sees to it that nobody is restarted who works.

    Attributes:
        confirm: seconds for which a diagnosis must stand before an actor that answers is restarted; or what shows it,
            if no candidate leaves that actor out.
        ping: seconds an actor has to answer, or to get on with its turn, before it is restarted.
        grace: seconds after anybody has started a component in which no plan is made, if it is suspected, or a symptom
            depends on it.
    """

    confirm: float = 1.0
    ping: float = 0.25
    grace: float = 1.5

    def __post_init__(self) -> None:
        if not 0 < self.ping < float("inf"):
            raise ValueError(f"ping must be a finite number of seconds > 0, not {self.ping!r}")
        for name, seconds in (("confirm", self.confirm), ("grace", self.grace)):
            if not 0 <= seconds < float("inf"):
                raise ValueError(f"{name} must be a finite number of seconds >= 0, not {seconds!r}")


@dataclasses.dataclass(frozen=True, slots=True)
class Policy:
    """The rules of repair.

    Attributes:
        attempts: of an action on a component within `window` seconds; then it is not tried any more (T62).
        cool_down: seconds between two of them.
        rounds: plans of one case.
        seconds: for one case; its last plan is carried out to its end.
        verify: seconds after a plan in which the symptoms must have gone (topics may need longer than a restart).
        settle: seconds without a new diagnosis after which the present one is believed, when symptoms stay.
        look: seconds after the start in which repair only looks: observers do not see everything at once.
        unknown: seconds to wait while the observations are contradictory or there are none (T49).
        plan_seconds: for the planner (T58).
        exclude: components that are never touched (T64), besides those in whose hands repair itself is.
        optional: components that are given up first (T66).
        restart_drivers: what drives a bad device is restarted in the same plan, not after a second diagnosis.
        dangerous: names of actions that a person has to approve, besides those marked so.
        allow: names of dangerous actions that need nobody's approval: each is opted into by its name.
        approval: seconds a person has to approve a plan.
        component_actions: actions of any kind on one component within `window` seconds.
        hour_actions: actions of all cases together within an hour.
        caution: what is done before anybody is restarted who may work.
        modes: the actions that may be done in a mode; all of them in a mode that is not here (T65).
    """

    attempts: int = 2
    window: float = 600.0
    cool_down: float = 1.0
    rounds: int = 12
    seconds: float = 300.0
    verify: float = 10.0
    settle: float = 2.0
    look: float = 1.0
    unknown: float = 30.0
    plan_seconds: float = 5.0
    exclude: frozenset[str] = frozenset()
    optional: frozenset[str] = frozenset()
    restart_drivers: bool = False
    dangerous: frozenset[str] = frozenset()
    allow: frozenset[str] = frozenset()
    approval: float = 60.0
    component_actions: int = 6
    hour_actions: int = 60
    caution: Caution = dataclasses.field(default_factory=Caution)
    modes: Mapping[str, Collection[str]] = dataclasses.field(default_factory=lambda: {SAFE: ()})

    def __post_init__(self) -> None:
        for name in ("attempts", "rounds", "component_actions", "hour_actions"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1, not {getattr(self, name)!r}")
        for name in ("window", "seconds", "verify", "unknown", "plan_seconds", "approval"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be a finite number of seconds > 0, not {getattr(self, name)!r}")
        for name in ("cool_down", "settle", "look"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be a finite number of seconds >= 0, not {getattr(self, name)!r}")
        if self.settle > self.verify:
            raise ValueError(f"settle ({self.settle} s) must not be longer than verify ({self.verify} s)")

    def is_dangerous(self, action: str, is_marked: bool) -> bool:
        """Say whether a person has to approve an action; `is_marked`: the action itself says so."""
        return (is_marked or action in self.dangerous) and action not in self.allow

    def may(self, action: str, mode: str) -> bool:
        """Say whether an action may be done in a mode."""
        return mode not in self.modes or action in self.modes[mode]
