"""Explanations: the conflicts behind a diagnosis, in plain words.

A conflict is a set of components that cannot all work, given what was observed (Reiter 1987). Here each is minimal:
nobody in it can be left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import msgspec

from ..literals import Literal
from .breath import breathe
from .cone import Index, RuleStep, cone_of


class Conflict(msgspec.Struct, frozen=True):
    """At least one of `components` is faulty, because of `symptom`."""

    components: tuple[str, ...]
    symptom: Literal | None
    """What failed; None if what was observed cannot be together."""
    given: tuple[Literal, ...] = ()
    """What was observed to hold, without which this would not follow."""
    rules: tuple[str, ...] = ()

    def __str__(self) -> str:
        if len(self.components) == 1:
            blamed = f"{self.components[0]} is faulty"
        else:
            blamed = f"at least one of {_listed(self.components, 'and')} is faulty"
        given = _listed(tuple(map(str, self.given)), "and") if self.given else ""
        if self.symptom is None and given:
            return f"{given}: {blamed}"
        failed = str(self.symptom) if self.symptom is not None else "this cannot be"
        while_ = f" while {given}" if given else ""
        return f"{failed}{while_}: {blamed}"


class Consequence(msgspec.Struct, frozen=True):
    """A failure that needs no fault of its own: it follows from faults or failures that are there anyway."""

    symptom: Literal
    because: tuple[str, ...]
    """Components that are surely faulty, or observed failures, as text."""

    def __str__(self) -> str:
        if not self.because:
            return f"{self.symptom}: nothing in the model accounts for it"
        return f"{self.symptom}: follows from {_listed(self.because, 'and')}"


class Explanation(msgspec.Struct, frozen=True):
    """Everything there is to say about why."""

    conflicts: tuple[Conflict, ...] = ()
    consequences: tuple[Consequence, ...] = ()
    left_out: int = 0
    """Symptoms that were not explained in the time there was."""

    def __str__(self) -> str:
        left = [f"{self.left_out} more symptoms were not explained in time"] if self.left_out else []
        return "\n".join(map(str, (*self.conflicts, *self.consequences, *left)))


def explain(index: Index, positive: frozenset[int], negative: frozenset[int], until: float = math.inf) -> Explanation:
    """One minimal conflict for each rule that ends in a failure, and the failures that need none.

    Args:
        index: the model.
        positive: atoms that hold.
        negative: atoms that do not.
        until: of the monotonic clock; no more conflicts are begun after it.
    """
    cone = cone_of(index, positive, negative)
    conflicts = [_conflict(index, {step.needs[0]}, [step], step.head, positive) for step in cone.convicted]
    left_out = 0
    for part in sorted(cone.parts, key=lambda part: len(part.steps) + len(part.denials)):
        makers: dict[int, list[RuleStep]] = {}
        for step in part.steps:
            makers.setdefault(step.head, []).append(step)
        for first in part.denials:
            found = _minimal(first, part.denials, makers, until) if time.monotonic() < until else None
            if found is None:
                left_out += 1
                continue
            denial, needs, steps = found
            conflicts.append(_conflict(index, needs, steps, denial.head, positive))
    explained = {step.head for step in cone.convicted}
    explained |= {denial.head for part in cone.parts for denial in part.denials}
    left = sorted(negative - explained)
    consequences: list[Consequence] = []
    for failure in left:
        if time.monotonic() < until:
            consequences.append(_consequence(index, failure, positive, negative, cone.faulty))
        else:
            left_out += 1
    return Explanation(tuple({one.components: one for one in conflicts}.values()), tuple(consequences), left_out)


def _minimal(
    denial: RuleStep, denials: tuple[RuleStep, ...], makers: dict[int, list[RuleStep]], until: float
) -> tuple[RuleStep, set[int], list[RuleStep]] | None:
    """A minimal conflict that begins with a denial: the denial it ends with, its components, and the rules used.

    None if there was no time to make it minimal.
    """
    used = _derivation([denial], makers, None)
    assert used is not None  # the cone holds only rules that can apply
    needs = {component for step in used for component in step.needs}
    for component in sorted(needs):
        if time.monotonic() > until:
            return None
        breathe()
        fewer = _any_derivation(denials, makers, needs - {component})
        if fewer is not None:
            used = fewer
            needs = needs - {component}
    return used[0], needs, used


def _any_derivation(
    denials: tuple[RuleStep, ...], makers: dict[int, list[RuleStep]], allowed: set[int]
) -> list[RuleStep] | None:
    found = (_derivation([denial], makers, allowed) for denial in denials if allowed.issuperset(denial.needs))
    return next((used for used in found if used is not None), None)


def _derivation(
    steps: list[RuleStep], makers: dict[int, list[RuleStep]], allowed: set[int] | None
) -> list[RuleStep] | None:
    """The steps, with rules of `allowed` components for each atom they wait for; None if there are none."""
    order = _order(steps, makers)
    chosen: dict[int, RuleStep] = {}
    for atom in order:
        for maker in makers[atom]:
            is_allowed = allowed is None or allowed.issuperset(maker.needs)
            if is_allowed and all(needed in chosen for needed in maker.body):
                chosen[atom] = maker
                break
    if not all(needed in chosen for step in steps for needed in step.body):
        return None
    used = list(steps)
    met: set[int] = set()
    for step in used:  # it grows
        for needed in step.body:
            if needed not in met:
                met.add(needed)
                used.append(chosen[needed])
    return used


def _order(steps: list[RuleStep], makers: dict[int, list[RuleStep]]) -> list[int]:
    """The atoms that `steps` rest on, each after those it is made from (the model has no circles)."""
    order: list[int] = []
    met: set[int] = set()
    stack: list[tuple[int, Iterator[int]]] = [(0, (needed for step in steps for needed in step.body))]
    while stack:
        atom, rest = stack[-1]
        following = next((needed for needed in rest if needed not in met), None)
        if following is None:
            stack.pop()
            order.append(atom)
        else:
            met.add(following)
            stack.append((following, iter([needed for maker in makers[following] for needed in maker.body])))
    return order[:-1]  # without the failure itself


def _conflict(index: Index, needs: set[int], used: list[RuleStep], head: int, positive: frozenset[int]) -> Conflict:
    given = {atom for step in used for atom in index.steps[step.rule].body if atom in positive}
    failed = index.atoms[head]
    return Conflict(
        tuple(index.names[component] for component in sorted(needs)),
        None if failed is None else ~failed,
        tuple(literal for atom in sorted(given) if (literal := index.atoms[atom]) is not None),
        tuple(str(index.model.rules[step.rule]) for step in used),
    )


def _consequence(
    index: Index, failure: int, positive: frozenset[int], negative: frozenset[int], faulty: frozenset[int]
) -> Consequence:
    """What is known to keep each of the rules for a failure from applying."""
    because: dict[str, None] = {}
    todo, met = [failure], {failure}
    for atom in todo:  # it grows
        for step in index.makers[atom]:
            because.update((index.names[component], None) for component in step.needs if component in faulty)
            because.update(
                (str(~literal), None)
                for literal in map(index.atoms.__getitem__, step.body)
                if literal and index.atom[literal] in negative
            )
            further = [needed for needed in step.body if needed not in positive | negative and needed not in met]
            met.update(further)
            todo += further
    literal = index.atoms[failure]
    assert literal is not None
    return Consequence(~literal, tuple(because))


def _listed(words: tuple[str, ...], last: str) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"
