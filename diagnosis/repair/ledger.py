"""The ledger of attempts: cool-down and budget for each component and action (T62)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from ..model import Model
from ..planning import Step
from .actions import RepairAction
from .policy import NORMAL, Policy

Key = tuple[str, str]
"""Action and component."""


@dataclasses.dataclass(slots=True)
class Memory:
    """What a repairer must know after a restart of its own, or budgets and modes would mean nothing.

    Attributes:
        tried: when each action was tried on each component.
        denied: what a person forbids.
        given_up: components that are beyond repair, each with the reason.
        mode: of the system.
        cases: how many there were.
        model: as it was changed at run time; None if it was not.
    """

    tried: dict[Key, list[float]] = dataclasses.field(default_factory=dict[Key, list[float]])
    denied: set[Key] = dataclasses.field(default_factory=set[Key])
    given_up: dict[str, str] = dataclasses.field(default_factory=dict[str, str])
    mode: str = NORMAL
    cases: int = 0
    model: Model | None = None


class Ledger:
    """Attempts within the policy's window. Plain data: whoever owns it gives the time."""

    def __init__(self, policy: Policy, memory: Memory | None = None) -> None:
        self._policy, self._memory = policy, memory or Memory()

    def note(self, step: Step, now: float) -> None:
        """A step is being tried."""
        self._memory.tried.setdefault(_key(step), []).append(now)

    def deny(self, step: Step) -> None:
        """A person forbids it: it is not planned again before `pardon`."""
        self._memory.denied.add(_key(step))

    def is_left(self, action: RepairAction, component: str, now: float) -> bool:
        """Whether there are attempts left."""
        most = action.attempts or self._policy.attempts
        key = (action.name, component)
        return key not in self._memory.denied and len(self._recent(key, now)) < most

    def wait(self, steps: Iterable[Step], actions: dict[str, RepairAction], now: float) -> float:
        """Seconds until all of these have cooled down."""
        return max((self._wait(step, actions[step.action], now) for step in steps), default=0.0)

    def _wait(self, step: Step, action: RepairAction, now: float) -> float:
        cool_down = self._policy.cool_down if action.cool_down is None else action.cool_down
        tried = self._memory.tried.get(_key(step))
        return max(0.0, tried[-1] + cool_down - now) if tried else 0.0

    def pardon(self, components: Iterable[str]) -> None:
        """Forget what was tried on these."""
        freed, memory = set(components), self._memory
        memory.tried = {key: times for key, times in memory.tried.items() if key[1] not in freed}
        memory.denied = {key for key in memory.denied if key[1] not in freed}

    def tries(self, component: str, now: float) -> int:
        """How often anything was tried on a component."""
        return sum(len(self._recent(key, now)) for key in list(self._memory.tried) if key[1] == component)

    def _recent(self, key: Key, now: float) -> list[float]:
        tried = self._memory.tried
        times = [when for when in tried.get(key, ()) if now - when < self._policy.window]
        if times:
            tried[key] = times
        else:
            tried.pop(key, None)
        return times


def _key(step: Step) -> Key:
    return step.action, step.args[0] if step.args else ""
