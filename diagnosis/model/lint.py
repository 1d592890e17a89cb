"""Lints a model: finds components that can never be told apart, or never diagnosed.

Judged by the structure alone, given what is observed. The conclusions of two components are compared as the sets of
observed atoms that depend on them, with nothing observed in between.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable

import msgspec

from ..literals import Literal
from .check import Model
from .clauses import Rule


class Flaw(enum.Enum):
    """What a finding is about, worst first."""

    NEVER_DIAGNOSED = "never diagnosed"
    ONLY_WHEN_ENDED = "never diagnosed while running"
    ALIKE = "never told apart"
    ALIKE_WHILE_RUNNING = "not told apart while running"


class Finding(msgspec.Struct, frozen=True):
    """One weakness, the components it concerns, and what to do."""

    flaw: Flaw
    components: tuple[str, ...]
    advice: str

    def __str__(self) -> str:
        return f"{', '.join(self.components)}: {self.flaw.value}; {self.advice}"


def lint(model: Model, observed: Iterable[Literal | str] | None = None) -> tuple[Finding, ...]:
    """All weaknesses of a model.

    Args:
        model: the model.
        observed: the atoms that observers report; all that the model declares unless given.
    """
    atoms = frozenset(model.vocabulary if observed is None else map(model.vocabulary.check, observed))
    full = _signatures(model, atoms)
    # A frozen program still runs, and a device can have power and be broken.
    silent = _signatures(model, atoms, frozenset({"running", "on"}))
    never = tuple(name for name, seen in full.items() if not seen)
    ended = tuple(name for name, seen in silent.items() if not seen and full[name])
    findings = [Finding(Flaw.NEVER_DIAGNOSED, (name,), _HOW_TO_SEE) for name in never]
    findings += (Finding(Flaw.ONLY_WHEN_ENDED, (name,), _HOW_TO_SEE_OUTPUT) for name in ended)
    alike = _groups(full)
    findings += (Finding(Flaw.ALIKE, group, _HOW_TO_SPLIT) for group in alike)
    findings += (
        Finding(Flaw.ALIKE_WHILE_RUNNING, group, _HOW_TO_SPLIT) for group in _groups(silent) if group not in alike
    )
    return tuple(findings)


_HOW_TO_SEE = "nothing that is observed depends on it: give it an output, or name it in its driver's `on`"
_HOW_TO_SEE_OUTPUT = "no output of it is observed: observe one, or expect a property of it"
_HOW_TO_SPLIT = "whatever shows a fault of one shows one of the others: observe something in between"


def _signatures(
    model: Model, observed: frozenset[Literal], left_out: frozenset[str] = frozenset()
) -> dict[str, frozenset[int]]:
    """For each component the numbers of the rules with an observed head (or none) that depend on it."""
    by_head: dict[Literal, list[Rule]] = {}
    for rule in model.rules:
        if rule.head is not None:
            by_head.setdefault(rule.head, []).append(rule)
    seen: dict[str, set[int]] = {name: set() for name in model.components}
    for number, rule in enumerate(model.rules):
        if rule.head is None or (rule.head in observed and rule.head.name not in left_out):
            for name in _concerned(rule, by_head, observed):
                seen[name].add(number)
    return {name: frozenset(numbers) for name, numbers in seen.items()}


def _concerned(rule: Rule, by_head: dict[Literal, list[Rule]], observed: frozenset[Literal]) -> set[str]:
    """Who must work for the rule's head, back to what is observed."""
    names, todo, met = set(rule.needs), list(rule.body), set(rule.body)
    while todo:
        atom = todo.pop()
        if atom in observed:
            continue
        for maker in by_head.get(atom, ()):
            names.update(maker.needs)
            todo += (needed for needed in maker.body if needed not in met)
            met.update(maker.body)
    return names


def _groups(signatures: dict[str, frozenset[int]]) -> tuple[tuple[str, ...], ...]:
    """Components with the same signature, where there are at least two."""
    groups: dict[frozenset[int], list[str]] = {}
    for name, seen in signatures.items():
        if seen:
            groups.setdefault(seen, []).append(name)
    return tuple(tuple(group) for group in groups.values() if len(group) > 1)
