"""One rule says what becomes of a message at a full mailbox."""

from __future__ import annotations

from typing import Any, get_args

import pytest

import holdfast as hf
from holdfast.actors.overflow import DROPS, Overflow, check, decide


@pytest.mark.parametrize(
    ("overflow", "tell", "ask", "kept"),
    [
        ("block", "refuse", "wait", 5),
        ("reject", "refuse", "refuse", 5),
        ("drop_newest", "lose", "lose", 5),
        ("drop_oldest", "take", "take", 4),
        ("latest", "take", "take", 0),
    ],
)
def test_who_gives_way(overflow: Any, tell: str, ask: str, kept: int) -> None:
    assert decide(overflow, 5, is_ask=False) == (tell, kept)
    assert decide(overflow, 5, is_ask=True) == (ask, kept)


def test_every_policy_is_decided_and_those_that_drop_are_known() -> None:
    for overflow in get_args(Overflow):
        _, kept = decide(overflow, 3, is_ask=False)
        assert (kept < 3) == (overflow in DROPS)


@pytest.mark.parametrize(
    ("capacity", "overflow", "problem"),
    [(0, "block", "capacity"), (True, "block", "capacity"), (1.5, "block", "capacity"), (1, "fail", "overflow")],
)
def test_what_is_none_is_refused(capacity: Any, overflow: Any, problem: str) -> None:
    for choose in (hf.bounded, hf.checkpoint.held, lambda capacity, overflow: check("it", capacity, overflow)):
        with pytest.raises(hf.SpecError, match=f"{problem} must be"):
            choose(capacity, overflow=overflow)
