"""What was tried on whom, and when it may be tried again: cool-down and budget for each component and action (T62)."""

from __future__ import annotations

from collections.abc import Iterable

from ..planning import Step
from .actions import RepairAction
from .policy import Policy


class Ledger:
    """Attempts within the policy's window. Plain data: whoever owns it gives the time."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self._tried: dict[tuple[str, str], list[float]] = {}
        self._denied: set[tuple[str, str]] = set()

    def note(self, step: Step, now: float) -> None:
        """A step is being tried."""
        self._tried.setdefault(_key(step), []).append(now)

    def deny(self, step: Step) -> None:
        """A person forbids it: it is not planned again before `pardon`."""
        self._denied.add(_key(step))

    def is_left(self, action: RepairAction, component: str, now: float) -> bool:
        """Whether there are attempts left."""
        most = action.attempts or self._policy.attempts
        key = (action.name, component)
        return key not in self._denied and len(self._recent(key, now)) < most

    def wait(self, steps: Iterable[Step], actions: dict[str, RepairAction], now: float) -> float:
        """Seconds until all of these have cooled down."""
        return max((self._wait(step, actions[step.action], now) for step in steps), default=0.0)

    def _wait(self, step: Step, action: RepairAction, now: float) -> float:
        cool_down = self._policy.cool_down if action.cool_down is None else action.cool_down
        tried = self._tried.get(_key(step))
        return max(0.0, tried[-1] + cool_down - now) if tried else 0.0

    def pardon(self, components: Iterable[str]) -> None:
        """Forget what was tried on these."""
        freed = set(components)
        self._tried = {key: times for key, times in self._tried.items() if key[1] not in freed}
        self._denied = {key for key in self._denied if key[1] not in freed}

    def tries(self, component: str, now: float) -> int:
        """How often anything was tried on a component."""
        return sum(len(self._recent(key, now)) for key in list(self._tried) if key[1] == component)

    def _recent(self, key: tuple[str, str], now: float) -> list[float]:
        times = [when for when in self._tried.get(key, ()) if now - when < self._policy.window]
        if times:
            self._tried[key] = times
        else:
            self._tried.pop(key, None)
        return times


def _key(step: Step) -> tuple[str, str]:
    return step.action, step.args[0] if step.args else ""
