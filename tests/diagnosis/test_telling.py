"""What a diagnosis tells people, other programs, and who looks next."""

from collections.abc import Sequence

import msgspec
import pytest
from hypothesis import assume, given, settings

from holdfast.diagnosis.engine import Diagnoser, Diagnosis, State
from holdfast.diagnosis.literals import Literal, ok, on, parse
from holdfast.diagnosis.model import Model, System
from holdfast.diagnosis.observations import Observed
from tests.diagnosis.oracle import cases, is_consistent
from tests.diagnosis.robot import ELEVEN, POWERED_DOWN, paper_robot

ROBOT = Diagnoser(paper_robot(), seconds=60.0)


def test_conflicts_are_told_in_plain_words() -> None:
    told = str(ROBOT.explain(["on(ja)", "not ok(/odom)", "not ok(/map)", "ok(/scan)"]))
    assert told.splitlines() == [
        "not ok(/map) while ok(/scan): hm is faulty",
        "not ok(/odom): at least one of ja and jn is faulty",
    ]


def test_failures_that_follow_from_others_are_told_apart_from_faults() -> None:
    told = ROBOT.explain(["not on(ja)", "not ok(/odom)", "not ok(/scan)", "not ok(/map)", "not on(hu)"])
    assert [str(one) for one in told.conflicts] == ["not on(ja): ja is faulty", "not on(hu): hu is faulty"]
    assert [str(one) for one in told.consequences] == [
        "not ok(/odom): follows from ja",
        "not ok(/scan): follows from hu",
        "not ok(/map): follows from not ok(/scan)",
    ]


def test_a_failure_that_no_rule_is_about_is_not_passed_over() -> None:
    system = System()
    system.node("a")
    system.external("/clock")
    engine = Diagnoser(system)
    assert engine.diagnose_now(["not ok(/clock)"]).state is State.HEALTHY
    assert str(engine.explain(["not ok(/clock)"])) == "not ok(/clock): nothing in the model accounts for it"


@given(cases())
@settings(max_examples=300)
def test_each_conflict_is_one_and_is_minimal(case: tuple[Model, frozenset[Literal], frozenset[Literal]]) -> None:
    model, positive, negative = case
    engine = Diagnoser(model, seconds=60.0)
    said = engine.diagnose_now(Observed(positive, negative))
    assume(said.state in (State.FAULTY, State.HEALTHY) and not said.contradictions)
    conflicts = engine.explain(Observed(positive, negative)).conflicts
    assert bool(conflicts) == (said.state is State.FAULTY)
    everyone = set(model.components)
    for conflict in conflicts:
        blamed = set(conflict.components)
        assert not is_consistent(model, positive, negative, everyone - blamed)
        for name in blamed:
            assert is_consistent(model, positive, negative, everyone - (blamed - {name}))
        assert all(blamed & set(one.bad) for one in said.candidates)


def best(observations: Sequence[str], seen: Sequence[Literal] | None = None) -> list[str]:
    said = ROBOT.diagnose_now(observations)
    return [str(probe.atom) for probe in ROBOT.next_observations(observations, said, can_be_seen=seen)]


def test_the_observation_in_between_tells_most() -> None:
    observations = ["not ok(/map)"]
    said = ROBOT.diagnose_now(observations)
    first, *others = ROBOT.next_observations(observations, said)
    assert first.atom == ok("/scan")
    assert first.if_so == (("hm",),)
    assert set(first.if_not) == {("hn",), ("hu",)}
    # Three equally likely, of which the answer leaves one or two: log2(3) - 2/3.
    assert first.gain == pytest.approx(1.584962500721156 - 2 / 3)
    assert all(probe.gain < first.gain for probe in others)


def test_only_what_can_be_seen_is_proposed_and_dear_observations_gain_less() -> None:
    assert best(["not ok(/map)"], [on("hu"), on("ja")]) == ["on(hu)"]
    observations = ["not ok(/map)"]
    dear = ROBOT.next_observations(observations, ROBOT.diagnose_now(observations), costs={ok("/scan"): 100.0})
    assert dear[0].atom != ok("/scan")


def test_one_candidate_needs_no_telling_apart() -> None:
    assert best(["not on(ja)"]) == []


@given(cases())
@settings(max_examples=600)
def test_a_probe_foretells_which_candidates_remain(
    case: tuple[Model, frozenset[Literal], frozenset[Literal]],
) -> None:
    model, positive, negative = case
    engine = Diagnoser(model, seconds=60.0)
    said = engine.diagnose_now(Observed(positive, negative))
    assume(not said.contradictions)
    for probe in engine.next_observations(Observed(positive, negative), said):
        assert probe.atom not in positive | negative
        told = [one.bad for one in said.candidates[:16]]
        so = [bad for bad in told if is_consistent(model, positive | {probe.atom}, negative, bad)]
        not_so = [bad for bad in told if is_consistent(model, positive, negative | {probe.atom}, bad)]
        assert (list(probe.if_so), list(probe.if_not)) == (so, not_so)


def test_good_and_bad_together_are_all_components() -> None:
    """D8, D32."""
    (sets,) = ROBOT.diagnose_now(POWERED_DOWN).sets()
    assert set(sets["bad"]) == ELEVEN
    assert set(sets["good"]) == {"js", "imu", "rviz"}
    assert len(sets["bad"]) + len(sets["good"]) == 14


def test_ros_is_told_in_its_own_words() -> None:
    """D33: error where sure, warning where not."""
    said = ROBOT.diagnose_now(["not on(la)", "not ok(/odom)", "ok(/map)"]).ros(stamp=12.25)
    assert said["header"]["stamp"] == {"sec": 12, "nanosec": 250_000_000}
    level = {status["name"]: status["level"] for status in said["status"]}
    assert (level["la"], level["ja"], level["jn"], level["hm"], level["hn"]) == (2, 1, 1, 0, 3)
    assert set(level) == set(ROBOT.model.components)
    (jn,) = [status for status in said["status"] if status["name"] == "jn"]
    assert jn["values"] == [{"key": "probability", "value": "0.500"}]


def test_ros_is_told_when_nothing_is_known() -> None:
    for observations in ([], ["running(hm)", "not running(hm)"]):
        assert {status["level"] for status in ROBOT.diagnose_now(observations).ros(0.0)["status"]} == {3}


def test_only_who_is_convicted_is_certain_while_candidates_may_be_missing() -> None:
    said = ROBOT.diagnose_now(["not on(la)", "not ok(/odom)"])
    assert said.certain == ("la",)
    assert msgspec.structs.replace(said, truncated=("count",)).certain == ("la",)
    two = ROBOT.diagnose_now(["not ok(/odom)", "on(ja)"])
    assert msgspec.structs.replace(two, truncated=("count",)).certain == ()


def test_a_diagnosis_crosses_a_wire() -> None:
    said = ROBOT.diagnose_now(["not on(la)", "not ok(/odom)", "running(hm)"])
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(said), type=Diagnosis) == said
    torn = ROBOT.diagnose_now(["running(hm)", "not running(hm)"])
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(torn), type=Diagnosis) == torn


def test_symptoms_are_what_has_to_be_explained() -> None:
    said = ROBOT.diagnose_now(["not ok(/scan)", "not ok(/map)", "ok(/odom)"])
    assert said.symptoms == (parse("not ok(/scan)"),)
