"""Reduces a diagnosis problem: the same diagnoses from far fewer components.

Between what is observed most atoms have one source. Such an atom is replaced by what it is made from, until only sets
of components are left that cannot all work. Of these a set that contains another says nothing. Components that are then
in the same sets are exchangeable: one of them is searched for, and the others take its place in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from .breath import breathe, breathing
from .cone import RulePart, RuleStep, parts_of


class Reduced(NamedTuple):
    """A part in which each component stands for all of its class."""

    part: RulePart
    classes: dict[int, tuple[int, ...]]


Need = tuple[frozenset[int], frozenset[int]]
"""Components and atoms."""


def reduce(part: RulePart) -> Iterator[Reduced]:
    """The parts that are left of a part, with the same minimal diagnoses once classes are written out."""
    makers: dict[int, list[RuleStep]] = {}
    for step in part.steps:
        makers.setdefault(step.head, []).append(step)
    needs = _unfold(part, {atom: made[0] for atom, made in makers.items() if len(made) == 1})
    steps = [_step(need, step) for step, need in needs.items() if len(makers.get(step.head, ())) != 1]
    failures = frozenset(denial.head for denial in part.denials)
    for left in parts_of(_without_supersets(steps, failures), failures):
        yield _classed(left)


def _unfold(part: RulePart, sources: dict[int, RuleStep]) -> dict[RuleStep, Need]:
    """For each rule what it needs, once atoms with one source are replaced (the model has no circles)."""
    needs: dict[RuleStep, Need] = {}
    for first in (*part.denials, *part.steps):
        stack = [first]
        while stack:
            step = stack[-1]
            if step in needs:
                stack.pop()
                continue
            made_by = [sources[atom] for atom in step.body if atom in sources]
            missing = [source for source in made_by if source not in needs]
            if missing:
                stack += missing
                continue
            kept = [atom for atom in step.body if atom not in sources]
            needs[step] = (
                frozenset(step.needs).union(*(needs[source][0] for source in made_by)),
                frozenset(kept).union(*(needs[source][1] for source in made_by)),
            )
            stack.pop()
            if len(needs) % 32 == 0:
                breathe()
    return needs


def _step(need: Need, step: RuleStep) -> RuleStep:
    return RuleStep(tuple(sorted(need[0])), tuple(sorted(need[1])), step.head, step.rule)


def _without_supersets(steps: list[RuleStep], failures: frozenset[int]) -> list[RuleStep]:
    """Without conflicts that contain another one."""
    kept: list[RuleStep] = []
    by_member: dict[int, list[frozenset[int]]] = {}
    for step in breathing(sorted(steps, key=lambda step: len(step.needs)), 64):
        if step.head in failures and not step.body:
            needs = frozenset(step.needs)
            if any(known <= needs for member in step.needs for known in by_member.get(member, ())):
                continue
            by_member.setdefault(step.needs[0], []).append(needs)  # under one of its members it is found
        kept.append(step)
    return kept


def _classed(part: RulePart) -> Reduced:
    """Components that are needed by the same rules become one."""
    rules = (*part.denials, *part.steps)
    occurs: dict[int, list[int]] = {}
    for number, step in enumerate(breathing(rules, 4)):
        for component in step.needs:
            occurs.setdefault(component, []).append(number)
    classes: dict[tuple[int, ...], list[int]] = {}
    for component, numbers in breathing(sorted(occurs.items())):
        classes.setdefault(tuple(numbers), []).append(component)
    members = {group[0]: tuple(group) for group in classes.values()}
    denials, steps = (
        tuple(step._replace(needs=tuple(one for one in step.needs if one in members)) for step in some)
        for some in (part.denials, part.steps)
    )
    return Reduced(RulePart(denials, steps), members)
