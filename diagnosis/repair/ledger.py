"""The ledger of attempts: cool-down and budget for each component and action (T62)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import msgspec

from ..kept_file import read_kept
from ..model import Model
from ..planning import Step
from .actions import RepairAction
from .advice import Score
from .policy import NORMAL, Policy, Stance
from .story import Stories

HOUR: Final = 3600.0
"""Seconds in which the actions of all cases together are counted."""
Key = tuple[str, str]
"""Action and component."""


class KeptMemory(msgspec.Struct, frozen=True):
    """What a repairer knows also in the next program: how good its advice was, and what people have forbidden.

    Attributes:
        cases, useless, denied: as in `Memory`.
        right, wrong, needless, missed, seconds_saved: as in `Score`.
    """

    cases: int = 0
    useless: int = 0
    denied: dict[str, str] = {}
    right: int = 0
    wrong: int = 0
    needless: int = 0
    missed: int = 0
    seconds_saved: float = 0.0


@dataclasses.dataclass(slots=True)
class Memory:
    """What a repairer must know after a restart of its own, or budgets and modes would mean nothing.

    Attributes:
        tried: when each action was tried on each component.
        vain: until when a restart that has changed nothing is not tried again.
        denied: components that a person forbids to touch, each with the reason, until it is withdrawn.
        given_up: components that are beyond repair, each with the reason.
        mode: of the system.
        stance: how far repair goes.
        cases: how many there were.
        useless: plans that were carried out and have not helped.
        score: how good the advice was.
        stories: what was told of each of the last cases.
        model: as it was changed at run time; None if it was not.
        file: where scores and denials are kept beyond the program; None: nowhere.
        kept: what stands there.
    """

    tried: dict[Key, list[float]] = dataclasses.field(default_factory=dict[Key, list[float]])
    vain: dict[Key, float] = dataclasses.field(default_factory=dict[Key, float])
    denied: dict[str, str] = dataclasses.field(default_factory=dict[str, str])
    given_up: dict[str, str] = dataclasses.field(default_factory=dict[str, str])
    mode: str = NORMAL
    stance: Stance = "on"
    cases: int = 0
    useless: int = 0
    score: Score = dataclasses.field(default_factory=Score)
    stories: Stories = dataclasses.field(default_factory=Stories)
    model: Model | None = None
    file: Path | None = None
    kept: KeptMemory = dataclasses.field(default_factory=KeptMemory)

    def load(self, file: Path) -> None:
        """Begin with what an earlier program has kept. Raises ValueError: the file is no such file. OSError."""
        self.file, self.kept = file, read_kept(file, KeptMemory, "scores of repair") or KeptMemory()
        kept = self.kept
        self.cases, self.useless, self.denied = kept.cases, kept.useless, dict(kept.denied)
        self.score = Score(kept.right, kept.wrong, kept.needless, kept.missed, kept.seconds_saved)

    def to_keep(self) -> KeptMemory:
        """What the next program is to know."""
        return KeptMemory(self.cases, self.useless, dict(self.denied), **dataclasses.asdict(self.score))


class Ledger:
    """Attempts within the policy's window. Plain data: whoever owns it gives the time."""

    def __init__(self, policy: Policy, memory: Memory | None = None) -> None:
        self._policy, self._memory = policy, memory or Memory()

    def note(self, step: Step, now: float) -> None:
        """A step is being tried."""
        self._memory.tried.setdefault(_key(step), []).append(now)

    def note_vain(self, step: Step, now: float) -> None:
        """A restart was seen to change nothing: it is not tried again within the window."""
        self._memory.vain[_key(step)] = now + self._policy.window

    def deny(self, components: Iterable[str], why: str) -> None:
        """A person forbids to touch these: nothing is planned for them before `pardon`, by whatever action."""
        self._memory.denied |= dict.fromkeys(components, why)

    def is_left(self, action: RepairAction, component: str, now: float) -> bool:
        """Whether there are attempts left."""
        most, policy = action.attempts or self._policy.attempts, self._policy
        if now < self._memory.vain.get((action.name, component), now):
            return False
        if component in self._memory.denied or len(self._recent((action.name, component), now)) >= most:
            return False
        return self.tries(component, now) < policy.component_actions and self._in_hour(now) < policy.hour_actions

    def _in_hour(self, now: float) -> int:
        return sum(now - when < HOUR for times in self._memory.tried.values() for when in times)

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
        memory.vain = {key: until for key, until in memory.vain.items() if key[1] not in freed}
        memory.denied = {name: why for name, why in memory.denied.items() if name not in freed}

    def tries(self, component: str, now: float) -> int:
        """How often anything was tried on a component."""
        return sum(len(self._recent(key, now)) for key in list(self._memory.tried) if key[1] == component)

    def _recent(self, key: Key, now: float) -> list[float]:
        tried = self._memory.tried
        kept = [when for when in tried.get(key, ()) if now - when < max(self._policy.window, HOUR)]
        if kept:
            tried[key] = kept
        else:
            tried.pop(key, None)
        return [when for when in kept if now - when < self._policy.window]


def _key(step: Step) -> Key:
    return step.action, step.args[0] if step.args else ""
