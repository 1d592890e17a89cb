"""On random models every set that is returned is consistent and minimal, and none is missing (D27)."""

from hypothesis import assume, given, settings
from hypothesis import strategies as st

from holdfast.diagnosis.engine import Diagnoser
from holdfast.diagnosis.literals import Literal
from holdfast.diagnosis.model import Model, System
from holdfast.diagnosis.observations import Observed
from tests.diagnosis.oracle import cases, correction_sets, hitting_set_graph, is_consistent

Case = tuple[Model, frozenset[Literal], frozenset[Literal]]


def found_by_engine(case: Case, diagnoser: Diagnoser | None = None) -> set[frozenset[str]] | None:
    model, positive, negative = case
    said = (diagnoser or Diagnoser(model, seconds=60.0)).diagnose_now(Observed(positive, negative))
    if said.contradictions:
        return None
    assert said.is_complete
    sets = [frozenset(candidate.bad) for candidate in said.candidates]
    assert len(sets) == len(set(sets)) == said.found
    return set(sets)


@given(cases())
@settings(max_examples=400)
def test_the_engine_agrees_with_a_hitting_set_graph(case: Case) -> None:
    model, positive, negative = case
    assume(positive or negative)
    assert found_by_engine(case) == hitting_set_graph(model, positive, negative)


@given(cases())
@settings(max_examples=400)
def test_the_engine_agrees_with_correction_sets_of_python_sat(case: Case) -> None:
    model, positive, negative = case
    assume(positive or negative)
    assume(is_consistent(model, positive, negative, model.components))
    assert found_by_engine(case) == correction_sets(model, positive, negative)


@given(cases())
@settings(max_examples=200)
def test_each_set_is_consistent_and_no_member_can_be_left_out(case: Case) -> None:
    model, positive, negative = case
    assume(positive or negative)
    for bad in found_by_engine(case) or ():
        assert is_consistent(model, positive, negative, bad)
        assert not any(is_consistent(model, positive, negative, bad - {name}) for name in bad)


@given(cases(), st.data())
@settings(max_examples=100)
def test_what_is_remembered_between_calls_changes_no_answer(case: Case, data: st.DataObject) -> None:
    model, positive, negative = case
    kept = Diagnoser(model, seconds=60.0)
    for _ in range(4):
        assume(positive or negative)
        assert found_by_engine((model, positive, negative), kept) == found_by_engine((model, positive, negative))
        atom = data.draw(st.sampled_from(sorted(model.vocabulary)))
        sign = data.draw(st.sampled_from((None, False)))
        positive, negative = positive - {atom}, (negative | {atom}) if sign is False else negative - {atom}


@given(cases())
@settings(max_examples=200)
def test_contradictory_observations_are_named_without_one_too_many(case: Case) -> None:
    model, positive, negative = case
    said = Diagnoser(model).diagnose_now(Observed(positive, negative))
    if not said.contradictions:
        return
    torn, *_ = said.contradictions
    literals = set(torn.literals)
    assert literals <= positive | {~atom for atom in negative}
    for left_out in [None, *literals]:
        kept = literals - {left_out}
        yes = {literal for literal in kept if literal.positive}
        no = {literal.atom for literal in kept if not literal.positive}
        assert is_consistent(model, yes, no, model.components) == (left_out is not None)


def layered() -> Case:
    """Two sources of one topic, each able to keep it up: conflicts that share members, by more than one rule."""
    system = System()
    system.proposition("ok(a)", "ok(b)", "ok(c)")
    for name in ("p", "q", "r", "s"):
        system.node(name)
    for clause in ("NAB(p) -> ok(a)", "NAB(q) -> ok(a)", "NAB(r), ok(a) -> ok(b)", "NAB(s), ok(b) -> ok(c)"):
        system.clause(clause)
    model = Model(system)
    return model, frozenset(), frozenset({model.vocabulary.parse("ok(c)")})


def test_a_topic_with_two_sources_needs_both_to_fail() -> None:
    assert found_by_engine(layered()) == {frozenset({"s"}), frozenset({"r"}), frozenset({"p", "q"})}


@given(cases())
@settings(max_examples=200)
def test_a_contradiction_costs_only_the_atoms_concerned(case: Case) -> None:
    model, positive, negative = case
    said = Diagnoser(model, seconds=60.0).diagnose_now(Observed(positive, negative))
    contested = {literal.atom for torn in said.contradictions for literal in torn.literals}
    rest = positive - contested, negative - contested
    if not (rest[0] or rest[1]):
        return
    found = found_by_engine((model, *rest))
    assert found is not None
    assert all(set(said.convicted) <= one for one in found)
    for candidate in said.candidates:
        assert any(set(candidate.bad) <= one for one in found)
    if not said.contradictions:
        assert said.truncated == ()
        assert {frozenset(one.bad) for one in said.candidates} == found
