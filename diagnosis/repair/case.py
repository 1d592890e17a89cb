"""One case of repair: from its first symptom to health, or to giving up."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import NamedTuple

from ...supervision.arbiter import covers
from ..literals import Literal
from ..planning import Step
from .actions import Undo
from .advice import Advice


class Verifying(NamedTuple):
    """A plan was carried out at `since`, and the symptoms have until `ends` to go."""

    touched: frozenset[str]
    since: float
    ends: float


class Finishing(NamedTuple):
    """The diagnosis finds nothing bad any more; the symptoms have until `ends` to be seen to have gone."""

    ends: float


class Unclear(NamedTuple):
    """It is not known what there is to repair; at `ends` the case is given up."""

    why: str
    ends: float


class HeldByMode(NamedTuple):
    """In this mode nothing can be done: it has to change, or the fault has to go."""

    mode: str


class Watching(NamedTuple):
    """It was said what would be done for `bad`, and repair looks on until the fault has gone, or it is switched on."""

    bad: tuple[str, ...]


Phase = Verifying | Finishing | Unclear | HeldByMode | Watching


@dataclasses.dataclass(slots=True)
class PresentPlan:
    """What a case tries at the moment.

    Attributes:
        blamed: whom it is for.
        aims: the symptoms that it is to mend.
        begins_at: how many actions there were before it.
        midway: whom it has begun to act on.
        seen_again: those of its symptoms that were said again behind the grace of what was done.
        is_vain: it was counted as one that has not helped.
        undos: how it can be taken back, newest last.
    """

    blamed: frozenset[str] = frozenset()
    aims: frozenset[Literal] = frozenset()
    begins_at: int = 0
    midway: set[str] = dataclasses.field(default_factory=set[str])
    seen_again: set[Literal] = dataclasses.field(default_factory=set[Literal])
    is_vain: bool = False
    undos: list[tuple[Step, Undo]] = dataclasses.field(default_factory=list[tuple[Step, Undo]])


@dataclasses.dataclass(slots=True)
class Case:
    """What was seen and done so far.

    Attributes:
        phase: what the case waits for; None: the next round can begin.
        tried: plans that were carried out for each candidate.
        hopeless: candidates for which there is no plan, each with the reason.
        plan: the present plan.
        advised: the advice for each candidate.
        useless: places of actions that were seen not to help.
        others: when each component was started by somebody else.
        awaited: whose supervisor was at work when repair looked, with the number of the life that was up then, or 0.
        held: what repair waits for, as it was last told.
        doubted: since when a candidate is blamed although its actors answer.
    """

    number: int
    began: float
    symptoms: tuple[Literal, ...] = ()
    actions: list[Step] = dataclasses.field(default_factory=list[Step])
    tried: dict[tuple[str, ...], int] = dataclasses.field(default_factory=dict[tuple[str, ...], int])
    tries: dict[str, int] = dataclasses.field(default_factory=dict[str, int])
    hopeless: dict[tuple[str, ...], str] = dataclasses.field(default_factory=dict[tuple[str, ...], str])
    rounds: int = 0
    failures: list[str] = dataclasses.field(default_factory=list[str])
    phase: Phase | None = None
    plan: PresentPlan = dataclasses.field(default_factory=PresentPlan)
    advised: dict[tuple[str, ...], Advice] = dataclasses.field(default_factory=dict[tuple[str, ...], Advice])
    useless: set[int] = dataclasses.field(default_factory=set[int])
    others: dict[str, float] = dataclasses.field(default_factory=dict[str, float])
    held: str = ""
    awaited: dict[str, int] = dataclasses.field(default_factory=dict[str, int])
    doubted: dict[tuple[str, ...], float] = dataclasses.field(default_factory=dict[tuple[str, ...], float])

    @property
    def reason(self) -> str:
        """Why the present plan is carried out, in words."""
        return f"diagnosed: {', '.join(sorted(self.plan.blamed))}"

    def enter(self, phase: Phase | None, now: float) -> None:
        """Go on in another phase. The time in which a mode forbade everything does not count."""
        if isinstance(self.phase, HeldByMode):
            self.began = now
        self.phase = phase

    def has_heard(self, why: str) -> bool:
        """Whether it was told already that this keeps repair waiting; it is from now on."""
        was, self.held = self.held, why
        return was == why

    def begin_plan(self, bad: tuple[str, ...], symptoms: Iterable[Literal]) -> None:
        """A plan for a candidate, which is to mend these symptoms, is carried out from now on."""
        self.rounds += 1
        self.tried[bad] = self.tried.get(bad, 0) + 1
        self.plan = PresentPlan(frozenset(bad), frozenset(symptoms), len(self.actions))

    def take_carried_out(self) -> tuple[Step, ...]:
        """The steps of the present plan that were begun, once: then they are judged."""
        steps, self.plan.begins_at = tuple(self.actions[self.plan.begins_at :]), len(self.actions)
        return steps

    def note_useless(self, names: Collection[str]) -> None:
        """The steps of the present plan on these components have not helped."""
        begun = range(self.plan.begins_at, len(self.actions))
        self.useless.update(place for place in begun if set(self.actions[place].args[:1]) & set(names))

    def count_vain(self) -> bool:
        """Whether the present plan counts from now on as one that has not helped; once."""
        was, self.plan.is_vain = self.plan.is_vain, True
        return not was and self.plan.begins_at < len(self.actions)

    def helpful(self) -> tuple[Step, ...]:
        """The actions that were done, but for those that were seen not to help."""
        return tuple(step for place, step in enumerate(self.actions) if place not in self.useless)

    def take_back_plan(self, bad: tuple[str, ...]) -> None:
        """Nothing of the plan was tried, so it does not count."""
        self.rounds -= 1
        self.tried[bad] -= 1

    def add_symptoms(self, symptoms: Iterable[Literal]) -> None:
        """Add symptoms that were seen meanwhile."""
        self.symptoms = tuple(dict.fromkeys((*self.symptoms, *symptoms)))

    def count(self, step: Step) -> None:
        """A step is carried out."""
        self.actions.append(step)
        self.plan.midway.update(step.args[:1])
        for name in step.args[:1]:
            self.tries[name] = self.tries.get(name, 0) + 1


def base_of(addresses: Mapping[str, str], ours: Collection[str]) -> Iterator[str]:
    """The components that are above, at or below an address in whose hands repair itself is (T64)."""
    for component, address in addresses.items():
        if any(covers(address, own) or covers(own, address) for own in ours):
            yield component


def reached(addresses: Mapping[str, str], address: str) -> Iterator[str]:
    """The components at an address and below it."""
    return (component for component, theirs in addresses.items() if covers(address, theirs))
