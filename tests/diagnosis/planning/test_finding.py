"""Planning off the event loop: limits, cancellation, degraded goals, proofs, and the check of every plan."""

import asyncio
import threading
import time
from collections.abc import Callable

import pytest

from holdfast.diagnosis.planning import (
    Budget,
    ClingoPlanner,
    InvalidPlan,
    Outcome,
    Plan,
    Problem,
    Step,
    TimedOut,
    Unsolvable,
    find_plan,
    finding,
    read_domain,
    read_problem,
    relevance,
    repair_domain,
)
from holdfast.diagnosis.planning.language import PlanLiteral
from tests.diagnosis.planning.robot import power_up, robot, told

SWITCHES = """
(define (domain switches) (:requirements :adl :typing)
  (:types switch - object)
  (:predicates (up ?s - switch) (next ?a ?b - switch) (first ?s - switch))
  (:action flip_first :parameters (?s - switch) :precondition (and (first ?s) (not (up ?s))) :effect (up ?s))
  (:action hand_on :parameters (?a ?b - switch) :precondition (and (up ?a) (next ?a ?b))
    :effect (and (up ?b) (not (up ?a)))))
"""


def chain(length: int, goals: str) -> Problem:
    """One token that is handed on along a chain; a new one can be put in at its beginning."""
    names = " ".join(f"s{i}" for i in range(length))
    facts = " ".join(f"(next s{i} s{i + 1})" for i in range(length - 1))
    text = (
        f"(define (problem p) (:domain switches) (:objects {names} - switch)"
        f"(:init (first s0) {facts}) (:goal (and {goals})))"
    )
    return read_problem(read_domain(SWITCHES), text)


class Answers:
    """A planner that does what it is told, in its thread."""

    def __init__(self, work: Callable[[Problem, Budget], Outcome]) -> None:
        self.solve = work


async def test_stages_go_beyond_the_relaxed_bound_when_things_are_undone() -> None:
    # Both ends: the second token can only be put in once the first has been handed on.
    plan = await find_plan(ClingoPlanner(), chain(3, "(up s0) (up s1) (up s2)"))
    assert isinstance(plan, Plan)
    # Relaxed, three stages suffice (one token that is everywhere); five is the least there is.
    assert (len(plan.stages), len(plan.steps), plan.is_optimal) == (5, 6, True)


LOCKED = """
(define (domain locked) (:requirements :adl :typing)
  (:types lamp - object)
  (:predicates (lit ?l - lamp) (power))
  (:action light :parameters (?l - lamp) :precondition (power) :effect (and (lit ?l) (not (power)))))
"""


def lamps(*goals: str) -> Problem:
    """Power for one lamp only."""
    wanted = " ".join(f"(lit {goal})" for goal in goals)
    text = f"(define (problem p) (:domain locked) (:objects a b c - lamp) (:init (power)) (:goal (and {wanted})))"
    return read_problem(read_domain(LOCKED), text)


async def test_goals_that_exclude_each_other_are_proven_to() -> None:
    outcome = await find_plan(ClingoPlanner(), lamps("a", "b"))
    assert isinstance(outcome, Unsolvable)
    assert (outcome.is_each, set(outcome.goals)) == (False, {PlanLiteral(("lit", "a")), PlanLiteral(("lit", "b"))})


async def test_the_least_important_goals_are_given_up() -> None:
    # T57, T66
    outcome = await find_plan(ClingoPlanner(), lamps("b", "c", "a"), degrade=True)
    assert told(outcome) == [["light(b)"]]
    assert isinstance(outcome, Plan)
    assert outcome.unmet == (PlanLiteral(("lit", "c")), PlanLiteral(("lit", "a")))


async def test_what_cannot_be_told_in_time_is_no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    # T57: the proof is cut short, and then no number of stages is enough.
    monkeypatch.setattr(relevance, "MOST_STATES", 1)
    outcome = await find_plan(ClingoPlanner(longest=20), lamps("a", "b"))
    assert isinstance(outcome, TimedOut)


async def test_time_is_up_in_the_middle_of_the_search() -> None:
    # T58
    began = time.monotonic()
    outcome = await find_plan(ClingoPlanner(), chain(40, " ".join(f"(up s{i})" for i in range(40))), timeout=0.3)
    assert isinstance(outcome, TimedOut)
    assert time.monotonic() - began < 0.3 + finding.GRACE + 60


async def test_the_loop_goes_on_while_a_plan_is_made() -> None:
    # T58
    gate = threading.Event()

    def wait(problem: Problem, budget: Budget) -> Outcome:
        assert gate.wait(30)
        return ClingoPlanner().solve(problem, budget)

    work = asyncio.ensure_future(find_plan(Answers(wait), robot(["jn"]), timeout=30))
    await asyncio.sleep(0)  # It is in its thread now, which waits for the loop.
    gate.set()
    assert told(await work) == [["stop_node(jn)"], ["start_node(jn)"]]


async def test_a_cancelled_search_is_told_to_end() -> None:
    began, ended = threading.Event(), threading.Event()

    def search(problem: Problem, budget: Budget) -> Outcome:
        began.set()
        while budget.left:
            time.sleep(0.001)  # It is a thread that computes.
        ended.set()
        return TimedOut(budget.seconds)

    work = asyncio.ensure_future(find_plan(Answers(search), robot(["jn"]), timeout=60))
    assert await asyncio.to_thread(began.wait, 30)
    work.cancel()
    with pytest.raises(asyncio.CancelledError):
        await work
    assert await asyncio.to_thread(ended.wait, 30)


async def test_a_planner_that_ignores_its_time_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finding, "GRACE", 0.0)
    gate = threading.Event()

    def hang(problem: Problem, budget: Budget) -> Outcome:
        gate.wait(30)
        return Plan(())

    outcome = await find_plan(Answers(hang), robot([]), timeout=0.05)
    gate.set()
    assert isinstance(outcome, TimedOut)
    assert "does not keep" in outcome.why


@pytest.mark.parametrize(
    ("plan", "why"),
    [
        (Plan(((Step("start_node", ("jn",)),),)), "start_node(jn): on(ja) is not so"),
        (Plan(((Step("power_up", ("jn",)),),)), "power_up(jn): jn is no hardware"),
        (Plan(((Step("explode", ("jn",)),),)), "there is no action explode"),
        (Plan(((Step("power_up", ()),),)), "takes 1 objects"),
        (Plan(((Step("power_up", ("ja",)),),)), "it ends without good(hu)"),
        (Plan(((Step("power_up", ("ja",)), Step("power_up", ("ja",))),)), ""),
        (Plan(((Step("power_up", ("ja",)), Step("start_node", ("jn",))),)), "start_node(jn): on(ja) is not so"),
    ],
    ids=["order", "type", "action", "arguments", "goal", "twice", "stage"],
)
async def test_a_wrong_plan_is_not_handed_out(plan: Plan, why: str) -> None:
    # T59: to power up a node, or start one before its hardware, is what the paper's own domain allows.
    with pytest.raises(InvalidPlan) as raised:
        await find_plan(Answers(lambda problem, budget: plan), power_up())
    assert why in str(raised.value)


async def test_steps_in_each_others_way_are_no_stage() -> None:
    problem = lamps("a")
    both = Plan(((Step("light", ("a",)), Step("light", ("b",))),))
    with pytest.raises(InvalidPlan, match=r"changes power\(\) in the same stage"):
        await find_plan(Answers(lambda problem, budget: both), problem)


async def test_a_user_s_action_is_planned_with() -> None:
    reset = """
    (:predicates (port ?d - device))
    (:action reset_usb ; ioctl USBDEVFS_RESET
      :parameters (?d - device) :precondition (and (bad ?d) (port ?d)) :effect (and (good ?d) (not (bad ?d))))
    """
    domain = repair_domain(reset)
    problem = robot(["imu", "js"], domain=domain)
    problem = Problem(domain, problem.objects, problem.init | {("port", "imu")}, problem.goals)
    plan = await find_plan(ClingoPlanner(), problem, degrade=True)
    assert told(plan) == [["reset_usb(imu)"]]
    assert isinstance(plan, Plan)
    assert plan.unmet == (PlanLiteral(("good", "js")),)


async def test_the_cheaper_way_is_taken() -> None:
    # T54: cheapest first, where the costs are said.
    reload = """
    (:action reload :parameters (?n - node) :precondition (and (bad ?n) (running ?n))
      :effect (and (good ?n) (not (bad ?n)) (increase (total-cost) {cost})))
    (:action replace :parameters (?n - node) :precondition (and (bad ?n) (running ?n))
      :effect (and (good ?n) (not (bad ?n)) (increase (total-cost) 5)))
    """
    for cost, action in ((4, "reload"), (6, "replace")):
        plan = await find_plan(ClingoPlanner(), robot(["jn"], domain=repair_domain(reload.format(cost=cost))))
        assert told(plan) == [[f"{action}(jn)"]]


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_virtual_time_stands_still_while_a_plan_is_made() -> None:
    loop = asyncio.get_running_loop()
    began = loop.time()
    assert isinstance(await find_plan(ClingoPlanner(), power_up(), timeout=60), Plan)
    assert loop.time() == began


DOORS = """
(define (domain doors) (:requirements :adl :typing)
  (:types thing - object)
  (:predicates (power) (lit ?t - thing) (armed) (safe) (done) (gone))
  (:action light :parameters (?t - thing) :precondition (power) :effect (and (lit ?t) (not (power))))
  (:action recharge :parameters () :precondition (not (power)) :effect (power))
  (:action use :parameters () :precondition (power) :effect (done))
  (:action cut :parameters () :precondition (and) :effect (not (power)))
  (:action disarm :parameters () :precondition (armed) :effect (not (armed)))
  (:action go :parameters () :precondition (and) :effect (and (gone) (when (armed) (not (safe))))))
"""


@pytest.mark.parametrize(
    ("init", "goal", "stages"),
    [
        ("(power)", "(and (lit a) (lit b))", [{"light(a)", "light(b)"}, {"recharge()"}, {"light(a)", "light(b)"}]),
        ("(safe) (armed)", "(and (gone) (safe))", [{"disarm()"}, {"go()"}]),
        ("(power) (safe) (armed)", "(and (done) (safe) (not (power)))", [{"use()"}, {"cut()"}]),
    ],
    ids=[
        "what is used up is brought back",
        "what would do harm is prevented",
        "what is needed is not taken away first",
    ],
)
async def test_what_an_action_takes_away_is_reckoned_with(init: str, goal: str, stages: list[set[str]]) -> None:
    text = f"(define (problem p) (:domain doors) (:objects a b - thing) (:init {init}) (:goal {goal}))"
    plan = await find_plan(ClingoPlanner(), read_problem(read_domain(DOORS), text))
    made = told(plan)
    assert [len(stage) for stage in made] == [1] * len(stages)
    assert all(set(stage) <= allowed for stage, allowed in zip(made, stages, strict=True))


async def test_who_makes_so_what_was_so_already_keeps_nobody_waiting() -> None:
    domain = read_domain("""
        (define (domain d) (:requirements :adl) (:predicates (p) (q) (r) (done))
          (:action a :parameters () :precondition (and) :effect (and (p) (r)))
          (:action b :parameters () :precondition (p) :effect (q))
          (:action c :parameters () :precondition (and (q) (r)) :effect (done)))
    """)
    plan = await find_plan(
        ClingoPlanner(), read_problem(domain, "(define (problem x) (:domain d) (:init (p)) (:goal (done)))")
    )
    assert isinstance(plan, Plan)
    assert [[step.action for step in stage] for stage in plan.stages] == [["a", "b"], ["c"]]
