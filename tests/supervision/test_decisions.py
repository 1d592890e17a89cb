"""What a supervisor decides (otp.md 1.3, 1.4), as tables."""

import pytest

import holdfast as hf
from holdfast.supervision.decisions import affected, is_restarted
from holdfast.supervision.spec import Restart, Strategy

CLEAN: list[hf.ExitReason] = [hf.NORMAL, hf.SHUTDOWN, hf.Shutdown("its work is done")]
ABNORMAL: list[hf.ExitReason] = [
    hf.KILLED,
    hf.NOPROC,
    hf.Crash("ValueError", "no"),
    hf.Signal(9),
    hf.ForkServerDied(1, "SIGKILL"),
    hf.Exited(0),
    hf.OutOfMemory(),
    hf.Hung(3.0),
    hf.TrustBreach("a message of somebody else"),
]


@pytest.mark.parametrize("reason", CLEAN, ids=repr)
def test_after_a_clean_end_only_a_permanent_child_is_restarted(reason: hf.ExitReason) -> None:
    kinds: tuple[Restart, ...] = ("permanent", "transient", "temporary")
    assert [kind for kind in kinds if is_restarted(kind, reason)] == ["permanent"]


@pytest.mark.parametrize("reason", ABNORMAL, ids=repr)
def test_after_an_abnormal_end_all_but_temporary_children_are(reason: hf.ExitReason) -> None:
    kinds: tuple[Restart, ...] = ("permanent", "transient", "temporary")
    assert [kind for kind in kinds if is_restarted(kind, reason)] == ["permanent", "transient"]


@pytest.mark.parametrize(
    ("strategy", "failed", "expected"),
    [
        ("one_for_one", 0, "a"),
        ("one_for_one", 2, "c"),
        ("one_for_all", 0, "abcd"),
        ("one_for_all", 3, "abcd"),
        ("rest_for_one", 0, "abcd"),
        ("rest_for_one", 2, "cd"),
        ("rest_for_one", 3, "d"),
    ],
)
def test_who_is_started_again_and_in_which_order(strategy: Strategy, failed: int, expected: str) -> None:
    assert affected(strategy, "abcd", failed) == list(expected)
