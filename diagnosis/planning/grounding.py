"""Grounding: actions without variables, of a domain and the part of a problem that stays as it is."""

from __future__ import annotations

import dataclasses
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Set
from typing import TypeAlias

from ..engine.breath import breathing
from .answers import Budget, Step
from .language import (
    Action,
    And,
    Atom,
    Domain,
    Effect,
    Exists,
    Fact,
    ForAll,
    Formula,
    Not,
    Or,
    PlanLiteral,
    PlanningError,
    Problem,
    Same,
)
from .static_facts import Binding, StaticFacts, fill, statics

Term: TypeAlias = frozenset[PlanLiteral]
"""A conjunction."""

MOST_ACTIONS = 100_000
MOST_TERMS = 64
"""Conjunctions that one condition may become: an action has as many ground variants."""
KEPT = 8
"""Groundings that are kept."""

TRUE: list[Term] = [frozenset()]
FALSE: list[Term] = []


@dataclasses.dataclass(frozen=True, slots=True)
class GroundEffect:
    """If the condition is true before, the literal is true after."""

    condition: Term
    literal: PlanLiteral


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GroundAction:
    """An action without variables; equal only to itself. An action with `or` has several, under the same step."""

    step: Step
    needs: Term
    effects: tuple[GroundEffect, ...]
    cost: int

    def is_applicable(self, state: frozenset[Atom]) -> bool:
        """Whether it can be done now."""
        return holds(self.needs, state)

    def after(self, state: frozenset[Atom]) -> frozenset[Atom]:
        """The state it leads to; what is both added and deleted is added."""
        fired = [effect.literal for effect in self.effects if holds(effect.condition, state)]
        deleted = {literal.atom for literal in fired if not literal.value}
        return (state - deleted) | {literal.atom for literal in fired if literal.value}


def holds(term: Term, state: Set[Atom]) -> bool:
    """Whether a conjunction is true in a state, given as its true atoms."""
    return all((literal.atom in state) is literal.value for literal in term)


class Grounder:
    """Grounds problems, and remembers: what changes between two problems of a system is only the state."""

    def __init__(self) -> None:
        self._kept: OrderedDict[object, tuple[GroundAction, ...]] = OrderedDict()
        self._lock = threading.Lock()

    def ground(self, problem: Problem, budget: Budget) -> tuple[GroundAction, ...]:
        """All actions that may ever be possible. Raises PlanningError if they are too many, OutOfTime."""
        key = (problem.domain, frozenset(problem.objects.items()), statics(problem))
        with self._lock:
            known = self._kept.get(key)
            if known is not None:
                self._kept.move_to_end(key)
                return known
        actions = ground(StaticFacts.of(problem), budget)
        with self._lock:
            self._kept[key] = actions
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        return actions


def ground(world: StaticFacts, budget: Budget) -> tuple[GroundAction, ...]:
    """All ground actions of a world, in the order of names. Raises PlanningError if they are too many, OutOfTime."""
    actions: list[GroundAction] = []
    for action in world.domain.actions:
        for made in _ground_action(world, action, budget):
            actions.append(made)
            if len(actions) > MOST_ACTIONS:
                raise PlanningError(f"action {action.name}", f"there are more than {MOST_ACTIONS} ways to do things")
    return tuple(actions)


def _ground_action(world: StaticFacts, action: Action, budget: Budget) -> Iterator[GroundAction]:
    conditions = Conditions(world, f"action {action.name}")
    for bound in breathing(world.bindings(action.parameters, world.guards(action.precondition), {}), 64):
        budget.check()
        variants = conditions.terms(action.precondition, bound)
        if variants:
            step = Step(action.name, tuple(bound[parameter.name] for parameter in action.parameters))
            effects = tuple(_effects(world, conditions, action.effects, bound))
            for needs in variants:
                yield GroundAction(step, needs, effects, action.cost)


def _effects(
    world: StaticFacts, conditions: Conditions, effects: Iterable[Effect], bound: Binding
) -> Iterator[GroundEffect]:
    made: dict[tuple[Term, PlanLiteral], None] = {}
    for effect in effects:
        for inner in world.places(effect, bound):
            literal = PlanLiteral(fill(effect.literal.atom, inner), effect.literal.value)
            for condition in conditions.terms(effect.condition, inner):
                made[condition, literal] = None
    added = {literal.atom for condition, literal in made if literal.value and not condition}
    for condition, literal in made:
        if literal.value or literal.atom not in added:  # What is added anyway is not deleted.
            yield GroundEffect(condition, literal)


class Conditions:
    """Makes ground conjunctions of formulas; what is static is decided here and now."""

    def __init__(self, world: StaticFacts, where: str) -> None:
        self._world, self._where = world, where

    def terms(self, formula: Formula, bound: Binding, value: bool = True) -> list[Term]:
        """The formula, or its negation, as a disjunction of conjunctions. Raises PlanningError if they are too many."""
        match formula:
            case Fact(atom):
                literal = PlanLiteral(fill(atom, bound), value)
                if atom[0] in self._world.changing:
                    return [frozenset((literal,))]
                return TRUE if (literal.atom in self._world.statics) is value else FALSE
            case Same(left, right):
                return TRUE if (bound.get(left, left) == bound.get(right, right)) is value else FALSE
            case Not(of):
                return self.terms(of, bound, not value)
            case And(of):
                parts = (self.terms(part, bound, value) for part in of)
                return self._all(parts) if value else self._any(parts)
            case Or(of):
                parts = (self.terms(part, bound, value) for part in of)
                return self._any(parts) if value else self._all(parts)
            case ForAll(_, of):
                parts = (self.terms(of, inner, value) for inner in self._world.instances(formula, bound))
                return self._all(parts) if value else self._any(parts)
            case Exists(_, of):
                parts = (self.terms(of, inner, value) for inner in self._world.instances(formula, bound))
                return self._any(parts) if value else self._all(parts)

    def _all(self, parts: Iterable[list[Term]]) -> list[Term]:
        certain: set[PlanLiteral] = set()
        open_parts: list[list[Term]] = []
        for part in parts:
            if not part:
                return FALSE
            if len(part) == 1:
                certain |= part[0]
            else:
                open_parts.append(part)
        if any((atom, not value) in certain for atom, value in certain):
            return FALSE
        found = [frozenset(certain)]
        for part in open_parts:
            found = self._bounded(_consistent(one | other for one in found for other in part))
        return found

    def _any(self, parts: Iterable[list[Term]]) -> list[Term]:
        found: dict[Term, None] = {}
        for part in parts:
            if frozenset() in part:
                return TRUE
            found.update(dict.fromkeys(part))
            self._bounded(found)
        return list(found)

    def _bounded(self, terms: Iterable[Term]) -> list[Term]:
        kept = list(terms)
        if len(kept) > MOST_TERMS:
            raise PlanningError(self._where, f"a condition has more than {MOST_TERMS} cases: it has too many `or`")
        return kept


def _consistent(terms: Iterable[Term]) -> list[Term]:
    found = dict.fromkeys(term for term in terms if not any((atom, not value) in term for atom, value in term))
    return list(found)


def changing_part(domain: Domain, init: Iterable[Atom]) -> frozenset[Atom]:
    """The atoms of a state that actions may change."""
    changing = domain.changing()
    return frozenset(atom for atom in init if atom[0] in changing)
