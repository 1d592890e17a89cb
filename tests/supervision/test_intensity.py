"""Restart intensity as a pure function (otp.md 1.6, T29)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.supervision.intensity import CountedCauses, admit_restart


def admitted(times: list[float], *, intensity: int, period: float) -> list[bool]:
    window: tuple[float, ...] = ()
    result: list[bool] = []
    for now in times:
        more = admit_restart(window, now, intensity=intensity, period=period)
        result.append(more is not None)
        window = more or ()
    return result


def test_one_more_than_the_intensity_within_a_period_is_too_many() -> None:
    assert admitted([0, 1, 2, 3], intensity=3, period=5.0) == [True, True, True, False]


def test_intensity_zero_allows_none() -> None:
    assert admit_restart((), 0.0, intensity=0, period=5.0) is None


@pytest.mark.parametrize(("last", "is_admitted"), [(5.0, False), (5.000001, True)])
def test_both_ends_of_the_window_count(last: float, is_admitted: bool) -> None:
    assert (admit_restart((0.0,), last, intensity=1, period=5.0) is not None) is is_admitted


def test_restarts_spread_over_time_never_add_up() -> None:
    """T30: a program that was good for months must not be given up for its history."""
    assert all(admitted([t * 5.1 for t in range(1000)], intensity=1, period=5.0))


def test_the_window_forgets_what_no_longer_counts() -> None:
    assert admit_restart((0.0, 1.0, 6.0), 7.0, intensity=3, period=5.0) == (6.0, 7.0)


@given(
    gaps=st.lists(st.floats(0, 20), max_size=40),
    intensity=st.integers(0, 5),
    period=st.floats(0.1, 20),
)
def test_no_period_ever_holds_more_than_the_intensity(gaps: list[float], intensity: int, period: float) -> None:
    window: tuple[float, ...] = ()
    now, history = 0.0, list[float]()
    for gap in gaps:
        now += gap
        more = admit_restart(window, now, intensity=intensity, period=period)
        recent = [t for t in history if now - t <= period]
        assert (more is None) == (len(recent) + 1 > intensity)
        if more is None:
            return
        assert more == (*recent, now)
        window = more
        history.append(now)


def test_a_common_cause_counts_once_for_each_child() -> None:
    """So that one which ends by it again and again is given up at last."""
    causes = CountedCauses()
    struck = [("a", "x"), ("a", "y"), ("b", "x"), ("a", "y"), ("a", "x"), ("", "x"), ("", "y")]
    shared = [causes.is_counted(cause, child, 0.0, 5.0) for cause, child in struck]
    assert shared == [False, True, False, False, True, False, False]


@pytest.mark.parametrize(("now", "is_shared"), [(5.0, True), (5.000001, False)])
def test_a_common_cause_is_counted_once_within_a_period(now: float, is_shared: bool) -> None:
    causes = CountedCauses()
    assert not causes.is_counted("a", "x", 0.0, 5.0)
    assert causes.is_counted("a", "y", now, 5.0) is is_shared
