"""What the monitoring engine decides: with hysteresis, dwell time and cost of transition, it never flaps (T45)."""

import itertools
import math
from typing import Any

import hypothesis
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.ftm.model.application import Application
from holdfast.ftm.model.change_model import FaultClasses, Resources, response_price
from holdfast.ftm.monitoring.judge import (
    ADAPT,
    HOLD,
    NONE,
    STAY,
    Judge,
    Readings,
    Settings,
    Signals,
    Threshold,
    Verdict,
)
from tests.ftm.declarations import EIGHT

APP = Application("Account", state_bytes=10_000, request_bytes=100, rate=100)
NEED_OF_PBR = 100 * (10_000 + 100)  # bytes per second
CRASH = FaultClasses.of("crash")
QUICK = Settings(required=CRASH, confirm=0, dwell=0, urgent_dwell=0, transition_cost=0, smoothing=1)


def judge(
    current: tuple[str, ...] = ("pbr",), settings: Settings = QUICK, application: Application = APP, **resources: Any
) -> Judge:
    return Judge(settings, application, current, EIGHT, msgspec.structs.replace(Resources(units=2), **resources))


def follow(one: Judge, now: float) -> Verdict:
    """Decide, and do it."""
    verdict = one.decide(now)
    if verdict.kind == ADAPT:
        assert verdict.target is not None
        one.changed(verdict.target, now)
    return verdict


# -- what sets it off -----------------------------------------------------------------------------------------------


def test_a_mechanism_that_suits_stays() -> None:
    verdict = judge(("lfr",), bandwidth=1e6).decide(0)
    assert (verdict.kind, verdict.target, verdict.is_urgent) == (STAY, None, False)


def test_a_drop_in_bandwidth_leads_from_pbr_to_lfr() -> None:
    """A22, A6."""
    one = judge(bandwidth=NEED_OF_PBR / 2)
    verdict = one.decide(0)
    assert (verdict.kind, verdict.target, verdict.is_urgent) == (ADAPT, ("lfr",), True)
    assert verdict.reason.startswith("pbr is not valid any more: pbr: sends 1.01e+06 bytes/s between units")
    assert verdict.reason.endswith("lfr is the cheapest that is")


@pytest.mark.parametrize("state", [1_000, 20_000, 1_000_000, 100_000_000])
@pytest.mark.some(2)
def test_bandwidth_that_returns_leads_back_from_lfr_to_pbr(state: int) -> None:
    """A22, A21: with the settings that nobody has touched."""
    app = msgspec.structs.replace(APP, state_bytes=state)
    one = judge(settings=Settings(required=CRASH), application=app, bandwidth=50.0 * state)
    for now in range(20):
        follow(one, float(now))
    assert one.current == ("lfr",)
    one.read(Readings(bandwidth=1e12))
    one.resources = msgspec.structs.replace(one.resources, bandwidth=1e12)
    for now in range(20, 1000):
        follow(one, float(now))
    assert one.current == ("pbr",)


def test_a_battery_that_runs_low_leads_to_what_computes_least() -> None:
    """A18: LFR answers sooner, and computes twice."""
    one = Judge(QUICK, APP, ("lfr",), EIGHT, Resources(units=2), response_price)
    assert one.decide(0).kind == STAY
    one.read(Readings(energy=0.1))
    assert follow(one, 1).target == ("pbr",)
    one.resources = msgspec.structs.replace(one.resources, energy=1.0)  # On mains again.
    assert follow(one, 2).target == ("lfr",)


def test_transient_faults_add_tr_and_their_end_takes_it_away() -> None:
    """A24, A21: transitions go both ways."""
    app = msgspec.structs.replace(APP, is_deterministic=True, request_bytes=0, state_bytes=0)
    threshold = Threshold("transient_value", count=3, window=60, calm=100)
    one = judge(settings=msgspec.structs.replace(QUICK, thresholds={"mismatch": threshold}), application=app)
    assert follow(one, 0).kind == STAY
    one.signal("mismatch", 1, 2)
    assert follow(one, 2).kind == STAY  # two are not enough
    one.signal("mismatch", 3)
    assert follow(one, 4).target == ("pbr", "tr")
    assert follow(one, 50).kind == STAY
    assert follow(one, 64).kind == STAY  # on its way out, and not gone
    assert follow(one, 163).kind == STAY
    assert follow(one, 164).target == ("pbr",)


def test_another_version_that_is_not_deterministic_leads_from_lfr_to_pbr() -> None:
    one = judge(("lfr",))
    assert one.decide(0).kind == STAY or one.decide(0).target == ("pbr",)
    one.application = msgspec.structs.replace(APP, is_deterministic=False, version="2")
    verdict = one.decide(1)
    assert (verdict.kind, verdict.target, verdict.is_urgent) == (ADAPT, ("pbr",), True)
    assert "lfr needs determinism" in verdict.reason


def test_a_lost_unit_leaves_what_one_unit_can_do_or_nothing() -> None:
    one = judge()
    one.read(Readings(units=1))
    verdict = one.decide(0)
    assert verdict.kind == NONE
    assert verdict.target is None
    assert "needs 2 processing units, and has 1" in verdict.reason
    assert [str(choice) for choice in verdict.degraded] == ["unprotected"]
    one.read(Readings(units=2))
    assert one.decide(1).kind == STAY


def test_faults_that_are_required_are_tolerated_before_any_was_seen() -> None:
    verdict = judge(()).decide(0)
    assert verdict.is_urgent
    assert verdict.target is not None
    assert len(verdict.target) == 1
    assert "unprotected is not valid any more: unprotected: does not tolerate crash" in verdict.reason


def test_a_mechanism_that_nobody_declares_is_refused() -> None:
    with pytest.raises(ValueError, match="no declaration of magic"):
        judge(("magic",))
    with pytest.raises(ValueError, match="no declaration of magic"):
        judge().changed(("magic",), 0)


# -- what holds it back ---------------------------------------------------------------------------------------------


def test_a_wish_is_followed_when_it_has_held() -> None:
    one = judge(settings=msgspec.structs.replace(QUICK, confirm=5), bandwidth=NEED_OF_PBR / 2)
    assert one.decide(0).kind == HOLD
    assert "wanted for 4 s of 5" in one.decide(4).reason
    one.read(Readings(bandwidth=NEED_OF_PBR * 2))
    assert one.decide(4.5).kind == STAY  # a moment without the wish, and it counts from the start
    one.read(Readings(bandwidth=NEED_OF_PBR / 2))
    assert one.decide(5).kind == HOLD
    assert one.decide(9.9).kind == HOLD
    assert one.decide(10).kind == ADAPT


def test_nothing_changes_soon_after_a_change_that_must_not() -> None:
    settings = msgspec.structs.replace(QUICK, dwell=100, urgent_dwell=10)
    one = judge(("tmr",), settings=settings, units=3)
    one.changed(("tmr",), 0)
    assert one.decide(50).kind == HOLD  # cheaper ones can wait
    assert not one.decide(99).is_urgent
    assert one.decide(100).kind == ADAPT
    one.read(Readings(units=2))
    one.changed(("tmr",), 200)
    assert one.decide(205).kind == HOLD  # what is not valid waits, too, but less
    assert one.decide(210).kind == ADAPT


def test_a_change_that_saves_less_than_it_costs_is_not_made() -> None:
    cheap, dear = (msgspec.structs.replace(QUICK, transition_cost=cost) for cost in (1.0, 1000.0))
    assert judge(("tmr",), settings=cheap, units=3).decide(0).kind == ADAPT
    assert judge(("tmr",), settings=dear, units=3).decide(0).kind == STAY
    # If it must be, it is worth any cost.
    assert judge(("tmr",), settings=dear, units=2).decide(0).kind == ADAPT


def test_a_change_that_failed_is_not_tried_again_at_once() -> None:
    one = judge(settings=msgspec.structs.replace(QUICK, urgent_dwell=10, dwell=10), bandwidth=NEED_OF_PBR / 2)
    assert one.decide(0).kind == ADAPT
    one.failed(0)
    assert one.decide(1).kind == HOLD
    assert one.decide(10).kind == ADAPT


def test_between_good_and_bad_nothing_changes_either_way() -> None:
    little = NEED_OF_PBR * 0.9  # a little less than it needs
    closed = msgspec.structs.replace(APP, is_deterministic=False)
    assert judge(("pbr",), bandwidth=little, application=closed).decide(0).kind == STAY
    nothing = Settings(required=CRASH, confirm=0)
    assert judge((), settings=nothing, bandwidth=little, application=closed).decide(0).kind == NONE


def test_what_a_person_forbids_is_not_chosen_until_then() -> None:
    one = judge(bandwidth=NEED_OF_PBR / 2)
    one.forbid(("lfr",), until=10, why="not on this robot")
    verdict = one.decide(0)
    assert verdict.kind == NONE
    assert "lfr: not on this robot (veto)" in verdict.reason
    assert one.decide(10).target == ("lfr",)
    one.forbid(("lfr",), until=100, why="not now")
    assert one.decide(11).kind == NONE
    one.allow(("lfr",))
    assert one.decide(12).target == ("lfr",)


# -- signals and readings -------------------------------------------------------------------------------------------


def test_a_fault_class_comes_at_the_threshold_and_goes_after_a_calm() -> None:
    signals = Signals(Threshold("crash", count=2, window=10, leave=0, calm=20))
    signals.put(0)
    assert not signals.look(0)
    signals.put(11)  # the first is out of the window
    assert not signals.look(11)
    signals.put(12)
    assert signals.look(12)
    assert signals.look(23)  # calm from here on
    signals.put(30)
    assert signals.look(31)  # one is no calm
    assert signals.look(41)
    assert signals.look(60)
    assert not signals.look(61)


@pytest.mark.parametrize("wrong", [{"count": 1, "leave": 1}, {"window": 0}, {"calm": -1}, {"leave": -1}])
def test_a_threshold_without_hysteresis_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="crash"):
        Threshold("crash", **wrong)


@pytest.mark.parametrize(
    "wrong", [{"smoothing": 0}, {"margin": 1}, {"urgent_dwell": 9, "dwell": 1}, {"interval": 0}, {"confirm": -1}]
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"must|times"):
        Settings(**wrong)


def test_amounts_are_smoothed_and_counts_are_not() -> None:
    one = judge(settings=msgspec.structs.replace(QUICK, smoothing=0.5))
    one.read(Readings(units=4, bandwidth=100, cpu=1.0, certificates=True))
    one.read(Readings(units=2, bandwidth=200, cpu=0.5))
    assert one.resources == Resources(units=2, bandwidth=150, cpu=0.75, certificates=True)
    one.read(Readings(bandwidth=math.nan, energy=math.nan))
    assert one.resources.bandwidth == 150
    assert one.resources.energy == 1
    one.read(Readings(bandwidth=math.inf))
    assert one.resources.bandwidth == math.inf


def test_one_glitch_of_a_measurement_changes_nothing() -> None:
    one = judge(settings=Settings(required=CRASH, confirm=3), bandwidth=math.inf)
    for second in range(100):
        one.read(Readings(bandwidth=0.0 if second == 50 else NEED_OF_PBR * 3))
        assert one.decide(float(second)).kind in (STAY, HOLD)


# -- noise ----------------------------------------------------------------------------------------------------------

# Most of it at its limits, where it is worst.
noises = st.lists(st.sampled_from([-1.0, 1.0, 0.5]) | st.floats(-1, 1), min_size=8, max_size=40)


@given(
    st.integers(-15, 15).map(lambda tenths: tenths / 10),
    st.integers(2, 90).map(lambda percent: percent / 100),
    noises,
    st.sampled_from(["pbr", "lfr"]),
    st.sampled_from([1.0, 0.3]),
)
def test_noise_within_the_margin_never_makes_it_flap(
    place: float, margin: float, noise: list[float], start: str, smoothing: float
) -> None:
    """Whatever the level is and whatever the noise does: one change at most, without any help from waiting (T45)."""
    settings = msgspec.structs.replace(QUICK, margin=margin, smoothing=smoothing)
    one = judge((start,), settings=settings, bandwidth=math.inf)
    level = 1 / (1 + place * margin) if place * margin > -0.99 else 10.0  # about where PBR begins to suit
    changes = 0
    for second, part in enumerate(noise):
        one.read(Readings(bandwidth=level * NEED_OF_PBR * (1 + 0.99 * margin * part)))
        changes += follow(one, float(second)).kind == ADAPT
    assert changes <= 1


@given(
    st.lists(
        st.tuples(
            st.integers(1, 6),
            st.sampled_from([1e3, 2e5, 1e9]),
            st.sampled_from([1, 2, 4, 4]),
            st.integers(0, 1),
            st.booleans(),
        ),
        min_size=10,
        max_size=50,
    ),
    st.sampled_from(["pbr", "lfr", "tmr"]),
)
def test_however_wild_the_world_is_changes_are_a_dwell_time_apart(
    world: list[tuple[int, float, int, int, bool]], start: str
) -> None:
    settings = Settings(required=CRASH, confirm=2, dwell=40, urgent_dwell=15, transition_cost=0.1, smoothing=1)
    one = judge((start,), settings=settings, units=4)
    now, changes = 0.0, list[tuple[float, bool]]()
    for seconds, bandwidth, units, mismatches, is_deterministic in world:
        now += seconds
        one.read(Readings(bandwidth=bandwidth, units=units))
        one.signal("mismatch", now, mismatches)
        one.application = msgspec.structs.replace(APP, is_deterministic=is_deterministic)
        verdict = follow(one, now)
        if verdict.kind == ADAPT:
            changes.append((now, verdict.is_urgent))
    for (earlier, _), (later, is_urgent) in itertools.pairwise(changes):
        assert later - earlier >= (15 if is_urgent else 40)


@hypothesis.settings(max_examples=30)
@given(st.lists(st.integers(0, 3), min_size=20, max_size=40))
def test_signals_that_come_and_go_do_not_flap(counts: list[int]) -> None:
    """Mismatches in any rhythm: TR is added once, and not taken away before a calm of full length."""
    app = msgspec.structs.replace(APP, state_bytes=0, request_bytes=0)
    one = judge(application=app)
    added, removed = list[float](), list[float]()
    for second, count in enumerate(counts):
        one.signal("mismatch", float(second), count)
        verdict = follow(one, float(second))
        if verdict.kind == ADAPT:
            (added if verdict.target == ("pbr", "tr") else removed).append(second)
    assert len(added) <= 1
    assert not removed  # the calm is 600 s, and this lasted a minute
