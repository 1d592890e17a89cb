"""What a model cannot do is said before it is missed."""

from holdfast.diagnosis.literals import ok
from holdfast.diagnosis.model import Flaw, Model, System, lint


def chain() -> Model:
    system = System()
    system.hardware("lidar")
    system.driver("driver", on=["lidar"], out=["/scan"])
    system.node("mapper", out={"/map": ["/scan"]})
    return Model(system)


def test_all_of_a_chain_is_told_apart_where_everything_is_observed() -> None:
    assert [(one.flaw, one.components) for one in lint(chain())] == [(Flaw.ALIKE_WHILE_RUNNING, ("lidar", "driver"))]


def test_a_chain_of_which_only_the_end_is_observed_is_one_to_the_observers() -> None:
    (finding,) = lint(chain(), [ok("/map")])
    assert (finding.flaw, set(finding.components)) == (Flaw.ALIKE, {"lidar", "driver", "mapper"})
    assert "observe something in between" in str(finding)


def test_an_observation_in_between_tells_the_sides_apart() -> None:
    (finding,) = lint(chain(), [ok("/map"), ok("/scan")])
    assert (finding.flaw, set(finding.components)) == (Flaw.ALIKE, {"lidar", "driver"})


def test_who_comes_after_the_last_observation_is_never_diagnosed() -> None:
    findings = lint(chain(), [ok("/scan")])
    assert (Flaw.NEVER_DIAGNOSED, ("mapper",)) in [(one.flaw, one.components) for one in findings]
