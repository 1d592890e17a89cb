"""Second opinions on diagnoses: a hitting-set graph after Reiter, and MCS enumeration by python-sat.

Both work on the rules of the whole model, as they are printed: no cone, no parts, no numbers of the engine.
"""

from collections.abc import Collection
from typing import Any

from hypothesis import strategies as st
from pysat.examples.lbx import LBX
from pysat.formula import WCNF

from holdfast.diagnosis.literals import Literal
from holdfast.diagnosis.model import Model, System

Sets = set[frozenset[str]]


def is_consistent(
    model: Model, positive: Collection[Literal], negative: Collection[Literal], faulty: Collection[str]
) -> bool:
    """Whether these components being faulty, and all others working, fits model and observations."""
    known = set(positive)
    while True:
        applying = [r for r in model.rules if not set(r.needs) & set(faulty) and known.issuperset(r.body)]
        if any(rule.head is None for rule in applying):
            return False
        new = {rule.head for rule in applying if rule.head is not None} - known
        if not new:
            return not known & set(negative)
        known |= new


def minimal_conflict(
    model: Model, positive: Collection[Literal], negative: Collection[Literal], faulty: Collection[str]
) -> frozenset[str] | None:
    """A minimal conflict among the components that are not `faulty`; None if there is none."""
    conflict = set(model.components) - set(faulty)
    if is_consistent(model, positive, negative, set(model.components) - conflict):
        return None
    for name in sorted(conflict):
        if not is_consistent(model, positive, negative, set(model.components) - (conflict - {name})):
            conflict.remove(name)
    return frozenset(conflict)


def hitting_set_graph(model: Model, positive: Collection[Literal], negative: Collection[Literal]) -> Sets | None:
    """All minimal diagnoses, breadth first; nodes with the same set are one. None if nothing is consistent."""
    if not is_consistent(model, positive, negative, model.components):
        return None
    diagnoses: Sets = set()
    conflicts: Sets = set()
    level: Sets = {frozenset()}
    while level:
        below: Sets = set()
        for node in level:
            if any(found <= node for found in diagnoses):
                continue
            label = next((known for known in conflicts if not known & node), None)
            label = label or minimal_conflict(model, positive, negative, node)
            if label is None:
                diagnoses.add(node)
            else:
                conflicts.add(label)
                below |= {node | {name} for name in label}
        level = below
    return diagnoses


def correction_sets(model: Model, positive: Collection[Literal], negative: Collection[Literal]) -> Sets:
    """All minimal diagnoses, as the minimal correction sets of "every component works"; for consistent observations."""
    names = list(model.components)
    variables: dict[Any, int] = {name: number for number, name in enumerate(names, 1)}  # true: faulty
    for atom in model.vocabulary:
        variables[atom] = len(variables) + 1
    formula = WCNF()
    for rule in model.rules:
        clause = [variables[name] for name in rule.needs] + [-variables[atom] for atom in rule.body]
        formula.append(clause + ([variables[rule.head]] if rule.head is not None else []))
    for atom in positive:
        formula.append([variables[atom]])
    for atom in negative:
        formula.append([-variables[atom]])
    for name in names:
        formula.append([-variables[name]], weight=1)
    with LBX(formula, use_cld=False, solver_name="g3") as search:
        found: Sets = set()
        for correction in search.enumerate():
            found.add(frozenset(names[number - 1] for number in correction))
            search.block(correction)
    return found


@st.composite
def horn_models(draw: st.DrawFn) -> Model:
    """Models of any Horn form: several rules for an atom, rules without components, rules without a head."""
    system = System()
    names = [f"c{i}" for i in range(draw(st.integers(1, 6)))]
    count = draw(st.integers(1, 5))
    system.proposition(*(f"ok(t{i})" for i in range(count)))
    for name in names:
        if draw(st.booleans()):
            system.node(name)
        else:
            system.hardware(name, switchable=draw(st.booleans()))
    for _ in range(draw(st.integers(0, 14))):
        head = draw(st.integers(0, count))
        body = draw(st.lists(st.integers(0, max(head - 1, 0)), max_size=3)) if head else []
        needs = draw(st.lists(st.sampled_from(names), max_size=3))
        left = [*(f"NAB({name})" for name in needs), *(f"ok(t{i})" for i in body)]
        if left and head < count:
            system.clause(f"{', '.join(left)} -> ok(t{head})")
        elif left:
            system.clause(f"{', '.join(left)} -> false")
    return Model(system)


@st.composite
def dataflow_models(draw: st.DrawFn) -> Model:
    """Models as users declare them: devices, their drivers, nodes that make topics from topics, related values."""
    system = System()
    topics: list[str] = []
    publishers: list[str] = []
    devices = [f"h{i}" for i in range(draw(st.integers(0, 3)))]
    for device in devices:
        system.hardware(device, switchable=draw(st.booleans()))
    for i in range(draw(st.integers(1, 3))):
        on = draw(st.lists(st.sampled_from(devices), max_size=2, unique=True)) if devices else []
        system.driver(f"d{i}", on=on, out=[f"/d{i}"])
        topics.append(f"/d{i}")
        publishers.append(f"d{i}")
    for i in range(draw(st.integers(0, 5))):
        system.node(f"n{i}", out={f"/n{i}": draw(st.lists(st.sampled_from(topics), max_size=3))})
        topics.append(f"/n{i}")
        publishers.append(f"n{i}")
    if len(publishers) > 1 and draw(st.booleans()):
        one, other = draw(st.lists(st.sampled_from(publishers), min_size=2, max_size=2, unique=True))
        system.related((one, f"{one}.v"), (other, f"{other}.v"))
    if draw(st.booleans()):
        system.expect(
            "ok(memory)", of=[draw(st.sampled_from(publishers))], given=[f"ok({draw(st.sampled_from(topics))})"]
        )
    return Model(system)


@st.composite
def cases(draw: st.DrawFn) -> tuple[Model, frozenset[Literal], frozenset[Literal]]:
    """A model with any observations, not only such as could be made."""
    model = draw(st.one_of(horn_models(), dataflow_models()))
    signs = {atom: draw(st.sampled_from((None, None, None, True, False, False))) for atom in sorted(model.vocabulary)}
    positive = frozenset(
        atom for atom, sign in signs.items() if sign is True and atom.name not in ("inc", "dec", "const")
    )
    negative = frozenset(atom for atom, sign in signs.items() if sign is False)
    return model, positive, negative


def silent_chain(length: int, *, prefix: str = "") -> System:
    """A driver and nodes behind it, of which only the last topic may be observed."""
    system = System()
    system.driver(f"{prefix}n0", out=[f"/{prefix}0"])
    for i in range(1, length):
        system.node(f"{prefix}n{i}", out={f"/{prefix}{i}": [f"/{prefix}{i - 1}"]})
    return system
