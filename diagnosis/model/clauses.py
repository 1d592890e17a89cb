"""Clauses: what a declaration says, as Horn rules over "works" and atoms.

The paper's six clauses (D36 to D41), mended:

1. a switchable device that works is on;
2. and 3. a driver that works, with all its devices, publishes what is ok. Devices that cannot be switched (class H)
   count too, when a driver names them: in the paper they occur in no clause and could never be diagnosed;
4. a node that works and gets ok inputs publishes what is ok;
5. software that works runs;
6. two publishers that work publish values whose trends match. In the paper the devices and the inputs of the two are
   left out, so that a base without power was taken for two faults; here they are in the antecedent.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

import msgspec

from ..literals import BadLiteral, Literal, made_atom, matched, on, parse, running
from .declaration import Clause, Component, Declaration, Expectation, Kind, Relation, Spelling

_SEPARATOR: Final = re.compile(r",(?![^()]*\))|\s+and\s+|∧|&")
_ARROW: Final = re.compile(r"->|→")
_NOT: Final = re.compile(r"\s*(?:not\s+|¬\s*)")


class Rule(msgspec.Struct, frozen=True, gc=False):
    """While all `needs` work and all of `body` holds, `head` holds; without a head: that cannot be."""

    needs: tuple[str, ...]
    body: tuple[Literal, ...]
    head: Literal | None
    origin: str
    """Which clause of the paper, or which of the user's."""
    where: str = ""

    def __str__(self) -> str:
        left = [*(f"not AB({name})" for name in self.needs), *map(str, self.body)]
        return f"{' and '.join(left) or 'always'} -> {self.head or 'false'}"


class BadClause(ValueError):
    """A clause that cannot be used, and why."""


def rules_of(declaration: Declaration) -> Iterator[Rule]:
    """The rules of everything but written clauses; names are taken as they are."""
    by_name = {component.name: component for component in declaration.components}
    for component in declaration.components:
        if component.is_implied:
            yield from _of_component(component)
    topics = {value.name: value.topic for value in declaration.values}
    for relation in declaration.relations:
        yield _of_relation(relation, by_name, topics)
    for expectation in declaration.expectations:
        yield _of_expectation(expectation)


def _of_component(component: Component) -> Iterator[Rule]:
    name, where = component.name, component.where
    match component.kind:
        case Kind.SWITCHABLE:
            yield Rule((name,), (), on(name), "clause 1", where)
            return
        case Kind.DEVICE:
            return
        case Kind.SWITCHED_DRIVER:
            origin = "clause 2"
        case Kind.DRIVER:
            origin = "clause 3"
        case Kind.NODE:
            origin = "clause 4"
    for topic, inputs in component.out.items():
        body = tuple(made_atom(wanted) for wanted in dict.fromkeys(inputs))
        yield Rule(_unique(name, *component.on), body, made_atom(topic), origin, where)
    yield Rule((name,), (), running(name), "clause 5", where)


def _of_relation(relation: Relation, by_name: dict[str, Component], topics: dict[str, str]) -> Rule:
    (one, first), (other, second) = relation.one, relation.other
    publishers = [(by_name[one], topics.get(first)), (by_name[other], topics.get(second))]
    needs = [name for component, _ in publishers for name in (component.name, *component.on)]
    inputs = [wanted for component, topic in publishers for wanted in _made_from(component, topic)]
    body = tuple(made_atom(wanted) for wanted in dict.fromkeys(inputs))
    return Rule(_unique(*needs), body, matched(first, second), "clause 6", relation.where)


def _made_from(component: Component, topic: str | None) -> Iterator[str]:
    """The inputs of the topic a value is in; of all topics if that is not declared."""
    for published, inputs in component.out.items():
        if topic is None or topic == published:
            yield from inputs


def _of_expectation(expectation: Expectation) -> Rule:
    body = tuple(_atom(text) for text in dict.fromkeys(expectation.given))
    return Rule(_unique(*expectation.of), body, _atom(expectation.atom), "expectation", expectation.where)


def _atom(text: str) -> Literal:
    literal = parse(text)
    if not literal.positive:
        raise BadClause(f"{text!r}: only positive atoms can be expected or given")
    return literal


def _unique(*names: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))


def read_clause(clause: Clause, spelling: Spelling) -> Rule | None:
    """The rule that a written clause means; None if it is always true and says nothing.

    Raises:
        BadClause: the text is no clause, it is not Horn, or it is about how a component behaves when faulty.

    >>> print(read_clause(Clause("NAB(jn), NAB(ja) -> ok(/odom)"), Spelling()))
    not AB(jn) and not AB(ja) -> ok(/odom)
    """
    sides = _ARROW.split(clause.text)
    if len(sides) != 2 or not sides[1].strip():
        raise BadClause("a clause is spelled `NAB(a), ok(b) -> ok(c)`")
    terms = [_term(part, spelling) for part in _SEPARATOR.split(sides[0])] if sides[0].strip() else []
    needs = [name for kind, name, _ in terms if kind == "works"]
    body = [atom for kind, _, atom in terms if kind == "atom" and atom is not None and atom.positive]
    heads = [~atom for kind, _, atom in terms if kind == "atom" and atom is not None and not atom.positive]
    if any(kind == "faulty" for kind, _, _ in terms):
        raise BadClause(_FAULT_MODE)
    if any(kind == "true" for kind, _, _ in terms):
        raise BadClause("false implies anything: the clause says nothing")
    kind, name, atom = _term(sides[1], spelling)
    match kind:
        case "works":
            raise BadClause(_FAULT_MODE)
        case "faulty":  # b -> AB(c) is: not both NAB(c) and b
            needs.append(name)
        case "atom" if atom is not None and atom.positive:
            heads.append(atom)
        case "atom" if atom is not None:
            body.append(~atom)
        case _:
            pass
    if len(heads) > 1:
        raise BadClause(f"not a Horn clause: it concludes one of {', '.join(map(str, heads))}")
    head = heads[0] if heads else None
    if head in body:
        return None
    return Rule(_unique(*needs), tuple(dict.fromkeys(body)), head, "written", clause.where)


_FAULT_MODE: Final = (
    "it says how a faulty component behaves, or proves one healthy; with such clauses the minimal diagnoses "
    "would no longer stand for all. Say only what components do while they work"
)


def _term(text: str, spelling: Spelling) -> tuple[str, str, Literal | None]:
    """One side's part: ("works" | "faulty", component, None), ("atom", "", literal) or ("true", "", None)."""
    text = text.strip()
    if text == "false":
        return "true", "", None
    negative = _NOT.match(text)
    if negative is not None:
        text = text[negative.end() :]
    elif spelling.neg_prefix and text.startswith(spelling.neg_prefix):
        negative, text = _NOT.match("not "), text[len(spelling.neg_prefix) :]
    try:
        literal = parse(text)
    except BadLiteral as error:
        raise BadClause(str(error)) from None
    if literal.name in (spelling.ab, spelling.nab):
        if len(literal.args) != 1:
            raise BadClause(f"{text!r}: {literal.name} takes one component")
        is_faulty = (literal.name == spelling.ab) == (negative is None)
        return "faulty" if is_faulty else "works", literal.args[0], None
    return "atom", "", literal if negative is None else ~literal
