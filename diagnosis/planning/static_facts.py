"""The part of a problem that no action changes: its objects and static facts, and what variables may stand for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from .language import And, Atom, Domain, Effect, Exists, Fact, ForAll, Formula, Not, Or, Problem, Variable

Binding = Mapping[str, str]
"""What each variable stands for."""


def fill(atom: Atom, bound: Binding) -> Atom:
    """The atom with its variables replaced, as far as they are bound."""
    return (atom[0], *[bound.get(name, name) for name in atom[1:]])


class StaticFacts:
    """Objects by type, and static facts by what they say of whom."""

    def __init__(self, domain: Domain, objects: Mapping[str, str], statics: frozenset[Atom]) -> None:
        self.domain, self.statics = domain, statics
        self.changing = domain.changing()
        self._by_type: dict[str, list[str]] = {}
        above = {kind: frozenset(domain.above(kind)) for kind in set(objects.values())}
        self._types = {name: above[kind] for name, kind in objects.items()}
        for name in sorted(objects):
            for kind in self._types[name]:
                self._by_type.setdefault(kind, []).append(name)
        self._facts: dict[tuple[str, int, str], list[Atom]] = {}
        for atom in sorted(statics):
            self._facts.setdefault((atom[0], 0, ""), []).append(atom)
            for place, name in enumerate(atom[1:], 1):
                self._facts.setdefault((atom[0], place, name), []).append(atom)

    @classmethod
    def of(cls, problem: Problem) -> StaticFacts:
        """The world of a problem."""
        return cls(problem.domain, problem.everything(), statics(problem))

    def is_of(self, name: str, types: Iterable[str]) -> bool:
        """Whether the object exists and is of one of the types."""
        return not self._types.get(name, frozenset()).isdisjoint(types)

    def bindings(self, variables: Sequence[Variable], guards: Sequence[Atom], bound: Binding) -> Iterator[Binding]:
        """Every way to bind the variables for which the guards, atoms of static predicates, are true.

        An object's facts are looked up, so that a thousand nodes with a device each are a thousand steps, no million.
        """
        free = [variable for variable in variables if variable.name not in bound]
        if not free:
            yield bound
            return
        names = {variable.name for variable in free}
        useful = [(self._candidates(guard, bound), guard) for guard in guards if not names.isdisjoint(guard[1:])]
        if not useful:
            first, *_ = free
            for name in self.of_types(first.types):
                yield from self.bindings(free, guards, {**bound, first.name: name})
            return
        facts, guard = min(useful, key=lambda one: len(one[0]))
        types = {variable.name: variable.types for variable in free}
        for fact in facts:
            more = self._match(guard, fact, bound, types)
            if more is not None:
                yield from self.bindings(free, guards, {**bound, **more})

    def of_types(self, types: Sequence[str]) -> list[str]:
        """All objects of these types."""
        if len(types) == 1:
            return self._by_type.get(types[0], [])
        return sorted({name for kind in types for name in self._by_type.get(kind, ())})

    def _candidates(self, guard: Atom, bound: Binding) -> list[Atom]:
        """Static facts that may match: the shortest list there is."""
        keys = [(guard[0], 0, "")]
        for place, name in enumerate(guard[1:], 1):
            if not name.startswith("?") or name in bound:
                keys.append((guard[0], place, bound.get(name, name)))
        return min((self._facts.get(key, []) for key in keys), key=len)

    def _match(
        self, guard: Atom, fact: Atom, bound: Binding, types: Mapping[str, tuple[str, ...]]
    ) -> dict[str, str] | None:
        """What the guard's free variables are if it is to be this fact."""
        more: dict[str, str] = {}
        for wanted, name in zip(guard[1:], fact[1:], strict=True):
            known = bound.get(wanted) or more.get(wanted) or (None if wanted.startswith("?") else wanted)
            if known is None:
                # A variable of an outer formula is bound before; what is left are ours.
                if not self.is_of(name, types[wanted]):
                    return None
                more[wanted] = name
            elif known != name:
                return None
        return more

    def guards(self, formula: Formula) -> list[Atom]:
        """Static facts that must be true if a conjunction is to be."""
        match formula:
            case Fact(atom) if atom[0] not in self.changing:
                return [atom]
            case And(of):
                return [atom for part in of for atom in self.guards(part)]
            case _:
                return []

    def instances(self, formula: ForAll | Exists, bound: Binding) -> Iterator[Binding]:
        """The bindings that matter to a quantifier: for the others its body is true (forall) or false (exists)."""
        if not formula.variables:
            yield bound
            return
        guards = self.guards(formula.of) if isinstance(formula, Exists) else self._excuses(formula.of)
        # What a quantifier binds hides what is bound outside.
        inner = {name: value for name, value in bound.items() if name not in {v.name for v in formula.variables}}
        yield from self.bindings(formula.variables, [fill(guard, inner) for guard in guards], inner)

    def places(self, effect: Effect, bound: Binding) -> Iterable[Binding]:
        """The bindings for which an effect may come: with its own variables bound as well."""
        if not effect.variables:
            return (bound,)
        return self.instances(ForAll(effect.variables, Or((Not(effect.condition),))), bound)

    def _excuses(self, formula: Formula) -> list[Atom]:
        """Static facts without any one of which the formula is true."""
        match formula:
            case Not(of):
                return self.guards(of)
            case Or(of):
                return [atom for part in of for atom in self._excuses(part)]
            case _:
                return []


def statics(problem: Problem) -> frozenset[Atom]:
    """The facts that no action changes."""
    changing = problem.domain.changing()
    return frozenset(atom for atom in problem.init if atom[0] not in changing)
