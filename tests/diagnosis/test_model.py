"""From a declaration to rules, and what is refused on the way."""

import pytest

from holdfast.diagnosis.model import Component, Declaration, Kind, Model, ModelError, System
from tests.diagnosis.robot import paper_robot

AS_EXTERNAL = "if it comes from outside, declare it as external"


def printed(system: System) -> list[str]:
    return [str(rule) for rule in Model(system).rules]


def problems(system: System) -> list[str]:
    with pytest.raises(ModelError) as caught:
        Model(system)
    return list(caught.value.problems)


def test_the_papers_components_fall_into_its_five_sets() -> None:
    """D34, D35."""
    kinds: dict[Kind, set[str]] = {}
    for component in Model(paper_robot()).components.values():
        kinds.setdefault(component.kind, set()).add(component.name)
    assert kinds == {
        Kind.NODE: {"jtn", "hm", "rviz", "lac"},
        Kind.DRIVER: {"in", "jyn"},
        Kind.SWITCHED_DRIVER: {"jn", "hn", "lan"},
        Kind.SWITCHABLE: {"ja", "hu", "la"},
        Kind.DEVICE: {"js", "imu"},
    }


def test_the_papers_robot_has_the_papers_clauses() -> None:
    """D36 to D41, the last one mended."""
    rules = [(rule.origin, str(rule)) for rule in Model(paper_robot()).rules]
    count = {f"clause {i}": sum(origin == f"clause {i}" for origin, _ in rules) for i in range(1, 7)}
    assert count == {"clause 1": 3, "clause 2": 2, "clause 3": 2, "clause 4": 2, "clause 5": 9, "clause 6": 1}
    for wanted in [
        ("clause 1", "not AB(ja) -> on(ja)"),
        ("clause 2", "not AB(jn) and not AB(ja) -> ok(/odom)"),
        ("clause 3", "not AB(in) -> ok(/imu_data)"),
        ("clause 4", "not AB(hm) and ok(/scan) -> ok(/map)"),
        ("clause 5", "not AB(rviz) -> running(rviz)"),
        ("clause 6", "not AB(jn) and not AB(ja) and not AB(in) -> matched(odom.yaw,imu.yaw)"),
    ]:
        assert wanted in rules


def test_related_values_wait_for_what_they_are_made_from() -> None:
    system = System()
    system.driver("a", out=["/raw", "/other"])
    system.node("b", out={"/x": ["/raw"], "/y": ["/other"]})
    system.value("/x", "x.v")
    system.related(("b", "x.v"), ("a", "raw.v"))
    assert "not AB(b) and not AB(a) and ok(/raw) -> matched(x.v,raw.v)" in printed(system)


def test_a_driver_names_devices_that_come_later() -> None:
    system = System()
    system.driver("jn", on=["ja"])
    system.hardware("ja")
    assert Model(system).components["jn"].kind is Kind.SWITCHED_DRIVER


def test_properties_are_expected_of_any_component() -> None:
    """D18, D25: nothing here needs a robot."""
    system = System()
    system.node("ledger", out=["/booked"])
    system.expect("ok(ledger.memory)", of=["ledger"], given=["ok(/booked)"])
    assert "not AB(ledger) and ok(/booked) -> ok(ledger.memory)" in printed(system)
    assert Model(system).vocabulary.parse("not ok(ledger.memory)")


@pytest.mark.parametrize(
    ("clause", "rule"),
    [
        ("NAB(a), NAB(b) -> ok(t)", "not AB(a) and not AB(b) -> ok(t)"),
        ("not AB(a) and ok(u) -> ok(t)", "not AB(a) and ok(u) -> ok(t)"),
        ("¬AB(a) ∧ ok(u) → ok(t)", "not AB(a) and ok(u) -> ok(t)"),
        ("ok(u), ok(t) -> false", "ok(u) and ok(t) -> false"),
        ("NAB(a), not_ok(t) -> false", "not AB(a) -> ok(t)"),
        ("NAB(a) -> not_ok(t)", "not AB(a) and ok(t) -> false"),
        ("ok(u) -> AB(a)", "not AB(a) and ok(u) -> false"),
    ],
)
def test_clauses_of_every_horn_form_are_read(clause: str, rule: str) -> None:
    """D30."""
    system = System()
    system.node("a")
    system.node("b")
    system.proposition("ok(t)", "ok(u)")
    system.clause(clause)
    assert printed(system)[-1] == rule


@pytest.mark.parametrize(
    ("clause", "problem"),
    [
        ("NAB(a), not_ok(u) -> ok(t)", "not a Horn clause"),
        ("AB(a) -> not_ok(t)", "how a faulty component behaves"),
        ("ok(t) -> NAB(a)", "proves one healthy"),
        ("NAB(x) -> ok(t)", "x, a component that does not exist"),
        ("NAB(a) -> ok(v)", "no such atom"),
        ("NAB(a) - ok(t)", "spelled"),
        ("NAB(a) ->", "spelled"),
        ("NAB(a, b) -> ok(t)", "takes one component"),
        ("nab(a) -> ok(t)", "no predicate 'nab'"),
        ("NAB(a) -> ok(t, u)", "ok takes 1 argument"),
    ],
)
def test_other_clauses_are_refused_with_the_reason(clause: str, problem: str) -> None:
    system = System()
    system.node("a")
    system.proposition("ok(t)", "ok(u)")
    system.clause(clause)
    assert problem in "\n".join(problems(system))


def test_names_that_lead_nowhere_are_found_all_at_once() -> None:
    system = System()
    system.hardware("ja")
    system.driver("jn", on=["jaa"], out=["/odom"])
    system.driver("kn", on=["hm"])
    system.node("hm", out={"/map": ["/odm"]})
    system.node("ja")
    system.node("my node")
    system.related(("jn", "v"), ("ja", "w"))
    system.related(("jn", "v"), ("zz", "w"))
    system.related(("jn", "v"), ("hm", "v"))
    system.expect("ok(x)", of=["jo"])
    system.value("/od", "v")
    assert problems(system) == [
        "ja is declared twice",
        "'my node' is no name: no spaces, brackets and commas, please",
        "jn drives jaa, a component that does not exist (did you mean ja?)",
        "kn drives hm, which is no device",
        "a value of ja is related, but a device publishes none: name its driver",
        "a value is related of zz, a component that does not exist",
        "v is related to itself",
        "ok(x) is expected of jo, a component that does not exist",
        "value v is in /od, a topic that does not exist (did you mean /odom?)",
        f"/map of hm is made from /odm, a topic that does not exist (did you mean /odom?); {AS_EXTERNAL}",
    ]


@pytest.mark.parametrize("prior", [0.0, 1.0, -1.0, float("nan")])
def test_a_prior_is_a_probability_that_leaves_room_for_doubt(prior: float) -> None:
    system = System()
    system.node("a", prior=prior)
    assert "must be between 0 and 1" in problems(system)[0]


def test_devices_publish_nothing_and_nodes_drive_nothing() -> None:
    declared = Declaration(
        components=(Component(name="h", kind=Kind.SWITCHABLE, out={"/a": ()}), Component(name="n", on=("h",)))
    )
    with pytest.raises(ModelError) as caught:
        Model(declared)
    assert caught.value.problems == (
        "h is a device: it publishes nothing and drives nothing; its driver does",
        "n drives h: declare it as a driver",
    )


def test_a_topic_from_outside_is_declared() -> None:
    system = System()
    system.external("/clock")
    system.node("a", out={"/a": ["/clock"]})
    assert "not AB(a) and ok(/clock) -> ok(/a)" in printed(system)


def test_a_circle_is_refused_and_shown() -> None:
    system = System()
    system.node("a", out={"/a": ["/c"]})
    system.node("b", out={"/b": ["/a"]})
    system.node("c", out={"/c": ["/b"]})
    (problem,) = problems(system)
    assert "ok(/a) <- ok(/c) <- ok(/b) <- ok(/a)" in problem


def test_a_long_chain_is_no_circle_and_not_too_deep() -> None:
    system = System()
    system.driver("n0", out=["/0"])
    for i in range(1, 5000):
        system.node(f"n{i}", out={f"/{i}": [f"/{i - 1}"]})
    assert len(Model(system).rules) == 10_000
