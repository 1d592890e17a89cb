"""The cone of influence: the few rules that can explain what was observed.

From the observed failures rules are walked backwards. A body atom that was observed is gone from the rule, a rule with
a body atom observed not to hold can never apply, and a component that a failure convicts by itself takes the rules that
need it along. What is left falls into parts that share neither components nor atoms; the minimal diagnoses of the whole
are the combinations of theirs. Sound because the model is Horn and says nothing of how faulty components behave.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Final, NamedTuple

from ..literals import Literal
from ..model import Model
from .breath import breathe, breathing
from .connected import connected

FALSE: Final = 0
"""The atom that never holds: the head of rules without one."""
NO_WORK: Final = ("running", "room", "keeps_up", "led")
"""What is said of components whether they have done anything or not."""


class RuleStep(NamedTuple):
    """What is left of a rule: while all `needs` work and `body` holds, `head` holds; all in numbers."""

    needs: tuple[int, ...]
    body: tuple[int, ...]
    head: int
    rule: int


class RulePart(NamedTuple):
    """Rules that hang together: `denials` end in a failure, `steps` in an atom that nobody observed."""

    denials: tuple[RuleStep, ...]
    steps: tuple[RuleStep, ...]

    @property
    def components(self) -> list[int]:
        """Who may be to blame."""
        return sorted({component for step in (*self.denials, *self.steps) for component in step.needs})


class Cone(NamedTuple):
    """All that matters: components that are surely faulty, and the parts."""

    convicted: tuple[RuleStep, ...]
    """One rule that ends in a failure for each component that is surely faulty."""
    parts: tuple[RulePart, ...]

    @property
    def faulty(self) -> frozenset[int]:
        """The components that are in each diagnosis."""
        return frozenset(step.needs[0] for step in self.convicted)


class NumberedExpectation(NamedTuple):
    """What an expectation says in numbers: `atom` holds while `needs` work and the atoms `given` hold."""

    atom: int
    needs: tuple[int, ...]
    given: tuple[int, ...]


class Index:
    """A model in numbers, made once per version."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.names = tuple(model.components)
        self.components = tuple(model.components.values())
        self.number = {name: number for number, name in enumerate(self.names)}
        self.atoms: tuple[Literal | None, ...] = (None, *model.vocabulary)
        self.atom = {atom: number for number, atom in enumerate(self.atoms)}
        self.steps = tuple(
            RuleStep(
                tuple(self.number[name] for name in rule.needs),
                tuple(self.atom[model.vocabulary.check(atom)] for atom in rule.body),
                FALSE if rule.head is None else self.atom[model.vocabulary.check(rule.head)],
                number,
            )
            for number, rule in enumerate(model.rules)
        )
        makers: list[list[RuleStep]] = [[] for _ in self.atoms]
        for step in self.steps:
            makers[step.head].append(step)
        self.makers = tuple(map(tuple, makers))
        """By atom, the rules that conclude it."""
        users: list[list[RuleStep]] = [[] for _ in self.atoms]
        for step in self.steps:
            for atom in step.body:
                users[atom].append(step)
        self.users = tuple(map(tuple, users))
        """By atom, the rules that need it."""
        busy = {one for step in self.steps if self.is_work(step.head) for one in step.needs}
        self.only_run = frozenset(range(len(self.names))) - busy
        """Components of which nothing else follows than that they run."""
        self.expectations = tuple(self._expectations(model))
        """What is expected and somebody is to see."""
        self.unconditional = tuple(step for step in self.steps if not step.needs)
        """Rules that hold whoever is faulty: they can make observations contradict the model."""

    def _expectations(self, model: Model) -> Iterator[NumberedExpectation]:
        words = model.vocabulary
        for one in model.declaration.expectations:
            if not one.is_quiet:
                given = tuple(self.atom[words.parse(text)] for text in one.given)
                yield NumberedExpectation(
                    self.atom[words.parse(one.atom)], tuple(self.number[name] for name in one.of), given
                )

    def is_work(self, atom: int) -> bool:
        """Whether an atom says something of the work of a component: more than that it runs, and has room."""
        literal = self.atoms[atom]
        return literal is not None and literal.name not in NO_WORK

    def numbers(self, atoms: Collection[Literal]) -> frozenset[int]:
        """The numbers of atoms.

        Raises:
            BadLiteral: the model has no such atom.
        """
        breathe()
        try:
            return frozenset(map(self.atom.__getitem__, breathing(atoms, 1024)))
        except KeyError:  # spelled in the other order, or unknown
            check = self.model.vocabulary.check
            return frozenset(self.atom[check(atom)] for atom in atoms)


def cone_of(index: Index, positive: frozenset[int], negative: frozenset[int]) -> Cone:
    """What explains that the atoms `negative` do not hold, while `positive` do.

    The observations must not contradict the model by themselves (see `contradiction`).
    """
    failures = negative | {FALSE}
    convicted: dict[int, RuleStep] = {}
    for failure in sorted(failures):
        for step in index.makers[failure]:
            if len(step.needs) == 1 and positive.issuperset(step.body):
                convicted.setdefault(step.needs[0], step)
    reached = _backwards(index, positive, negative, convicted)
    kept = _reaching(_grounded(reached), failures)
    return Cone(tuple(convicted.values()), tuple(parts_of(kept, failures)))


def _backwards(
    index: Index, positive: frozenset[int], negative: frozenset[int], faulty: dict[int, RuleStep]
) -> list[RuleStep]:
    """The rules that lead to a failure, without what is known."""
    todo = [FALSE, *negative]
    met = set(todo)
    found: list[RuleStep] = []
    for atom in breathing(todo):  # it grows
        for step in index.makers[atom]:
            if faulty and any(component in faulty for component in step.needs):
                continue
            if step.body:
                if not negative.isdisjoint(step.body):
                    continue
                body = tuple(needed for needed in step.body if needed not in positive)
                if len(body) != len(step.body):
                    step = RuleStep(step.needs, body, step.head, step.rule)
                for needed in body:
                    if needed not in met:
                        met.add(needed)
                        todo.append(needed)
            found.append(step)
    return found


def _grounded(steps: list[RuleStep]) -> list[RuleStep]:
    """Without rules that wait for an atom which nothing can make hold."""
    waiting: dict[int, list[int]] = {}
    missing = [len(step.body) for step in steps]
    for number, step in enumerate(breathing(steps)):
        for atom in step.body:
            waiting.setdefault(atom, []).append(number)
    if not waiting:
        return steps
    holds: set[int] = set()
    todo = [step.head for step, count in zip(steps, missing, strict=True) if not count]
    for atom in breathing(todo):  # it grows
        if atom in holds:
            continue
        holds.add(atom)
        for number in waiting.get(atom, ()):
            missing[number] -= 1
            if not missing[number]:
                todo.append(steps[number].head)
    return [step for step, count in zip(steps, missing, strict=True) if not count]


def _reaching(steps: list[RuleStep], failures: frozenset[int]) -> list[RuleStep]:
    """Without rules that lead to no failure any more."""
    makers: dict[int, list[RuleStep]] = {}
    for step in steps:
        makers.setdefault(step.head, []).append(step)
    todo = sorted(failures)
    met = set(todo)
    kept: list[RuleStep] = []
    for atom in breathing(todo):  # it grows
        for step in makers.get(atom, ()):
            kept.append(step)
            for needed in step.body:
                if needed not in met:
                    met.add(needed)
                    todo.append(needed)
    return kept


def parts_of(steps: list[RuleStep], failures: frozenset[int]) -> Iterator[RulePart]:
    """Group what hangs together by a component or by an atom that nobody observed."""

    def keys_of(step: RuleStep) -> Iterator[int]:
        yield from (~component for component in step.needs)  # Atoms are >= 0.
        yield from step.body
        if step.head not in failures:
            yield step.head

    for group in connected(steps, keys_of):
        denials = tuple(step for step in group if step.head in failures)
        yield RulePart(denials, tuple(step for step in group if step.head not in failures))


def contradiction(index: Index, positive: frozenset[int], negative: frozenset[int]) -> tuple[Literal, ...]:
    """Observations that contradict the model whoever is faulty, without one that could be left out; () if none do."""
    if not index.unconditional:
        return ()
    why: dict[int, RuleStep] = {}
    known = set(positive)
    grown = True
    while grown:
        grown = False
        for step in index.unconditional:
            if step.head not in known and known.issuperset(step.body):
                known.add(step.head)
                why[step.head] = step
                grown = True
    torn = next((atom for atom in sorted(negative | {FALSE}) if atom in known), None)
    # What was observed to hold and not to hold is the caller's to find: an observed atom has no `why`.
    return () if torn is None else _reasons(index, positive, torn, why)


def _reasons(index: Index, positive: frozenset[int], torn: int, why: dict[int, RuleStep]) -> tuple[Literal, ...]:
    """The observations a conclusion rests on, and the one it contradicts."""
    needed: set[int] = set()
    todo = [torn]
    for atom in todo:  # it grows
        if atom in positive:
            needed.add(atom)
        else:
            todo += why[atom].body
    kept = sorted(needed)
    for atom in tuple(kept):
        fewer = frozenset(kept) - {atom}
        if _follows(index, fewer, torn):
            kept.remove(atom)
    reasons = [literal for atom in kept if (literal := index.atoms[atom]) is not None]
    denied = index.atoms[torn]
    return tuple(reasons) if denied is None else (*reasons, ~denied)


def _follows(index: Index, facts: frozenset[int], wanted: int) -> bool:
    known = set(facts)
    size = -1
    while size != len(known):
        size = len(known)
        known.update(step.head for step in index.unconditional if known.issuperset(step.body))
    return wanted in known
