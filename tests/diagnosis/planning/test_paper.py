"""The paper's two scenarios, with every planner there is; and the loop that its first diagnosis may end in."""

import importlib.util

import pytest

from holdfast.diagnosis.planning import ClingoPlanner, Plan, Planner, PlanningError, Unsolvable, check_plan, find_plan
from holdfast.diagnosis.planning.language import PlanLiteral
from holdfast.diagnosis.planning.unified import UnifiedPlanner
from tests.diagnosis.planning.robot import HARDWARE, power_up, robot, told

# unified-planning calls functions of pyparsing by their old names.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

HAS_DOWNWARD = importlib.util.find_spec("up_fast_downward") is not None


@pytest.fixture(params=["clingo", "fast-downward"])
def planner(request: pytest.FixtureRequest) -> Planner:
    if request.param == "clingo":
        return ClingoPlanner()
    if not HAS_DOWNWARD:
        pytest.skip("the extra `planners` is not installed (unified-planning, up-fast-downward)")
    return UnifiedPlanner()


async def test_power_up_is_all_hardware_then_all_nodes(planner: Planner) -> None:
    # O6, D47: eleven steps; those of a stage at the same time.
    plan = await find_plan(planner, power_up(), timeout=60)
    assert told(plan) == [
        ["power_up(hu)", "power_up(ja)", "power_up(la)"],
        [f"start_node({node})" for node in sorted(["jn", "hn", "lan", "in", "jyn", "jtn", "hm", "lac"])],
    ]
    assert isinstance(plan, Plan)
    assert (plan.cost, len(plan.steps), plan.unmet) == (11, 11, ())


async def test_shut_down_takes_two_calls_as_in_the_paper(planner: Planner) -> None:
    # D54: the base is off; then its driver still runs and has no connection.
    first = await find_plan(planner, robot(["ja"], on=("hu", "la")), timeout=60)
    second = await find_plan(planner, robot(["jn"]), timeout=60)
    assert [told(first), told(second)] == [[["power_up(ja)"]], [["stop_node(jn)"], ["start_node(jn)"]]]


async def test_shut_down_in_one_call(planner: Planner) -> None:
    plan = await find_plan(planner, robot(["ja"], on=("hu", "la"), restart_drivers=True), timeout=60)
    assert told(plan) == [["power_up(ja)", "stop_node(jn)"], ["start_node(jn)"]]


async def test_hardware_that_is_on_and_bad_is_power_cycled(planner: Planner) -> None:
    assert told(await find_plan(planner, robot(["ja"]), timeout=60)) == [["shutdown(ja)"], ["power_up(ja)"]]


async def test_nothing_to_do_is_an_empty_plan(planner: Planner) -> None:
    assert told(await find_plan(planner, robot([]), timeout=60)) == []


async def test_a_device_without_a_switch_is_proven_to_be_beyond_repair(planner: Planner) -> None:
    # T57, T66
    outcome = await find_plan(planner, robot(["imu", "jn"]), timeout=60)
    assert isinstance(outcome, Unsolvable)
    assert (outcome.goals, outcome.is_each) == ((PlanLiteral(("good", "imu")),), True)


async def test_what_is_beyond_repair_does_not_hinder_the_rest(planner: Planner) -> None:
    # T66
    problem = robot(["imu", "jn"])
    plan = await find_plan(planner, problem, timeout=60, degrade=True)
    assert told(plan) == [["stop_node(jn)"], ["start_node(jn)"]]
    assert isinstance(plan, Plan)
    assert plan.unmet == (PlanLiteral(("good", "imu")),)
    assert check_plan(problem, plan).unmet() == plan.unmet


async def test_no_plan_is_made_where_nothing_can_be_mended(planner: Planner) -> None:
    outcome = await find_plan(planner, robot(["imu"]), timeout=60, degrade=True)
    assert isinstance(outcome, Unsolvable)
    assert outcome.goals == (PlanLiteral(("good", "imu")),)


async def test_hardware_without_a_driver_is_powered_up_first_too() -> None:
    plan = await find_plan(ClingoPlanner(), robot([*HARDWARE, "hn", "hm"], on=(), running=("jn", "lan")))
    assert told(plan) == [["power_up(hu)", "power_up(ja)", "power_up(la)"], ["start_node(hm)", "start_node(hn)"]]


async def test_a_planner_that_is_not_there_says_what_to_install() -> None:
    with pytest.raises(PlanningError, match=r"install holdfast\[planners\]"):
        await find_plan(UnifiedPlanner("no-such-planner"), robot(["jn"]))
