"""Domains and problems as PDDL text, for planners that read it; any name of an object becomes one that PDDL allows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from .answers import Step
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
    Problem,
    Same,
    Variable,
)


class Names:
    """Objects by the names they have in the text: PDDL has few signs, and one case only."""

    def __init__(self, objects: Iterable[str]) -> None:
        self._written = {name: f"o{number}" for number, name in enumerate(sorted(objects))}
        self._read = {written: name for name, written in self._written.items()}

    def written(self, name: str) -> str:
        """An object, or a variable as it is."""
        return self._written.get(name, name)

    def step(self, action: str, args: Iterable[str]) -> Step:
        """A step of a plan for the written problem."""
        return Step(action, tuple(self._read[name] for name in args))


def write_domain(domain: Domain, names: Names) -> str:
    """The domain, with the names its constants have in the problem."""
    constants = " ".join(f"{names.written(name)} - {kind}" for name, kind in domain.constants)
    predicates = " ".join(
        f"({name}{''.join(f' ?a{i} - {_types(types)}' for i, types in enumerate(places))})"
        for name, places in domain.predicates
    )
    return "\n".join(
        (
            f"(define (domain {domain.name})",
            "(:requirements :adl :typing :action-costs)",
            f"(:types {' '.join(f'{kind} - {parent}' for kind, parent in domain.types)})",
            f"(:constants {constants})" if constants else "",
            f"(:predicates {predicates})",
            "(:functions (total-cost) - number)",
            *[_action(action, names) for action in domain.actions],
            ")",
        )
    )


def write_problem(problem: Problem, names: Names) -> str:
    """The problem, its goals as a conjunction, to be reached at the least cost."""
    objects = " ".join(f"{names.written(name)} - {kind}" for name, kind in sorted(problem.objects.items()))
    facts = " ".join(_atom(atom, names) for atom in sorted(problem.init))
    goals = " ".join(_literal(goal, names) for goal in problem.goals)
    return (
        f"(define (problem repair) (:domain {problem.domain.name})\n(:objects {objects})\n"
        f"(:init (= (total-cost) 0) {facts})\n(:goal (and {goals}))\n(:metric minimize (total-cost)))"
    )


def _action(action: Action, names: Names) -> str:
    effects = " ".join(_effect(effect, names) for effect in action.effects)
    return (
        f"(:action {action.name} :parameters ({_variables(action.parameters)})\n"
        f" :precondition {_formula(action.precondition, names)}\n"
        f" :effect (and {effects} (increase (total-cost) {action.cost})))"
    )


def _effect(effect: Effect, names: Names) -> str:
    text = _literal(effect.literal, names)
    if effect.condition != And():
        text = f"(when {_formula(effect.condition, names)} {text})"
    return f"(forall ({_variables(effect.variables)}) {text})" if effect.variables else text


def _formula(formula: Formula, names: Names) -> str:
    match formula:
        case Fact(atom):
            return _atom(atom, names)
        case Same(left, right):
            return f"(= {names.written(left)} {names.written(right)})"
        case Not(of):
            return f"(not {_formula(of, names)})"
        case And(of):
            return f"(and {' '.join(_formula(part, names) for part in of)})"
        case Or((Not(condition), then)):
            return f"(imply {_formula(condition, names)} {_formula(then, names)})"
        case Or(of):
            return f"(or {' '.join(_formula(part, names) for part in of)})"
        case ForAll(variables, of):
            return f"(forall ({_variables(variables)}) {_formula(of, names)})"
        case Exists(variables, of):
            return f"(exists ({_variables(variables)}) {_formula(of, names)})"


def _literal(literal: PlanLiteral, names: Names) -> str:
    text = _atom(literal.atom, names)
    return text if literal.value else f"(not {text})"


def _atom(atom: Atom, names: Names) -> str:
    return f"({' '.join((atom[0], *map(names.written, atom[1:])))})"


def _variables(variables: Sequence[Variable]) -> str:
    return " ".join(f"{variable.name} - {_types(variable.types)}" for variable in variables)


def _types(types: Sequence[str]) -> str:
    return types[0] if len(types) == 1 else f"(either {' '.join(types)})"
