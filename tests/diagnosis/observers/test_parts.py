"""What observers are made of: regression, debounce, limits, filters, readers."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.diagnosis.observers import Agreement, Debounce, Fit, Limits, Manner, Regression, trend
from holdfast.diagnosis.observers.verdicts import reader


def by_hand(samples: list[tuple[float, float]]) -> float:
    """The slope by the textbook, in O(n)."""
    n = len(samples)
    t0, y0 = sum(t for t, _ in samples) / n, sum(y for _, y in samples) / n
    return sum((t - t0) * (y - y0) for t, y in samples) / sum((t - t0) ** 2 for t, _ in samples)


@given(
    st.lists(st.tuples(st.floats(0.01, 1.0), st.floats(-100, 100)), min_size=3, max_size=200),
    st.floats(1.0, 10.0),
    st.sampled_from([0.0, 1e5, 1.7e9]),
)
def test_sliding_sums_give_the_slope_of_the_window(
    steps: list[tuple[float, float]], window: float, begin: float
) -> None:
    # D22; also at times as large as Unix time, where sums of squares would have no digits left
    line, now, kept = Regression(window), begin, list[tuple[float, float]]()
    for step, value in steps:
        now += step
        line.add(now, value)
        kept = [one for one in kept if one[0] >= now - window] + [(now, value)]
        assert len(line) == len(kept)
        fit = line.fit()
        if len(kept) >= 3:
            assert fit is not None
            assert math.isclose(fit.slope, by_hand(kept), rel_tol=1e-4, abs_tol=1e-3)


def test_a_sample_costs_the_same_in_a_long_window_as_in_a_short_one() -> None:
    class Counted(Regression):
        touched = 0

        def _count(self, time: float, value: float, sign: int) -> None:
            Counted.touched += 1
            super()._count(time, value, sign)

    for window in (10.0, 1000.0):
        Counted.touched, line = 0, Counted(window)
        for number in range(20_000):
            line.add(float(number), 1.0)
        assert Counted.touched <= 3 * 20_000 + 2000  # in, out, and once in a remake


def test_digits_are_not_lost_over_a_million_seconds() -> None:
    line, rng = Regression(20.0), random.Random(1)
    for second in range(100_000):
        line.add(1e6 + second, 0.5 * second + rng.uniform(-1e-3, 1e-3))
    fit = line.fit()
    assert fit is not None
    assert abs(fit.slope - 0.5) < 1e-3


def test_a_window_is_full_when_samples_reach_over_it_and_not_after_a_gap() -> None:
    line = Regression(3.0)
    fullness = []
    for second in (0, 1, 2, 3, 4, 5, 50, 51, 52, 53, 54):
        line.add(float(second), 0.0)
        fullness.append(line.is_full)
    assert fullness == [False] * 4 + [True, True] + [False] * 4 + [True]


def test_a_trend_that_is_not_certain_is_unknown() -> None:
    # T52
    assert [str(trend("v", Fit(slope, 0.0), 0.5)) for slope in (1.0, -1.0, 0.1)] == ["inc(v)", "dec(v)", "const(v)"]
    assert trend("v", Fit(0.6, 0.1), 0.5, significance=2.0) is None
    assert trend("v", Fit(0.4, 0.1), 0.5, significance=2.0) is None
    assert str(trend("v", Fit(0.8, 0.1), 0.5, significance=2.0)) == "inc(v)"


def test_unknown_counts_at_once_and_makes_agreement_begin_anew() -> None:
    # T50, T52
    debounce = Debounce[str](Agreement(2, 3))
    assert [debounce(vote) for vote in ("a", "a", None, "a", "a")] == [None, "a", None, None, "a"]


def test_what_was_bad_must_be_clearly_good_to_be_good_again() -> None:
    limits = Limits(low=0.0, high=10.0, hysteresis=1.0)
    values, verdict, verdicts = (5.0, 9.5, 10.5, 9.5, 8.5, 0.5, -0.5, 0.5, 1.5), None, []
    for value in values:
        verdict = limits.holds(value, verdict)
        verdicts.append(verdict)
    assert verdicts == [True, True, False, False, True, True, False, False, True]


@pytest.mark.parametrize("message", [{"a": [1, float("nan")]}, {"a": "text"}, {}, None, {"a": [1, float("inf")]}])
def test_what_is_no_number_is_not_read(message: object) -> None:
    assert reader("a.1")(message) is None


def test_settings_that_cannot_work_are_refused() -> None:
    for wrong in (lambda: Agreement(3, 2), lambda: Limits(1.0, 0.0), lambda: Manner(every=2.0, time_to_live=5.0)):
        with pytest.raises(ValueError, match=r".+"):
            wrong()
