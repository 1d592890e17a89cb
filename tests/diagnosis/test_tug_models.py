"""The example models of the package that came with the paper, with the diagnoses that follow from them.

The ROS package is `tug_ist_model_based_diagnosis` of Graz University of Technology (Zaman, Steinbauer, 2012), with its
user manual and its folder of models, and `tug_diagnosis` (2015), which came after it. What they say of components and
topics is written down here anew. Two of their models are refused as they stand: they say what a faulty component does,
or conclude in a circle; and a literal has one word where theirs have two (`ok(p2os,mem)` is `ok(p2os.mem)`).
"""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from holdfast.diagnosis.engine import Diagnoser, State
from holdfast.diagnosis.model import Model, ModelError, System
from tests.diagnosis.oracle import correction_sets

Sets = list[set[str]]


def bad(system: System, *observations: str) -> Sets:
    """The candidates, best first; another engine finds the same ones."""
    engine = Diagnoser(system, seconds=60.0)
    said = engine.diagnose_now(observations)
    assert said.is_complete
    literals = [engine.model.vocabulary.parse(text) for text in observations]
    positive = [one for one in literals if one.positive]
    negative = [one.atom for one in literals if not one.positive]
    found = [set(candidate.bad) for candidate in said.candidates]
    assert {frozenset(one) for one in found} == correction_sets(engine.model, positive, negative)
    return found


# -- the example of the user manual -----------------------------------------------------------------------------------


def manual() -> System:
    system = System()
    system.node("aria", out=["aria_node_topic"])
    system.node("laser", out=["laser_node_topic"])
    return system


def test_the_node_that_the_manual_has_killed_is_bad_and_the_other_one_is_good() -> None:
    """The manual's step 6, and its end: the node is started again, and all is well."""
    others = ("running(laser)", "ok(laser_node_topic)")
    assert bad(manual(), "not running(aria)", "not ok(aria_node_topic)", *others) == [{"aria"}]
    said = Diagnoser(manual()).diagnose_now(["not running(aria)", "not ok(aria_node_topic)", *others])
    assert said.good(said.candidates[0]) == ("laser",)
    after = Diagnoser(manual()).diagnose_now(["running(aria)", "ok(aria_node_topic)", *others])
    assert after.state is State.HEALTHY


# -- two devices at one USB hub ---------------------------------------------------------------------------------------


def usb(*more: str) -> System:
    system = System()
    system.node("USB")
    system.node("ARIA")
    system.node("LASER")
    system.expect("ok(odom)", of=["USB", "ARIA"])
    system.expect("ok(scan)", of=["USB", "LASER"])
    for clause in more:
        system.clause(clause)
    return system


@pytest.mark.parametrize(
    ("observations", "expected"),
    [
        (("not ok(odom)", "not ok(scan)"), [{"USB"}, {"ARIA", "LASER"}]),
        (("not ok(odom)", "ok(scan)"), [{"ARIA"}, {"USB"}]),
        (("not ok(scan)",), [{"LASER"}, {"USB"}]),
        (("ok(odom)", "ok(scan)"), [set()]),
    ],
)
def test_the_hub_explains_both_topics(observations: tuple[str, ...], expected: Sets) -> None:
    found = bad(usb(), *observations)
    assert sorted(map(sorted, found)) == sorted(map(sorted, expected))
    assert len(found[0]) == len(expected[0])


def test_what_a_faulty_hub_does_is_refused() -> None:
    """Their model has it, by another word for "not ok" than its observations use: it never concludes anything."""
    with pytest.raises(ModelError, match="it says how a faulty component behaves"):
        Model(usb("AB(USB) -> not ok(odom)"))


# -- a robot that makes a map -----------------------------------------------------------------------------------------

MAPPING = {
    "gmapping": (),
    "p2os": ("sonar", "aio", "pose", "dio", "gripper_state", "battery_state", "ptz_state", "motor_state"),
    "xsens_driver": ("imu_data",),
    "sicklms": ("scan",),
    "joy_node": (),
    "teleop_joy": ("cmd_vel",),
}
"""Node to the topics that it makes from none; a seventh one makes three from two of these."""
RPY = "rpy_4_odom_imu_map_node"
ANGLES = ("roll_odom", "yaw_odom", "pitch_odom")
MATCHED = "matched(pose.twist_twist_angular_z,yaw_odom.data)"


def mapping() -> System:
    """The model that was written by hand, `DXdiagnosis_model.yaml`; it leaves four atoms undeclared."""
    system = System()
    for name, topics in MAPPING.items():
        system.node(name, out=list(topics))
    system.node(RPY, out={angle: ["imu_data", "pose"] for angle in ANGLES})
    for name in (*MAPPING, RPY):
        for resource in ("cpu", "mem"):
            system.expect(f"ok({name}.{resource})", of=[name])
    system.proposition("ok(diagnostics)")
    for name in ("p2os", "xsens_driver", "sicklms", "joy_node"):
        system.clause(f"NAB({name}) -> ok(diagnostics)")
    system.value("pose", "pose.twist_twist_angular_z")
    system.value("yaw_odom", "yaw_odom.data")
    system.expect(MATCHED, of=["p2os", RPY], given=["ok(imu_data)", "ok(pose)"])
    return system


def not_ok(topics: Iterable[str]) -> list[str]:
    return [f"not ok({topic})" for topic in topics]


@pytest.mark.parametrize("name", [*MAPPING, RPY])
def test_each_node_of_the_mapping_robot_that_ends_is_found_alone(name: str) -> None:
    """What is made from its topics fails with it."""
    topics = {*MAPPING.get(name, ANGLES)}
    topics |= {*ANGLES} if {"imu_data", "pose"} & topics else set()
    others = [f"running({other})" for other in (*MAPPING, RPY) if other != name]
    assert bad(mapping(), f"not running({name})", *not_ok(sorted(topics)), *others) == [{name}]


@pytest.mark.parametrize("resource", ["cpu", "mem"])
def test_who_takes_too_much_of_the_mapping_robot_is_found(resource: str) -> None:
    assert bad(mapping(), f"not ok(xsens_driver.{resource})", "ok(imu_data)") == [{"xsens_driver"}]


def test_headings_that_do_not_match_are_the_base_or_the_node_that_computes_one() -> None:
    found = bad(mapping(), "ok(imu_data)", "ok(pose)", f"not {MATCHED}")
    assert sorted(map(sorted, found)) == [["p2os"], [RPY]]
    assert bad(mapping(), "ok(imu_data)", "ok(pose)", *not_ok(ANGLES)) == [{RPY}]
    assert bad(mapping(), "ok(imu_data)", "not ok(pose)", *not_ok(ANGLES), f"not {MATCHED}") == [{"p2os"}]


def test_a_topic_of_which_each_of_four_is_enough_takes_all_four_to_fail() -> None:
    everybody = {"p2os", "xsens_driver", "sicklms", "joy_node"}
    assert bad(mapping(), "not ok(diagnostics)", "ok(scan)") == [everybody]


# -- a robot that drives by a map -------------------------------------------------------------------------------------

DRIVING = ("map_server", "move_base", "amcl", "p2os", "static_tf", "sicklms", "simple_navigation_goals")
BY_MOVE_BASE = ("obstacles", "global_plan", "local_plan", "feedback", "cmd_vel")
BY_P2OS = ("motor_state", "sonar", "pose", "battery_state")


def driving(*, is_circle: bool) -> System:
    """The model that their generator made of a robot that drives by a map: the base needs what it makes possible."""
    system = System()
    commands = ["cmd_vel"] if is_circle else []
    outs: dict[str, dict[str, list[str]]] = {
        "move_base": {topic: ["tf", "scan"] for topic in BY_MOVE_BASE},
        "amcl": {topic: ["tf", "scan"] for topic in ("amcl_pose", "particlecloud")},
        "p2os": dict.fromkeys(BY_P2OS, commands),
        "sicklms": {"scan": []},
    }
    for name in DRIVING:
        system.node(name, out=outs.get(name, {}))
    system.proposition("ok(tf)")
    system.clause("NAB(static_tf) -> ok(tf)")
    system.clause(f"NAB(p2os){', ok(cmd_vel)' if is_circle else ''} -> ok(tf)")
    system.clause(f"NAB(amcl), ok(scan){', ok(tf)' if is_circle else ''} -> ok(tf)")
    return system


def test_the_generated_model_of_the_driving_robot_concludes_in_a_circle() -> None:
    with pytest.raises(ModelError, match=r"circle: .*leave out the input that matters least"):
        Model(driving(is_circle=True))


@pytest.mark.parametrize(
    ("observations", "expected"),
    [
        (("not running(sicklms)", *not_ok(["scan", "amcl_pose", *BY_MOVE_BASE])), [{"sicklms"}]),
        (("running(move_base)", "ok(scan)", "ok(tf)", *not_ok(BY_MOVE_BASE)), [{"move_base"}]),
        (("not running(p2os)", *not_ok(BY_P2OS), "ok(tf)"), [{"p2os"}]),
        (("ok(scan)", "not ok(tf)"), [{"amcl", "p2os", "static_tf"}]),
        (("not running(amcl)", "not running(map_server)", "ok(scan)", "not ok(amcl_pose)"), [{"amcl", "map_server"}]),
    ],
    ids=["the laser", "the planner", "the base", "no transforms", "two nodes"],
)
def test_the_driving_robot_without_the_circle(observations: tuple[str, ...], expected: Sets) -> None:
    assert bad(driving(is_circle=False), *observations) == expected


# -- three nodes in a row ---------------------------------------------------------------------------------------------

ROW = ("node1", "node2", "node3")
FAILED = [
    (("ok(topic1)", "not ok(topic2)", "not ok(topic3)"), {"node2"}),
    (("ok(topic1)", "ok(topic2)", "not ok(topic3)"), {"node3"}),
]
"""What the test of `tug_diagnosis` observes, and which node it is, of those that it expects."""


def test_of_nodes_in_a_row_theirs_has_all_that_come_before_as_candidates() -> None:
    """Their clauses: what a node publishes is ok while it and all before it work, whatever the topics between are."""
    system = System()
    for count, name in enumerate(ROW, 1):
        system.node(name)
        system.expect(f"ok(topic{count})", of=ROW[:count])
    (first, _), (second, _) = FAILED
    assert sorted(map(sorted, bad(system, *first))) == [["node1"], ["node2"]]  # Their test has {node1, node3}, too.
    assert sorted(map(sorted, bad(system, *second))) == [["node1"], ["node2"], ["node3"]]


@pytest.mark.parametrize(("observations", "expected"), FAILED)
def test_of_nodes_in_a_row_those_whose_topic_is_ok_are_no_candidates(
    observations: tuple[str, ...], expected: set[str]
) -> None:
    system = System()
    for count, name in enumerate(ROW, 1):
        system.node(name, out={f"topic{count}": [f"topic{count - 1}"] if count > 1 else []})
    assert bad(system, *observations) == [expected]
