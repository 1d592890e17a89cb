"""Recovery methods: what is refused when a spec is built, with the words to mend it (DESIGN 6)."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

import holdfast as hf


class Steady(hf.Actor): ...


class Gambler(hf.Actor):
    deterministic = False


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"interval": 0}, "interval must be a finite number of seconds > 0, not 0"),
        ({"interval": -1.0}, "interval must be a finite number of seconds > 0"),
        ({"interval": float("nan")}, "interval must be a finite number of seconds > 0"),
        ({"interval": float("inf")}, "interval must be a finite number of seconds > 0"),
        ({"interval": True}, "interval must be a finite number of seconds > 0"),
        ({"interval": "2"}, "interval must be a finite number of seconds > 0, not '2'"),
        ({"pacing": "slow"}, "pacing must be 'fast', 'original' or a factor > 0, not 'slow'"),
        ({"max_deliveries": 0}, "max_deliveries must be a whole number >= 1, not 0"),
        ({"max_deliveries": True}, "max_deliveries must be a whole number >= 1"),
        ({"max_deliveries": 2.5}, "max_deliveries must be a whole number >= 1"),
        ({"journal_limit": 0}, "journal_limit must be bytes > 0, not 0"),
        ({"journal_limit": "1 MB"}, "journal_limit must be bytes > 0, not '1 MB'"),
        ({"journal_limit": True}, "journal_limit must be bytes > 0"),
    ],
)
def test_bad_options_are_refused_by_name(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(hf.SpecError, match=problem):
        hf.hybrid(**options)


def test_what_replays_is_refused_for_a_class_that_is_not_deterministic() -> None:
    with pytest.raises(hf.SpecError, match=r"child 'x'.*Gambler is not deterministic, so hybrid cannot replay"):
        hf.child("x", hf.start(Gambler), recovery=hf.hybrid())


@pytest.mark.parametrize("recovery", [None, hf.fresh()])
def test_a_class_that_is_not_deterministic_may_start_afresh(recovery: Any) -> None:
    assert hf.child("x", hf.start(Gambler), recovery=recovery).start.kind is Gambler


@pytest.mark.parametrize("recovery", ["hybrid", 2.0, hf.hybrid])
def test_what_is_no_method_is_refused(recovery: Any) -> None:
    with pytest.raises(hf.SpecError, match="recovery must be a method"):
        hf.child("x", hf.start(Steady), recovery=recovery)


def test_a_method_is_a_frozen_value() -> None:
    assert hf.hybrid(1) == hf.hybrid(interval=1.0) != hf.hybrid(2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        hf.hybrid().interval = 3.0  # type: ignore[misc]
    assert not hf.fresh().records
    assert hf.hybrid().records
