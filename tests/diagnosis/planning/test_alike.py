"""Parts that are alike are planned for once, and the plan is as good as without that."""

import dataclasses
import random
from collections.abc import Iterable, Sequence

import pytest

from holdfast.diagnosis.planning import (
    Budget,
    ClingoPlanner,
    Domain,
    Plan,
    Problem,
    Unsolvable,
    check_plan,
    repair_domain,
    repair_problem,
)
from holdfast.diagnosis.planning import stable as planner_module
from holdfast.diagnosis.planning.alike import OneOfEach
from holdfast.diagnosis.planning.grounding import GroundAction, Grounder
from holdfast.diagnosis.planning.language import PlanLiteral

DEARER = (
    (
        "(:action replace :parameters (?h - hardware) :precondition (bad ?h)"
        " :effect (and (on ?h) (good ?h) (not (bad ?h)) (increase (total-cost) 7)))"
    ),
    (
        "(:action mend :parameters (?n - node) :precondition (bad ?n)"
        " :effect (and (running ?n) (good ?n) (not (bad ?n)) (increase (total-cost) 2)))"
    ),
)


def damaged(seed: int) -> Problem:
    """Devices with no, one or two drivers each, in all states of being bad, on and running."""
    chance = random.Random(seed)
    hardware = [f"h{i}" for i in range(6)]
    nodes = [f"n{i}" for i in range(9)]
    return repair_problem(
        repair_domain(*chance.sample(DEARER, chance.randint(0, 2))),
        hardware=hardware,
        nodes=nodes,
        drives={node: chance.sample(hardware, chance.randint(1, 2)) for node in nodes if chance.random() < 0.7},
        bad=[name for name in (*hardware, *nodes) if chance.random() < 0.6],
        on=[name for name in hardware if chance.random() < 0.5],
        running=[name for name in nodes if chance.random() < 0.5],
        restart_drivers=chance.random() < 0.5,
    )


class AsItIs(OneOfEach):
    """All parts, and nobody has twins."""

    def __init__(self, problem: Problem, actions: Sequence[GroundAction]) -> None:
        self.actions, self.goals = tuple(actions), problem.goals

    def twins(self, action: GroundAction) -> list[GroundAction]:
        return [action]

    def same(self, goals: Iterable[PlanLiteral]) -> tuple[PlanLiteral, ...]:
        return tuple(goals)


@pytest.mark.parametrize("seed", range(25))
def test_the_plan_is_as_short_and_as_cheap_as_without(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = damaged(seed)
    outcome = ClingoPlanner().solve(problem, Budget(60))
    monkeypatch.setattr(planner_module, "OneOfEach", AsItIs)
    plain = ClingoPlanner().solve(problem, Budget(60))
    assert type(outcome) is type(plain)
    if isinstance(outcome, Plan) and isinstance(plain, Plan):
        check_plan(problem, outcome)
        assert (len(outcome.stages), outcome.cost, outcome.is_optimal) == (len(plain.stages), plain.cost, True)
    elif isinstance(outcome, Unsolvable) and isinstance(plain, Unsolvable):
        assert set(outcome.goals) == set(plain.goals)


def alike(count: int, repertoire: Domain) -> Problem:
    """Devices with a hung driver each, as many hung nodes, as many that are down."""
    hardware, nodes = [f"h{i}" for i in range(count)], [f"n{i}" for i in range(3 * count)]
    return repair_problem(
        repertoire,
        hardware=hardware,
        nodes=nodes,
        drives={node: [device] for node, device in zip(nodes, hardware, strict=False)},
        bad=[*hardware, *nodes],
        running=nodes[: 2 * count],
    )


def test_of_many_that_failed_alike_one_is_left() -> None:
    def left(count: int) -> int:
        problem = alike(count, repair_domain())
        return len(OneOfEach(problem, Grounder().ground(problem, Budget(60))).actions)

    assert left(2) == left(40)


def test_all_that_are_beyond_repair_alike_are_told_at_once() -> None:
    problem = alike(20, dataclasses.replace(repair_domain(), actions=repair_domain().actions[1:]))  # no power_up
    outcome = ClingoPlanner().solve(problem, Budget(60))
    assert isinstance(outcome, Unsolvable)
    assert {goal.atom[1] for goal in outcome.goals} == {*(f"h{i}" for i in range(20)), *(f"n{i}" for i in range(20))}
