"""The circuit c17 of ISCAS-85 as a model: its minimal diagnoses for every input and output are those of brute force.

A model has no circles, and in a circuit one concludes from inputs to outputs and back. So each line has its values once
in each layer, and the layers take turns: what a gate that works says of its output, and then of its inputs. Three
layers are enough for c17: then two outputs that would have to agree on what a faulty gate says are found out, too.
"""

import itertools
from collections.abc import Iterator, Mapping

import pytest

from holdfast.diagnosis.engine import Diagnoser
from holdfast.diagnosis.literals import Literal
from holdfast.diagnosis.model import Model, System
from tests.diagnosis.oracle import is_consistent

INPUTS = ("1", "2", "3", "6", "7")
OUTPUTS = ("22", "23")
C17 = {
    "10": ("1", "3"),
    "11": ("3", "6"),
    "16": ("2", "11"),
    "19": ("11", "7"),
    "22": ("10", "16"),
    "23": ("16", "19"),
}
"""Gate to its two inputs; all of them are NAND."""
LAYERS = 3
"""From inputs to outputs, back, and once more."""
CASES = list(itertools.product((False, True), repeat=len(INPUTS) + len(OUTPUTS)))


def circuit() -> Model:
    """Each gate is a component, and each line may be high or low, as is concluded in each of some layers."""
    system = System()
    for layer in range(LAYERS + 1):
        for line in (*INPUTS, *C17):
            system.proposition(f"high{layer}(w{line})", f"low{layer}(w{line})")
            if layer:
                system.clause(f"high{layer - 1}(w{line}) -> high{layer}(w{line})")
                system.clause(f"low{layer - 1}(w{line}) -> low{layer}(w{line})")
            system.clause(f"high{layer}(w{line}), low{layer}(w{line}) -> false")
    for gate, (one, other) in C17.items():
        system.node(f"g{gate}")
        for layer in range(1, LAYERS + 1):
            works, high, low = f"NAB(g{gate})", f"high{layer}", f"low{layer}"
            if layer % 2:  # From inputs to outputs.
                system.clause(f"{works}, {high}(w{one}), {high}(w{other}) -> {low}(w{gate})")
                system.clause(f"{works}, {low}(w{one}) -> {high}(w{gate})")
                system.clause(f"{works}, {low}(w{other}) -> {high}(w{gate})")
                continue
            system.clause(f"{works}, {low}(w{gate}) -> {high}(w{one})")
            system.clause(f"{works}, {low}(w{gate}) -> {high}(w{other})")
            system.clause(f"{works}, {high}(w{gate}), high{layer - 1}(w{one}) -> {low}(w{other})")
            system.clause(f"{works}, {high}(w{gate}), high{layer - 1}(w{other}) -> {low}(w{one})")
    return Model(system)


def observed(values: tuple[bool, ...]) -> list[Literal]:
    lines = (*INPUTS, *OUTPUTS)
    return [Literal("high0" if value else "low0", (f"w{line}",)) for line, value in zip(lines, values, strict=True)]


def faulty_sets() -> Iterator[frozenset[str]]:
    for size in range(len(C17) + 1):
        yield from map(frozenset, itertools.combinations((f"g{gate}" for gate in C17), size))


def fits(values: Mapping[str, bool], faulty: frozenset[str]) -> bool:
    """Whether there is anything that the faulty gates may say, so that inputs and outputs are as observed."""
    for said in itertools.product((False, True), repeat=len(faulty)):
        wires, free = dict(values), iter(said)
        for gate, (one, other) in C17.items():
            made = next(free) if f"g{gate}" in faulty else not (wires[one] and wires[other])
            if wires.setdefault(gate, made) != made:
                break
        else:
            return True
    return False


def minimal(sets: list[frozenset[str]]) -> set[frozenset[str]]:
    return {one for one in sets if not any(other < one for other in sets)}


@pytest.fixture(scope="module")
def engine() -> Diagnoser:
    return Diagnoser(circuit())


def found(engine: Diagnoser, values: tuple[bool, ...]) -> set[frozenset[str]]:
    diagnosis = engine.diagnose_now(observed(values))
    return {frozenset(one.bad) for one in diagnosis.candidates} or {frozenset()}


def test_the_minimal_diagnoses_of_c17_are_those_of_its_clauses(engine: Diagnoser) -> None:
    for values in CASES:
        positive = observed(values)
        consistent = [one for one in faulty_sets() if is_consistent(engine.model, positive, (), one)]
        assert found(engine, values) == minimal(consistent), values


def test_they_are_just_those_with_which_the_gates_could_have_said_what_is_observed(engine: Diagnoser) -> None:
    for values in CASES:
        wires: dict[str, bool] = dict(zip((*INPUTS, *OUTPUTS), values, strict=True))
        assert found(engine, values) == minimal([one for one in faulty_sets() if fits(wires, one)]), values
