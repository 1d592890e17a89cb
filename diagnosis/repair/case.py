"""One case of repair: from its first symptom to health, or to giving up."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping

from ...supervision.arbiter import covers
from ..literals import Literal
from ..planning import Step


@dataclasses.dataclass(slots=True)
class Case:
    """What was seen and done so far.

    Attributes:
        tried: plans that were carried out for each candidate.
        hopeless: candidates for which there is no plan, each with the reason.
        has_told: something was given up, and that was said.
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
    has_told: bool = False

    def add_symptoms(self, symptoms: Iterable[Literal]) -> None:
        """More was seen."""
        self.symptoms = tuple(dict.fromkeys((*self.symptoms, *symptoms)))

    def count(self, step: Step) -> None:
        """A step is carried out."""
        self.actions.append(step)
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
