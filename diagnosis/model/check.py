"""Checks a declaration: it becomes a model that can be used, or a list of all that is wrong with it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from typing import Final

import msgspec

from ...actors.errors import HoldfastError
from ..literals import ARITIES, BadLiteral, Literal, Vocabulary, made_atom, on, parse, running
from .clauses import BadClause, Rule, read_clause, rules_of
from .declaration import Component, Declaration, Kind, System, settle_kinds

_NAME: Final = re.compile(r"[^\s(),]+\Z")
_FORM: Final = re.compile(r"[A-Za-z_]\w*\([^\s()]+\)\Z")  # what is made may be another atom than that of a topic


class ModelProblem(msgspec.Struct, frozen=True):
    """Something wrong with a declaration, and where."""

    where: str
    text: str

    def __str__(self) -> str:
        return f"{self.where}: {self.text}" if self.where else self.text


class ModelError(HoldfastError, text="{problems:\n}"):
    """A model that cannot be used: all that is wrong with it, one line each, with file and line where there is one."""

    problems: tuple[str, ...]


class Model:
    """A checked model. It never changes; `History` keeps the versions of one that does.

    Raises:
        ModelError: something is wrong with the declaration.
    """

    def __init__(self, declaration: Declaration | System, version: int = 1) -> None:
        declared = declaration.declaration() if isinstance(declaration, System) else declaration
        declared = msgspec.structs.replace(declared, components=settle_kinds(declared.components))
        problems = [*_names(declared), *_inputs(declared)]
        rules: list[Rule] = []
        if not problems:  # rules can be made only of names that exist
            rules = list(_rules(declared, problems))
            problems += _arities(rules, declared)
            problems += _cycles(rules)
        if problems:
            raise ModelError(tuple(map(str, problems)))
        self.declaration = declared
        self.version = version
        self.components = {component.name: component for component in declared.components}
        self.rules = tuple(dict.fromkeys(rules))
        self.vocabulary = Vocabulary(_atoms(declared, self.rules))

    def dependents(self, components: Iterable[str]) -> frozenset[Literal]:
        """The atoms that are only sure to hold while all of these components work."""
        touched, atoms = set(components), set[Literal]()
        by_input: dict[Literal, list[Literal]] = {}
        todo: list[Literal] = []
        for rule in self.rules:
            if rule.head is not None:
                for atom in rule.body:
                    by_input.setdefault(atom, []).append(rule.head)
                if not touched.isdisjoint(rule.needs):
                    todo.append(rule.head)
        while todo:
            atom = todo.pop()
            if atom not in atoms:
                atoms.add(atom)
                todo += by_input.get(atom, ())
        return frozenset(atoms)


def _names(declared: Declaration) -> Iterator[ModelProblem]:
    """Names that cannot be, are taken, or lead nowhere."""
    first: dict[str, Component] = {}
    for component in declared.components:
        if not _NAME.match(component.name):
            yield ModelProblem(
                component.where, f"{component.name!r} is no name: no spaces, brackets and commas, please"
            )
        elif component.name in first:
            before = first[component.name].where
            yield ModelProblem(
                component.where, f"{component.name} is declared twice{f', also at {before}' * bool(before)}"
            )
        first.setdefault(component.name, component)
    for component in declared.components:
        yield from _of_component(component, first)
    for relation in declared.relations:
        for name, _ in (relation.one, relation.other):
            yield from _software(name, first, relation.where)
        if relation.one[1] == relation.other[1]:
            yield ModelProblem(relation.where, f"{relation.one[1]} is related to itself")
        yield from _bad_words(relation.where, (relation.one[1], relation.other[1]))
    for expectation in declared.expectations:
        if not expectation.of:
            yield ModelProblem(expectation.where, f"{expectation.atom} is expected of no component")
        for name in expectation.of:
            if name not in first:
                yield ModelProblem(expectation.where, f"{expectation.atom} is expected of {_unknown(name, first)}")
    topics = {topic for component in declared.components for topic in component.out}
    for value in declared.values:
        yield from _bad_words(value.where, (value.name,))
        if value.topic not in topics and f"ok({value.topic})" not in declared.propositions:
            yield ModelProblem(value.where, f"value {value.name} is in {_unknown(value.topic, topics, 'topic')}")


def _of_component(component: Component, known: dict[str, Component]) -> Iterator[ModelProblem]:
    name, where = component.name, component.where
    if not 0 < component.prior < 1:
        yield ModelProblem(where, f"prior of {name} is {component.prior:g}; it must be between 0 and 1, without these")
    if component.kind.is_hardware and (component.out or component.on):
        yield ModelProblem(where, f"{name} is a device: it publishes nothing and drives nothing; its driver does")
    if component.kind is Kind.NODE and component.on:
        yield ModelProblem(where, f"{name} drives {', '.join(component.on)}: declare it as a driver")
    for device in component.on:
        if device not in known:
            yield ModelProblem(where, f"{name} drives {_unknown(device, known)}")
        elif not known[device].kind.is_hardware:
            yield ModelProblem(where, f"{name} drives {device}, which is no device")
    made = [*component.out, *(topic for made_from in component.out.values() for topic in made_from)]
    yield from _bad_words(where, [word for word in made if not _FORM.match(word)])


def _bad_words(where: str, words: Iterable[str]) -> Iterator[ModelProblem]:
    for word in words:
        if not _NAME.match(word):
            yield ModelProblem(where, f"{word!r} is no name: no spaces, brackets and commas, please")


def _software(name: str, known: dict[str, Component], where: str) -> Iterator[ModelProblem]:
    if name not in known:
        yield ModelProblem(where, f"a value is related of {_unknown(name, known)}")
    elif known[name].kind.is_hardware:
        yield ModelProblem(where, f"a value of {name} is related, but a device publishes none: name its driver")


def _rules(declared: Declaration, problems: list[ModelProblem]) -> Iterator[Rule]:
    """All rules; what cannot be one is added to `problems`."""
    known = {component.name for component in declared.components}
    try:
        yield from rules_of(declared)
    except (BadClause, BadLiteral) as error:
        problems.append(ModelProblem(declared.where, str(error)))
    for clause in declared.clauses:
        try:
            rule = read_clause(clause, declared.spelling)
        except BadClause as error:
            problems.append(ModelProblem(clause.where, f"clause {clause.text!r}: {error}"))
            continue
        if rule is not None:
            unknown = [name for name in rule.needs if name not in known]
            problems += (
                ModelProblem(clause.where, f"clause {clause.text!r}: {_unknown(name, known)}") for name in unknown
            )
            yield rule


def _inputs(declared: Declaration) -> Iterator[ModelProblem]:
    """Topics that are needed and published by nobody: most often a slip of the pen."""
    known = {str(made_atom(topic)) for component in declared.components for topic in component.out}
    known |= set(declared.propositions) | {expectation.atom for expectation in declared.expectations}
    for component in declared.components:
        for topic, inputs in component.out.items():
            for wanted in inputs:
                if str(made_atom(wanted)) not in known:
                    topics = [atom[3:-1] for atom in known if atom.startswith("ok(")]
                    what = f"{topic} of {component.name} is made from {_unknown(wanted, topics, 'topic')}"
                    yield ModelProblem(component.where, f"{what}; if it comes from outside, declare it as external")


def _arities(rules: list[Rule], declared: Declaration) -> Iterator[ModelProblem]:
    """Predicates with another number of arguments than elsewhere, and written clauses with atoms nobody declared."""
    arities = dict(ARITIES)
    for text in declared.propositions:
        try:
            atom = parse(text)
        except BadLiteral as error:
            yield ModelProblem(declared.where, str(error))
        else:
            if not atom.positive:
                yield ModelProblem(declared.where, f"{text!r}: a proposition is declared without its negation")
            yield from _arity(atom, arities, declared.where)
    for rule in rules:
        for atom in (*rule.body, *([rule.head] if rule.head else [])):
            yield from _arity(atom, arities, rule.where)
    written = [rule for rule in rules if rule.origin == "written"]
    vocabulary = Vocabulary(_atoms(declared, [rule for rule in rules if rule.origin != "written"]))
    for rule in written:
        for atom in (*rule.body, *([rule.head] if rule.head else [])):
            try:
                vocabulary.check(atom)
            except BadLiteral as error:
                yield ModelProblem(rule.where, f"{error} (clause {rule}); declare it as a proposition")


def _arity(atom: Literal, arities: dict[str, int], where: str) -> Iterator[ModelProblem]:
    wanted = arities.setdefault(atom.name, len(atom.args))
    if wanted != len(atom.args):
        yield ModelProblem(where, f"{atom}: {atom.name} takes {wanted} argument{'s' * (wanted != 1)}")


def _cycles(rules: list[Rule]) -> Iterator[ModelProblem]:
    """One circle of atoms that hold because of each other: a fault in it would go unexplained."""
    needed: dict[Literal, dict[Literal, str]] = {}
    for rule in rules:
        if rule.head is not None:
            needed.setdefault(rule.head, {}).update((atom, rule.where) for atom in rule.body)
    done: set[Literal] = set()
    for start in needed:
        circle = _circle(start, needed, done)
        if circle:
            way = " <- ".join(map(str, circle))
            where = needed[circle[0]][circle[1]]
            yield ModelProblem(where, f"circle: {way}; leave out the input that matters least")
            return


def _circle(start: Literal, needed: dict[Literal, dict[Literal, str]], done: set[Literal]) -> list[Literal]:
    """Depth first, without recursion: chains may be thousands long."""
    path: dict[Literal, None] = {}
    stack: list[tuple[Literal, Iterator[Literal]]] = []

    def enter(atom: Literal) -> None:
        path[atom] = None
        stack.append((atom, iter(needed.get(atom, ()))))

    if start not in done:
        enter(start)
    while stack:
        atom, rest = stack[-1]
        following = next(rest, None)
        if following is None:
            stack.pop()
            del path[atom]
            done.add(atom)
        elif following in path:
            way = list(path)
            return [*way[way.index(following) :], following]
        elif following not in done:
            enter(following)
    return []


def _atoms(declared: Declaration, rules: Iterable[Rule]) -> Iterator[Literal]:
    """Every atom that the model declares."""
    for rule in rules:
        yield from rule.body
        if rule.head is not None:
            yield rule.head
    yield from map(parse, declared.propositions)
    for component in declared.components:
        if component.is_implied:
            yield from map(made_atom, component.out)
            if component.kind is Kind.SWITCHABLE:
                yield on(component.name)
            elif not component.kind.is_hardware:
                yield running(component.name)
    related = (value for relation in declared.relations for _, value in (relation.one, relation.other))
    for value in dict.fromkeys((*(value.name for value in declared.values), *related)):
        yield from (Literal(trend, (value,)) for trend in ("inc", "dec", "const"))


def _unknown(name: str, known: Iterable[str], what: str = "component") -> str:
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"{name}, a {what} that does not exist{f' (did you mean {near[0]}?)' if near else ''}"
