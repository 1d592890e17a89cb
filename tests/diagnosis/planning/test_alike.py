"""Parts that are alike are planned for once, and the plan is as good as without that."""

import random

import pytest

from holdfast.diagnosis.planning import Budget, ClingoPlanner, Plan, Problem, check_plan, repair_domain, repair_problem
from holdfast.diagnosis.planning import stable as planner_module
from holdfast.diagnosis.planning.alike import one_of_each
from holdfast.diagnosis.planning.grounding import Grounder
from holdfast.diagnosis.planning.relevance import Task, task_of

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


@pytest.mark.parametrize("seed", range(25))
def test_the_plan_is_as_short_and_as_cheap_as_without(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = damaged(seed)
    outcome = ClingoPlanner().solve(problem, Budget(60))

    def as_it_is(task: Task) -> tuple[Task, object]:
        return task, {one.action: [one.action] for one in task.useful}

    monkeypatch.setattr(planner_module, "one_of_each", as_it_is)
    plain = ClingoPlanner().solve(problem, Budget(60))
    assert type(outcome) is type(plain)
    if isinstance(outcome, Plan) and isinstance(plain, Plan):
        check_plan(problem, outcome)
        assert (len(outcome.stages), outcome.cost, outcome.is_optimal) == (len(plain.stages), plain.cost, True)


def test_of_many_that_failed_alike_one_is_left() -> None:
    hardware, nodes = [f"h{i}" for i in range(40)], [f"n{i}" for i in range(80)]
    problem = repair_problem(
        repair_domain(),
        hardware=hardware,
        nodes=nodes,
        drives={node: [device] for node, device in zip(nodes, hardware, strict=False)},
        bad=[*hardware, *nodes],
        running=nodes[:60],
    )
    task = task_of(problem, Grounder().ground(problem, Budget(60)), Budget(60))
    small, twins = one_of_each(task)
    # A device with a hung driver (power up, stop, start), a hung node (stop, start), and one that is down (start).
    assert len(small.useful) == 3 + 2 + 1
    assert sum(map(len, twins.values())) == len(task.useful)
