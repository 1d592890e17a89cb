"""Domains and problems from PDDL text, parsed by the library `pddl` and checked by us.

It finds what is no PDDL; that predicates are declared, variables bound, arguments of the right type and number, is seen
to here. Names are case-sensitive.
"""

from __future__ import annotations

import contextlib
import functools
import sys
import threading
from collections.abc import Generator, Iterable, Mapping
from typing import Any

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
    Variable,
)

LARGEST_TEXT = 4_000_000
"""Characters of a domain or a problem."""
_PARSING = threading.Lock()
"""Held while the library has its way with `sys.tracebacklimit`, which is the whole process's."""
MERGED = (":requirements", ":types", ":constants", ":predicates", ":functions")
"""Sections of a domain whose contents an extension adds to."""


@functools.lru_cache(maxsize=64)
def read_domain(text: str) -> Domain:
    """A domain from PDDL: typed STRIPS with ADL conditions and effects, and costs by `(increase (total-cost) n)`.

    The same text is parsed once (that takes some 0.1 s).

    Raises:
        PlanningError: what is wrong, and in which action or where in the text.
    """
    from pddl.parser.domain import DomainParser

    parsed = _parse(DomainParser, text, "domain")
    if parsed.derived_predicates:
        raise PlanningError(f"domain {parsed.name}", "derived predicates are not supported")
    domain = Domain(
        name=str(parsed.name),
        types=tuple(sorted((str(kind), str(parent or "object")) for kind, parent in parsed.types.items())),
        predicates=tuple(sorted((str(p.name), tuple(_types(term) for term in p.terms)) for p in parsed.predicates)),
        actions=tuple(sorted((_action(action) for action in parsed.actions), key=lambda action: action.name)),
        constants=tuple(sorted((str(one.name), str(one.type_tag or "object")) for one in parsed.constants)),
    )
    _check(domain)
    return domain


def read_problem(domain: Domain, text: str) -> Problem:
    """A problem of this domain from PDDL; its goal is a conjunction of literals.

    Raises:
        PlanningError: what is wrong, and where.
    """
    from pddl.parser.problem import ProblemParser

    parsed = _parse(ProblemParser, text, "problem")
    where = f"problem {parsed.name}"
    if str(parsed.domain_name) != domain.name:
        raise PlanningError(where, f"it is of the domain {parsed.domain_name}, not {domain.name}")
    init = frozenset(_atom(one) for one in parsed.init if type(one).__name__ == "Predicate")
    objects = {str(one.name): str(one.type_tag or "object") for one in parsed.objects}
    return Problem(domain, objects, init, tuple(_goals(_formula(parsed.goal, where), where)))


@functools.lru_cache(maxsize=64)
def with_actions(domain_text: str, *extensions: str) -> str:
    """The text of a domain with more actions: each extension is one or more `(:action ...)` forms.

    An extension may also add to `(:types ...)`, `(:constants ...)` and `(:predicates ...)`.

    Raises:
        PlanningError: unbalanced parentheses, a form that no domain has, or an action that is there already.

    >>> print(with_actions("(define (domain d) (:predicates (on ?x)))", "(:predicates (off ?x))"))
    (define (domain d)
    (:predicates (on ?x)
    (off ?x)))
    """
    whole = _forms(domain_text, "domain")
    if len(whole) != 1 or not whole[0].startswith("("):
        raise PlanningError("domain", "the text must be one (define ...) form")
    head, *sections = _forms(whole[0][1:-1].removeprefix("define"), "domain")
    actions: dict[str, str] = {}
    for number, text in enumerate(("".join(sections), *extensions)):
        where = f"extension {number}" if number else "domain"
        for form in _forms(text, where):
            key, _, rest = form[1:-1].strip().partition(" ")
            key = key.split()[0] if key.split() else ""
            if key in MERGED and number:
                sections = _added(sections, key, form[1:-1].strip().removeprefix(key))
            elif key == ":action":
                name = (rest.split() or [""])[0]
                if name in actions:
                    raise PlanningError(where, f"there is an action {name} already")
                actions[name] = form
                if number:
                    sections.append(form)
            elif number:
                raise PlanningError(where, f"an extension holds :action, :types, :constants, :predicates, not {key!r}")
    return f"(define {head}\n" + "\n".join(sections) + ")"


def _added(sections: list[str], key: str, contents: str) -> list[str]:
    """A section with more in it; it is made, in its place ahead of the actions, if it is not there."""
    for index, section in enumerate(sections):
        if section[1:].strip().startswith(key):
            # The new line ends a comment.
            return [*sections[:index], f"{section[:-1].rstrip()}\n{contents.strip()})", *sections[index + 1 :]]
    ahead = [one for one in sections if one[1:].strip().startswith(MERGED[: MERGED.index(key)])]
    return [*ahead, f"({key}{contents})", *[one for one in sections if one not in ahead]]


def _forms(text: str, where: str) -> list[str]:
    """The forms in parentheses that the text consists of, without comments."""
    lines = [line.partition(";")[0] for line in text.splitlines()]
    forms: list[str] = []
    depth = begin = 0
    plain = "\n".join(lines)
    for index, sign in enumerate(plain):
        if sign == "(":
            begin = index if depth == 0 else begin
            depth += 1
        elif sign == ")":
            depth -= 1
            if depth < 0:
                break
            if depth == 0:
                forms.append(plain[begin : index + 1])
    if depth:
        raise PlanningError(where, "its parentheses do not match")
    return forms


def _parse(parser: Any, text: str, what: str) -> Any:
    if len(text) > LARGEST_TEXT:
        raise PlanningError(what, f"it has {len(text)} characters, and {LARGEST_TEXT} are allowed")
    try:
        with _with_tracebacks():
            return parser()(text)
    except RecursionError as error:
        raise PlanningError(what, "its forms are nested too deeply") from error
    except (TypeError, AttributeError) as error:
        # The library trips over an action that leaves out a part, which PDDL allows.
        raise PlanningError(
            what, "it cannot be read: an action needs :parameters, :precondition and :effect"
        ) from error
    except Exception as error:  # The library raises what its parser and its checks happen to raise: all mean the text.
        raise PlanningError(what, " ".join(str(error).split())[:500] or type(error).__name__) from error


@contextlib.contextmanager
def _with_tracebacks() -> Generator[None, None, None]:
    """The library sets `sys.tracebacklimit` to 0, and leaves it so when it fails: no crash would be traced any more."""
    with _PARSING:
        before = getattr(sys, "tracebacklimit", None)
        try:
            yield
        finally:
            if before is not None:
                sys.tracebacklimit = before
            elif hasattr(sys, "tracebacklimit"):
                del sys.tracebacklimit


def _types(term: Any) -> tuple[str, ...]:
    return tuple(sorted(str(tag) for tag in term.type_tags)) or ("object",)


def _term(term: Any) -> str:
    return f"?{term.name}" if type(term).__name__ == "Variable" else str(term.name)


def _variables(terms: Iterable[Any]) -> tuple[Variable, ...]:
    return tuple(Variable(f"?{term.name}", _types(term)) for term in terms)


def _atom(predicate: Any) -> Atom:
    return (str(predicate.name), *[_term(term) for term in predicate.terms])


def _action(action: Any) -> Action:
    where = f"action {action.name}"
    precondition = And() if action.precondition is None else _formula(action.precondition, where)
    effects: list[Effect] = []
    costs: list[int] = []
    if action.effect is not None:
        _effects(action.effect, (), And(), effects, costs, where)
    return Action(
        str(action.name), _variables(action.parameters), precondition, tuple(effects), sum(costs) if costs else 1
    )


def _formula(parsed: Any, where: str) -> Formula:
    match type(parsed).__name__:
        case "Predicate":
            return Fact(_atom(parsed))
        case "EqualTo" if hasattr(parsed, "left"):
            return Same(_term(parsed.left), _term(parsed.right))
        case "Not":
            return Not(_formula(parsed.argument, where))
        case "And":
            return And(tuple(_formula(one, where) for one in parsed.operands))
        case "Or":
            return Or(tuple(_formula(one, where) for one in parsed.operands))
        case "Imply":
            condition, then = (_formula(one, where) for one in parsed.operands)
            return Or((Not(condition), then))
        case "ForallCondition":
            return ForAll(_variables(sorted(parsed.variables)), _formula(parsed.condition, where))
        case "ExistsCondition":
            return Exists(_variables(sorted(parsed.variables)), _formula(parsed.condition, where))
        case other:
            raise PlanningError(where, f"a condition of the kind {other} is not supported")


def _effects(
    parsed: Any,
    variables: tuple[Variable, ...],
    condition: Formula,
    effects: list[Effect],
    costs: list[int],
    where: str,
) -> None:
    """Flatten an effect into single literals, each with its condition."""
    match type(parsed).__name__:
        case "And":
            for one in parsed.operands:
                _effects(one, variables, condition, effects, costs, where)
        case "Forall":
            more = _variables(sorted(parsed.variables))
            _effects(parsed.effect, (*variables, *more), condition, effects, costs, where)
        case "When":
            narrower = And((condition, _formula(parsed.condition, where)))
            _effects(parsed.effect, variables, narrower, effects, costs, where)
        case "Predicate":
            effects.append(Effect(variables, condition, PlanLiteral(_atom(parsed))))
        case "Not" if type(parsed.argument).__name__ == "Predicate":
            effects.append(Effect(variables, condition, PlanLiteral(_atom(parsed.argument), False)))
        case "Increase" if not variables and condition == And():
            costs.append(_cost(parsed, where))
        case other:
            raise PlanningError(where, f"an effect of the kind {other} is not supported here")


def _cost(parsed: Any, where: str) -> int:
    function, amount = parsed.operands
    value = getattr(amount, "value", None)
    if str(function.name) != "total-cost" or value is None or value < 0 or int(value) != value:
        raise PlanningError(where, "only (increase (total-cost) n) with a whole n >= 0 is supported")
    return int(value)


def _goals(formula: Formula, where: str) -> Iterable[PlanLiteral]:
    match formula:
        case Fact(atom):
            yield PlanLiteral(atom)
        case Not(Fact(atom)):
            yield PlanLiteral(atom, False)
        case And(of):
            for part in of:
                yield from _goals(part, where)
        case _:
            raise PlanningError(where, "its goal must be a conjunction of literals")


def _check(domain: Domain) -> None:
    known = {kind for kind, _ in domain.types} | {"object"}
    declared = dict(domain.predicates)
    for kind, parent in domain.types:
        if parent not in known:
            raise PlanningError(f"type {kind}", f"there is no type {parent}")
        if kind in list(domain.above(parent)) and kind != "object":
            raise PlanningError(f"type {kind}", "it belongs to itself")
    for action in domain.actions:
        where = f"action {action.name}"
        scope = {variable.name: variable.types for variable in action.parameters}
        if len(scope) != len(action.parameters):
            raise PlanningError(where, "two parameters have the same name")
        scope |= {name: (kind,) for name, kind in domain.constants}
        check = _Check(domain, where, declared, known)
        check.variables(action.parameters)
        check.formula(action.precondition, scope)
        for effect in action.effects:
            check.variables(effect.variables)
            inner = {**scope, **{variable.name: variable.types for variable in effect.variables}}
            check.formula(effect.condition, inner)
            check.atom(effect.literal.atom, inner)


class _Check:
    """Sees to it that what an action speaks of exists and fits."""

    def __init__(
        self, domain: Domain, where: str, declared: Mapping[str, tuple[tuple[str, ...], ...]], known: set[str]
    ) -> None:
        self._domain, self._where, self._declared, self._known = domain, where, declared, known

    def formula(self, formula: Formula, scope: Mapping[str, tuple[str, ...]]) -> None:
        match formula:
            case Fact(atom):
                self.atom(atom, scope)
            case Same(left, right):
                for name in (left, right):
                    self._bound(name, scope)
            case Not(of):
                self.formula(of, scope)
            case And(of) | Or(of):
                for part in of:
                    self.formula(part, scope)
            case ForAll(variables, of) | Exists(variables, of):
                self.variables(variables)
                self.formula(of, {**scope, **{variable.name: variable.types for variable in variables}})

    def variables(self, variables: Iterable[Variable]) -> None:
        for variable in variables:
            for kind in variable.types:
                if kind not in self._known:
                    raise PlanningError(self._where, f"there is no type {kind}")

    def atom(self, atom: Atom, scope: Mapping[str, tuple[str, ...]]) -> None:
        expected = self._declared.get(atom[0])
        if expected is None:
            raise PlanningError(self._where, f"there is no predicate {atom[0]}")
        if len(expected) != len(atom) - 1:
            raise PlanningError(self._where, f"{atom[0]} takes {len(expected)} arguments, not {len(atom) - 1}")
        for name, kinds in zip(atom[1:], expected, strict=True):
            self._bound(name, scope)
            if not any(self._fits(mine, kinds) for mine in scope[name]):
                raise PlanningError(
                    self._where, f"{name} in {atom[0]} is a {' or '.join(scope[name])}, no {' or '.join(kinds)}"
                )

    def _bound(self, name: str, scope: Mapping[str, tuple[str, ...]]) -> None:
        if name not in scope:
            raise PlanningError(self._where, f"{name} is no parameter and no constant")

    def _fits(self, mine: str, kinds: tuple[str, ...]) -> bool:
        """A variable of a wider type is fine: the objects it ranges over are then fewer."""
        upwards = set(self._domain.above(mine))
        return any(kind in upwards or mine in set(self._domain.above(kind)) for kind in kinds)
