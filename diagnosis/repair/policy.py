"""The policy of repair: attempts, waits, modes, and components to leave alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Final

NORMAL: Final = "normal"
SAFE: Final = "safe"


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
        approval: seconds a person has for that.
        modes: the actions that may be done in a mode; all of them in a mode that is not here (T65).
        is_dry: plan, tell, and do nothing.
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
    approval: float = 60.0
    modes: Mapping[str, Collection[str]] = dataclasses.field(default_factory=lambda: {SAFE: ()})
    is_dry: bool = False

    def __post_init__(self) -> None:
        for name in ("attempts", "rounds"):
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

    def may(self, action: str, mode: str) -> bool:
        """Whether an action may be done in a mode."""
        return mode not in self.modes or action in self.modes[mode]
