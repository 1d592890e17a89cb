"""The language of planning: formulas, actions, domains and problems, as plain data without any library's classes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple, TypeAlias

from ...actors.errors import HoldfastError

Atom: TypeAlias = tuple[str, ...]
"""A predicate and its arguments; an argument that begins with `?` is a variable."""


class PlanLiteral(NamedTuple):
    """That an atom is true, or that it is false."""

    atom: Atom
    value: bool = True

    def __str__(self) -> str:
        text = f"{self.atom[0]}({','.join(self.atom[1:])})"
        return text if self.value else f"not {text}"


class PlanningError(HoldfastError, text="{where}: {problem}"):
    """A domain, a problem or an action is not valid: `where` names it."""

    where: str
    problem: str


class Variable(NamedTuple):
    """A variable, and the types of which its values may be."""

    name: str
    types: tuple[str, ...]


@dataclasses.dataclass(frozen=True, slots=True)
class Fact:
    """The formula that an atom is true."""

    atom: Atom


@dataclasses.dataclass(frozen=True, slots=True)
class Same:
    """The two are one object."""

    left: str
    right: str


@dataclasses.dataclass(frozen=True, slots=True)
class Not:
    """The formula that another one is false."""

    of: Formula


@dataclasses.dataclass(frozen=True, slots=True)
class And:
    """The formula that all parts are true."""

    of: tuple[Formula, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True)
class Or:
    """At least one is true."""

    of: tuple[Formula, ...]


@dataclasses.dataclass(frozen=True, slots=True)
class ForAll:
    """It is true whatever the variables are."""

    variables: tuple[Variable, ...]
    of: Formula


@dataclasses.dataclass(frozen=True, slots=True)
class Exists:
    """It is true of some objects."""

    variables: tuple[Variable, ...]
    of: Formula


Formula: TypeAlias = Fact | Same | Not | And | Or | ForAll | Exists


@dataclasses.dataclass(frozen=True, slots=True)
class Effect:
    """For all `variables` of which `condition` is true before the action, the literal is true after it."""

    variables: tuple[Variable, ...]
    condition: Formula
    literal: PlanLiteral


@dataclasses.dataclass(frozen=True, slots=True)
class Action:
    """What can be done, with variables for what it is done to."""

    name: str
    parameters: tuple[Variable, ...]
    precondition: Formula
    effects: tuple[Effect, ...]
    cost: int = 1


@dataclasses.dataclass(frozen=True, slots=True)
class Domain:
    """What can be done.

    Attributes:
        types: (type, the type it belongs to), `object` at the top.
        predicates: (name, the types of each argument).
        constants: (object, its type), known to every problem.
    """

    name: str
    types: tuple[tuple[str, str], ...]
    predicates: tuple[tuple[str, tuple[tuple[str, ...], ...]], ...]
    actions: tuple[Action, ...]
    constants: tuple[tuple[str, str], ...] = ()

    def changing(self) -> frozenset[str]:
        """Predicates that some action changes; what is so of the others stays so."""
        return frozenset(effect.literal.atom[0] for action in self.actions for effect in action.effects)

    def above(self, kind: str) -> Iterator[str]:
        """A type, and all it belongs to."""
        parents = dict(self.types)
        seen: set[str] = set()
        while kind not in seen:
            seen.add(kind)
            yield kind
            kind = parents.get(kind, "object")


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is so, and what should be.

    Attributes:
        objects: name -> type. Any text is a name, but for a `?` at its beginning.
        init: the atoms that are true; all others are false.
        goals: the more important first: when not all can be had, the last are given up first.

    Raises:
        PlanningError: an unknown type, predicate or object, or the wrong number or type of arguments.
    """

    domain: Domain
    objects: Mapping[str, str]
    init: frozenset[Atom]
    goals: tuple[PlanLiteral, ...]

    def __post_init__(self) -> None:
        known = {kind for kind, _ in self.domain.types} | {"object"}
        for name, kind in self.objects.items():
            if not name or name.startswith("?"):
                raise PlanningError(f"object {name!r}", "a name is not empty and does not begin with '?'")
            if kind not in known:
                raise PlanningError(f"object {name}", f"there is no type {kind}")
        everything = self.everything()
        above = {kind: frozenset(self.domain.above(kind)) for kind in set(everything.values())}
        types = {name: above[kind] for name, kind in everything.items()}
        declared = dict(self.domain.predicates)
        for atom in self.init:
            _check_atom(atom, declared, types)
        for goal in self.goals:
            _check_atom(goal.atom, declared, types)

    def everything(self) -> dict[str, str]:
        """All objects, the domain's constants among them."""
        return {**dict(self.domain.constants), **self.objects}

    def wanting(self, goals: Iterable[PlanLiteral]) -> Problem:
        """The same with other goals."""
        return dataclasses.replace(self, goals=tuple(goals))


def _check_atom(
    atom: Atom, declared: Mapping[str, tuple[tuple[str, ...], ...]], types: Mapping[str, frozenset[str]]
) -> None:
    expected = declared.get(atom[0])
    if expected is None:
        raise PlanningError(str(PlanLiteral(atom)), f"there is no predicate {atom[0]}")
    if len(expected) != len(atom) - 1:
        raise PlanningError(str(PlanLiteral(atom)), f"{atom[0]} takes {len(expected)} objects, not {len(atom) - 1}")
    for name, kinds in zip(atom[1:], expected, strict=True):
        if name not in types:
            raise PlanningError(str(PlanLiteral(atom)), f"there is no object {name}")
        if types[name].isdisjoint(kinds):
            raise PlanningError(str(PlanLiteral(atom)), f"{name} is no {' or '.join(kinds)}")
