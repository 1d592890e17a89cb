"""Two circuits of gates as models, c17 of ISCAS-85 and the comparator 74L85, and the minimal diagnoses of their faults.

They are compared with those of the clauses themselves, by brute force and by another engine, and with a simulation of
what the gates of each set could have said.
"""

import itertools
import random
from collections.abc import Iterator

import pytest

from holdfast.diagnosis.engine import Diagnoser
from tests.diagnosis.circuits import C17, COMPARATOR, Circuit
from tests.diagnosis.oracle import Sets, correction_sets, is_consistent

SEED = 85
PAIRS = 30
"""Pairs of stuck gates of the comparator that are drawn."""


@pytest.fixture(scope="module")
def c17() -> Diagnoser:
    return Diagnoser(C17.model())


@pytest.fixture(scope="module")
def comparator() -> Diagnoser:
    return Diagnoser(COMPARATOR.model(), limit=10_000, seconds=60.0)


def found(engine: Diagnoser, circuit: Circuit, case: tuple[int, int]) -> Sets:
    diagnosis = engine.diagnose_now(circuit.observed(case))
    assert diagnosis.is_complete
    return {frozenset(one.bad) for one in diagnosis.candidates} or {frozenset()}


def minimal(sets: list[frozenset[str]]) -> Sets:
    return {one for one in sets if not any(other < one for other in sets)}


def test_the_minimal_diagnoses_of_c17_are_those_of_its_clauses(c17: Diagnoser) -> None:
    gates = [f"g{gate}" for gate in C17.gates]
    every = [frozenset(some) for size in range(len(gates) + 1) for some in itertools.combinations(gates, size)]
    for case in itertools.product(range(32), range(4)):
        positive = C17.observed(case)
        consistent = [one for one in every if is_consistent(c17.model, positive, (), one)]
        assert found(c17, C17, case) == minimal(consistent), case


def test_they_are_just_those_with_which_the_gates_could_have_said_what_is_observed(c17: Diagnoser) -> None:
    explained = C17.diagnoses(len(C17.gates))
    assert len(explained) == 2**7
    for case, sets in explained.items():
        assert found(c17, C17, case) == sets, case


def test_the_comparator_compares() -> None:
    """All 2,048 inputs: bits 0 to 3 are A, 4 to 7 are B, and then come less, equal and greater of the digits below."""
    assert (len(COMPARATOR.gates), len(COMPARATOR.inputs), len(COMPARATOR.outputs)) == (33, 11, 3)
    said = COMPARATOR.said({})
    for number in range(2**11):
        a, b, (less, equal, greater) = number & 15, number >> 4 & 15, (number >> bit & 1 for bit in (8, 9, 10))
        expected = (a < b or (a == b and less), a == b and equal, a > b or (a == b and greater))
        assert [line >> number & 1 for line in said] == list(map(int, expected)), number


def stuck_gates(rng: random.Random) -> Iterator[dict[str, bool]]:
    """Each gate stuck low and stuck high, and pairs of gates."""
    yield from ({gate: is_high} for gate in COMPARATOR.gates for is_high in (False, True))
    for pair in rng.sample([*itertools.combinations(COMPARATOR.gates, 2)], PAIRS):
        yield {gate: rng.random() < 0.5 for gate in pair}


def test_stuck_gates_of_the_comparator_are_diagnosed(comparator: Diagnoser) -> None:
    rng = random.Random(SEED)
    print(f"seed {SEED}")
    explained = COMPARATOR.diagnoses(2)
    for stuck in stuck_gates(rng):
        shown = COMPARATOR.cases(stuck)
        if not shown:
            assert len(stuck) == 2  # Each fault of one gate shows at some input; two may hide each other.
            continue
        case = rng.choice(shown)
        sets = found(comparator, COMPARATOR, case)
        assert sets == correction_sets(comparator.model, COMPARATOR.observed(case), ()), (stuck, case)
        assert any(one <= {f"g{gate}" for gate in stuck} for one in sets), (stuck, case)
        single = {one for one in sets if len(one) == 1}
        assert single == {one for one in explained[case] if len(one) == 1}, (stuck, case)
        for pair in explained[case]:
            assert any(one <= pair for one in sets), (stuck, case, pair)


def test_a_comparator_that_compares_is_healthy(comparator: Diagnoser) -> None:
    said = COMPARATOR.said({})
    for number in random.Random(SEED).sample(range(2**11), 100):
        outputs = sum((line >> number & 1) << bit for bit, line in enumerate(said))
        assert found(comparator, COMPARATOR, (number, outputs)) == {frozenset()}
