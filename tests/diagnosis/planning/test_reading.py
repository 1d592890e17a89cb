"""PDDL text: what is wrong with it is said, and where."""

import contextlib
import sys

import pytest

from holdfast.diagnosis.planning import (
    Budget,
    ClingoPlanner,
    PlanningError,
    Problem,
    grounding,
    read_domain,
    read_problem,
    repair_domain,
    repair_problem,
)
from holdfast.diagnosis.planning.language import PlanLiteral
from holdfast.diagnosis.planning.repair import repair_text
from tests.diagnosis.planning.robot import robot, told


@pytest.mark.parametrize(
    ("action", "why"),
    [
        ("(:action a :parameters (?c - component) :precondition (bad ?x) :effect (good ?c))", "?x is no parameter"),
        ("(:action a :parameters (?c - component) :precondition (bda ?c) :effect (good ?c))", "no predicate bda"),
        (
            "(:action a :parameters (?c - component) :precondition (bad ?c) :effect (good ?c ?c))",
            "good takes 1 arguments, not 2",
        ),
        (
            "(:action a :parameters (?n - node) :precondition (bad ?n) :effect (on ?n))",
            "?n in on is a node, no hardware",
        ),
        ("(:action a :parameters (?n - nodee) :precondition (bad ?n) :effect (good ?n))", "nodee"),
        ("(:action a :parameters (?n - node) :precondition (bad ?n) :effect (good nobody))", "nobody"),
        ("(:action power_up :parameters (?h - hardware) :effect (on ?h))", "there is an action power_up already"),
        ("(:action a :parameters (?n - node) :effect (good ?n)", "parentheses"),
        ("(:goal (good x))", "not ':goal'"),
        ("(:action a :parameters (?n - node) :effect (good ?n))", "needs :parameters, :precondition and :effect"),
    ],
)
def test_a_wrong_action_is_refused(action: str, why: str) -> None:
    with pytest.raises(PlanningError) as raised:
        repair_domain(action)
    assert why in str(raised.value)


@pytest.mark.parametrize(
    "text", ["", "(", "()", "(define)", repair_text() + ")", "(" * 5000, "\ud800", "(define (domain d"]
)
def test_what_is_no_pddl_is_refused(text: str) -> None:
    with pytest.raises(PlanningError):
        read_domain(text)


def test_a_problem_is_read() -> None:
    text = """
    (define (problem p) (:domain repair)
      (:objects JA - hardware Jn - node)
      (:init (bad JA) (bad Jn) (drives Jn JA))
      (:goal (and (good JA) (running Jn) (not (bad Jn)))))
    """
    problem = read_problem(repair_domain(), text)
    assert problem.goals == (
        PlanLiteral(("good", "JA")),
        PlanLiteral(("running", "Jn")),
        PlanLiteral(("bad", "Jn"), False),
    )
    assert told(ClingoPlanner().solve(problem, Budget(60))) == [["power_up(JA)"], ["start_node(Jn)"]]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("(:domain repair)", "(:domain other)"), "it is of the domain other"),
        (("(bad ja)", "(bad jb)"), "jb"),
        (("(:goal (good ja))", "(:requirements :adl) (:goal (or (good ja) (bad ja)))"), ""),
        (("(bad ja)", "(running ja)"), "ja is no node"),
        (("- hardware", "- thing"), "thing"),
    ],
)
def test_a_wrong_problem_is_refused(change: tuple[str, str], why: str) -> None:
    text = "(define (problem p) (:domain repair) (:objects ja - hardware) (:init (bad ja)) (:goal (good ja)))"
    with pytest.raises(PlanningError) as raised:
        read_problem(repair_domain(), text.replace(*change))
    assert why in str(raised.value)


def test_a_component_that_nobody_knows_is_refused() -> None:
    # T53
    with pytest.raises(PlanningError, match="bad: there is no such component: jaguar"):
        robot(["jaguar"])
    with pytest.raises(PlanningError, match="it is hardware and node"):
        repair_problem(repair_domain(), hardware=["x"], nodes=["x"], bad=[])


def test_names_may_be_anything() -> None:
    problem = repair_problem(repair_domain(), nodes=["/t/a b", "(ö)"], bad=["/t/a b", "(ö)"])
    assert told(ClingoPlanner().solve(problem, Budget(60))) == [["start_node((ö))", "start_node(/t/a b)"]]


def test_only_the_state_is_new_in_the_next_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    # T58: the grounding of a domain is kept.
    planner = ClingoPlanner()
    planner.solve(robot(["ja"]), Budget(60))

    def never(*args: object) -> None:
        raise AssertionError("it was grounded again")

    monkeypatch.setattr(grounding, "ground", never)
    assert told(planner.solve(robot(["jn"]), Budget(60))) == [["stop_node(jn)"], ["start_node(jn)"]]
    with pytest.raises(AssertionError):
        planner.solve(repair_problem(repair_domain(), nodes=["other"], bad=["other"]), Budget(60))


def test_too_many_ways_to_do_things_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grounding, "MOST_ACTIONS", 100)
    swap = "(:action swap :parameters (?a ?b ?c - node) :precondition (bad ?a) :effect (and (good ?a) (bad ?b)))"
    problem = repair_problem(repair_domain(swap), nodes=[f"n{i}" for i in range(10)], bad=["n0"])
    with pytest.raises(PlanningError, match="more than 100"):
        ClingoPlanner().solve(problem, Budget(60))


def test_a_quantifier_over_what_is_static_looks_only_at_what_it_says() -> None:
    # All hardware that drives a node, and none else: a node without any can start at once.
    problem = robot(["jn", "hm"], on=(), running=())
    problem = Problem(problem.domain, problem.objects, problem.init, (PlanLiteral(("running", "hm")),))
    assert told(ClingoPlanner().solve(problem, Budget(60))) == [["start_node(hm)"]]


def test_costs_forall_when_exists_and_equality_are_understood() -> None:
    cascade = """
    (:constants mains - hardware)
    (:action power_all :parameters ()
      :precondition (and (not (on mains)) (exists (?h - hardware) (and (bad ?h) (not (= ?h mains)))))
      :effect (and (on mains) (increase (total-cost) 2)
        (forall (?h - hardware) (when (and (bad ?h) (not (= ?h mains))) (and (on ?h) (good ?h) (not (bad ?h)))))))
    """
    problem = robot(["ja", "hu", "la"], on=(), domain=repair_domain(cascade))
    problem = Problem(problem.domain, problem.objects, problem.init | {("good", "mains")}, problem.goals)
    outcome = ClingoPlanner().solve(problem, Budget(60))
    assert told(outcome) == [["power_all()"]]


@pytest.mark.parametrize("limit", [None, 7])
@pytest.mark.parametrize("text", ["(define (domain d) (:predicates (on ?x)))", "(define (domain d"])
def test_reading_leaves_the_tracebacks_of_others_alone(
    monkeypatch: pytest.MonkeyPatch, text: str, limit: int | None
) -> None:
    """The library sets `sys.tracebacklimit` to 0 while it parses, and leaves it so after an error."""
    monkeypatch.delattr(sys, "tracebacklimit", raising=False)
    if limit is not None:
        monkeypatch.setattr(sys, "tracebacklimit", limit, raising=False)
    with contextlib.suppress(PlanningError):
        read_domain(f"; {limit}\n{text}")  # Not one that was read before.
    assert getattr(sys, "tracebacklimit", None) == limit
