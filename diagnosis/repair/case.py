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
class Case:
    """What was seen and done so far.

    Attributes:
        phase: what the case waits for; None: the next round can begin.
        tried: plans that were carried out for each candidate.
        hopeless: candidates for which there is no plan, each with the reason.
        blamed: whom the present plan is for.
        midway: whom it has begun to act on.
        before_plan: how many actions there were before the present plan.
        aims: the symptoms that the present plan is to mend.
        seen_again: those of them that were said again behind the grace of what was done.
        is_vain: the present plan was counted as one that has not helped.
        undos: how the present plan can be taken back, newest last.
        advised: the advice for each candidate.
        useless: places of actions that were seen not to help.
        others: when each component was started by somebody else.
        awaited: whom its supervisor was at work on when repair last looked.
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
    blamed: frozenset[str] = frozenset()
    midway: set[str] = dataclasses.field(default_factory=set[str])
    before_plan: int = 0
    aims: frozenset[Literal] = frozenset()
    seen_again: set[Literal] = dataclasses.field(default_factory=set[Literal])
    is_vain: bool = False
    undos: list[tuple[Step, Undo]] = dataclasses.field(default_factory=list[tuple[Step, Undo]])
    advised: dict[tuple[str, ...], Advice] = dataclasses.field(default_factory=dict[tuple[str, ...], Advice])
    useless: set[int] = dataclasses.field(default_factory=set[int])
    others: dict[str, float] = dataclasses.field(default_factory=dict[str, float])
    held: str = ""
    awaited: set[str] = dataclasses.field(default_factory=set[str])
    doubted: dict[tuple[str, ...], float] = dataclasses.field(default_factory=dict[tuple[str, ...], float])

    @property
    def reason(self) -> str:
        """Why the present plan is carried out, in words."""
        return f"diagnosed: {', '.join(sorted(self.blamed))}"

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
        self.before_plan = len(self.actions)
        self.tried[bad] = self.tried.get(bad, 0) + 1
        self.blamed, self.midway, self.undos = frozenset(bad), set(), []
        self.aims, self.seen_again, self.is_vain = frozenset(symptoms), set(), False

    def take_carried_out(self) -> tuple[Step, ...]:
        """The steps of the present plan that were begun, once: then they are judged."""
        steps, self.before_plan = tuple(self.actions[self.before_plan :]), len(self.actions)
        return steps

    def note_useless(self, names: Collection[str]) -> None:
        """The steps of the present plan on these components have not helped."""
        begun = range(self.before_plan, len(self.actions))
        self.useless.update(place for place in begun if set(self.actions[place].args[:1]) & set(names))

    def count_vain(self) -> bool:
        """Whether the present plan counts from now on as one that has not helped; once."""
        was, self.is_vain = self.is_vain, True
        return not was and self.before_plan < len(self.actions)

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
        self.midway.update(step.args[:1])
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
