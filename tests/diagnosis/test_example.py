"""The paper's robot, with the answers it should have got (O1, O2, O3, O4)."""

import pytest

from holdfast.diagnosis.engine import Diagnoser, State
from holdfast.diagnosis.model import Flaw, System, lint
from tests.diagnosis.robot import ELEVEN, POWERED_DOWN, paper_robot


@pytest.fixture(scope="module")
def robot() -> Diagnoser:
    return Diagnoser(paper_robot(), seconds=60.0)


def bad(robot: Diagnoser, *observations: str, repaired: tuple[str, ...] = ()) -> list[set[str]]:
    """The candidates in their order."""
    said = robot.diagnose_now(observations, repaired=repaired)
    assert said.is_complete
    for candidate in said.candidates:  # D32
        assert sorted((*candidate.bad, *said.good(candidate))) == sorted(robot.model.components)
    return [set(candidate.bad) for candidate in said.candidates]


def test_power_up_has_one_diagnosis_the_papers_eleven(robot: Diagnoser) -> None:
    """O1, D52; what works is what the paper forgot (D57)."""
    assert bad(robot, *POWERED_DOWN) == [ELEVEN]
    said = robot.diagnose_now(POWERED_DOWN)
    assert set(said.good(said.candidates[0])) == {"js", "imu", "rviz"}


def test_power_up_with_rviz_observed_has_twelve(robot: Diagnoser) -> None:
    assert bad(robot, *POWERED_DOWN, "not running(rviz)") == [ELEVEN | {"rviz"}]


def test_after_the_power_is_on_the_software_is_left(robot: Diagnoser) -> None:
    powered = [text.removeprefix("not ") if "on(" in text and "running" not in text else text for text in POWERED_DOWN]
    assert bad(robot, *powered) == [ELEVEN - {"ja", "hu", "la"}]


def test_a_base_without_power_is_the_only_diagnosis(robot: Diagnoser) -> None:
    """O2."""
    assert bad(robot, "not on(ja)", "not ok(/odom)") == [{"ja"}]


def test_a_base_without_power_explains_trends_that_do_not_match(robot: Diagnoser) -> None:
    """D41 mended: with the clause as printed there were two diagnoses, {in, ja} and {ja, jn}."""
    assert bad(robot, "not on(ja)", "not ok(/odom)", "not matched(odom.yaw,imu.yaw)") == [{"ja"}]


def test_a_base_with_power_and_no_odometry_is_ambiguous_and_its_driver_comes_first(robot: Diagnoser) -> None:
    """O3: "take the first" must not switch the base off and on for ever."""
    assert bad(robot, "on(ja)", "running(jn)", "not ok(/odom)") == [{"jn"}, {"ja"}]


def test_what_was_just_repaired_without_success_comes_last(robot: Diagnoser) -> None:
    """O3, T54."""
    symptom = ("on(ja)", "running(jn)", "not ok(/odom)")
    assert bad(robot, *symptom, repaired=("jn",)) == [{"ja"}, {"jn"}]
    assert bad(robot, *symptom, repaired=("ja",)) == [{"jn"}, {"ja"}]


def test_a_stopped_driver_is_the_only_diagnosis(robot: Diagnoser) -> None:
    """D54, the last step of Figure 6."""
    assert bad(robot, "on(ja)", "not running(jn)", "not ok(/odom)") == [{"jn"}]
    assert bad(robot, "on(ja)", "running(jn)", "ok(/odom)") == [set()]


@pytest.mark.parametrize(
    ("observations", "expected"),
    [
        (("not ok(/scan)", "not ok(/map)"), [{"hn"}, {"hu"}]),
        (("ok(/scan)", "not ok(/map)"), [{"hm"}]),
        (("not ok(/map)",), [{"hn"}, {"hm"}, {"hu"}]),
    ],
    ids=["both topics", "the map alone", "the scan unobserved"],
)
def test_the_map_is_blamed_only_when_its_scan_is_not(
    robot: Diagnoser, observations: tuple[str, ...], expected: list[set[str]]
) -> None:
    """O4."""
    assert bad(robot, *observations) == expected


@pytest.mark.parametrize(
    ("observations", "expected"),
    [
        (("not ok(/cmd_vel)",), [{"jyn"}, {"jtn"}]),
        (("not ok(/imu_data)",), [{"in"}]),
        (("not ok(/odom)", "not matched(odom.yaw,imu.yaw)"), [{"jn"}, {"ja"}]),
        (("ok(/odom)", "ok(/imu_data)", "not matched(odom.yaw,imu.yaw)"), [{"jn"}, {"in"}, {"ja"}]),
    ],
)
def test_silent_faults(robot: Diagnoser, observations: tuple[str, ...], expected: list[set[str]]) -> None:
    assert bad(robot, *observations) == expected


def test_faults_that_do_not_touch_are_combined_and_ranked(robot: Diagnoser) -> None:
    """T54: fewer first (all are pairs here), then software before hardware."""
    found = bad(robot, "not ok(/odom)", "not ok(/map)")
    assert {frozenset(one) for one in found} == {frozenset({o, m}) for o in ("jn", "ja") for m in ("hn", "hm", "hu")}
    hardware = [len(one & {"ja", "hu"}) for one in found]
    assert hardware == sorted(hardware) == [0, 0, 1, 1, 1, 2]


def test_devices_that_nobody_names_are_never_diagnosed_and_lint_says_so(robot: Diagnoser) -> None:
    findings = {(one.flaw, one.components) for one in lint(robot.model)}
    assert {(Flaw.NEVER_DIAGNOSED, ("js",)), (Flaw.NEVER_DIAGNOSED, ("imu",))} <= findings
    assert (Flaw.ALIKE_WHILE_RUNNING, ("ja", "jn")) in findings
    assert {one for flaw, (one, *_) in findings if flaw is Flaw.ONLY_WHEN_ENDED} == {"la", "lan", "lac", "rviz"}


def test_a_device_that_its_driver_names_is_diagnosed() -> None:
    """Class H: in the paper a fault of the IMU is blamed on its driver."""
    robot = System()
    robot.hardware("imu", switchable=False)
    robot.driver("in", on=["imu"], out=["/imu_data"])
    assert bad(Diagnoser(robot), "running(in)", "not ok(/imu_data)") == [{"in"}, {"imu"}]
    assert bad(Diagnoser(robot), "not running(in)", "not ok(/imu_data)") == [{"in"}]


def test_no_fault_has_the_empty_diagnosis(robot: Diagnoser) -> None:
    """D42."""
    said = robot.diagnose_now(["on(ja)", "ok(/odom)"])
    assert said.state is State.HEALTHY
    assert [candidate.bad for candidate in said.candidates] == [()]


@pytest.mark.parametrize("name", sorted(ELEVEN | {"rviz"}))
def test_each_component_that_ends_is_found_alone(robot: Diagnoser, name: str) -> None:
    """All its topics, and what is made from them, fail with it."""
    component = robot.model.components[name]
    down = f"not on({name})" if component.kind.is_hardware else f"not running({name})"
    alive = [f"running({other})" for other in sorted(ELEVEN - {"ja", "hu", "la", name})]
    dead = {"hu": ["/scan", "/map"], "hn": ["/scan", "/map"], "ja": ["/odom"], "jyn": ["/cmd_vel"]}
    topics = dead.get(name, list(component.out))
    assert bad(robot, down, *alive, *(f"not ok({topic})" for topic in topics)) == [{name}]
