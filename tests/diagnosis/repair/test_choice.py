"""Which diagnosis is acted upon (T54)."""

from holdfast.diagnosis.engine import Candidate, Diagnosis, State
from holdfast.diagnosis.literals import Literal, ok
from holdfast.diagnosis.observations import Observed
from holdfast.diagnosis.repair.choice import choose, remaining

TWO = Diagnosis(State.FAULTY, ("a", "b", "c"), (Candidate(("a",)), Candidate(("b",))), (~ok("/x"),))


def chosen(diagnosis: Diagnosis = TWO, *, alone=(), given_up=(), hopeless=(), tried=None, tries=None):
    found = choose(diagnosis, alone=alone, given_up=given_up, hopeless=hopeless, tried=tried or {}, tries=tries or {})
    return found and found.bad


def test_the_first_by_rank_comes_first() -> None:
    assert chosen() == ("a",)


def test_what_was_tried_least_comes_first() -> None:
    # O3
    assert chosen(tried={("a",): 1}) == ("b",)
    assert chosen(tried={("a",): 1, ("b",): 1}) == ("a",)
    assert chosen(tries={"a": 1}) == ("b",)


def test_what_has_not_helped_is_likelier_than_that_more_are_faulty() -> None:
    # Three sensors of which one differs from both others in each life: nobody restarts the two that agree.
    odd = Diagnosis(State.FAULTY, ("a", "b", "c"), (Candidate(("a",)), Candidate(("b", "c"))), (~ok("/x"),))
    assert chosen(odd, tried={("a",): 1}) == ("a",)
    assert chosen(odd, tried={("a",): 1}, hopeless=[("a",)]) is None
    assert chosen(odd, hopeless=[("a",)]) == ("b", "c")  # Nothing was tried: nothing speaks for it.


def test_who_is_to_be_left_alone_is_not_chosen() -> None:
    # T64
    assert chosen(alone=["a"]) == ("b",)
    assert chosen(alone=["a", "b"]) is None
    assert chosen(hopeless=[("a",)]) == ("b",)


def test_what_a_component_that_was_given_up_explains_needs_no_other_explanation() -> None:
    # Else one healthy component after the other would be restarted because of a device that is dead for good.
    assert chosen(alone=["b"], given_up=["b"]) is None


def test_a_new_fault_beside_a_component_that_was_given_up_is_repaired() -> None:
    both = Diagnosis(State.FAULTY, ("a", "b", "c"), (Candidate(("b", "c")),))
    assert chosen(both, alone=["b"], given_up=["b"]) == ("b", "c")


def test_without_a_fault_nothing_is_chosen() -> None:
    # T49, T50
    for state in (State.HEALTHY, State.BLIND, State.CONTRADICTORY):
        assert chosen(Diagnosis(state, ("a",), (Candidate(("a",)),))) is None


def test_a_symptom_has_gone_when_that_is_seen() -> None:
    # T50: that nobody says anything of it any more is no cure.
    rising = Literal("inc", ("load",))
    symptoms = (~ok("/x"), rising)
    assert remaining(symptoms, Observed.of([~ok("/x"), rising])) == symptoms
    assert remaining(symptoms, Observed.of([ok("/x")])) == ()
    assert remaining(symptoms, Observed.of([ok("/y")])) == (~ok("/x"),)
