"""`holdfast demo`: a bank under SIGKILL, and what it says when payments are lost."""

import re
from collections import Counter

import pytest
from typer.testing import CliRunner

from holdfast.console.bank_demo import BankReport, judge, longest_silences
from holdfast.console.commands import commands


def run(*options: str) -> tuple[int, str, dict[str, int]]:
    """Its exit status, all that it prints, and the figures of its summary."""
    result = CliRunner().invoke(commands, ["demo", *options], catch_exceptions=False)
    rows = re.findall(r"│ ([a-z ]+?) +│ +([0-9,]+)(?: ms)? │", result.stdout)
    return result.exit_code, result.stdout, {name: int(value.replace(",", "")) for name, value in rows}


def test_nothing_is_lost_and_nothing_is_doubled() -> None:
    status, said, found = run("--seconds", "1")
    assert status == 0, said
    assert "Nothing was lost, nothing was doubled." in said
    assert found["asks"] == found["answered"] > 0
    assert (found["lost"], found["doubled"]) == (0, 0)
    assert found["kills"] == said.count("SIGKILL to process") > 0
    assert found["longest gap"] >= found["median gap"] > 0


def test_without_recovery_payments_are_lost() -> None:
    status, said, found = run("--seconds", "0.5", "--method", "fresh")
    assert status == 1
    assert "Payments were lost or doubled." in said
    assert found["lost"] > 0


@pytest.mark.parametrize(
    ("receipts", "booked", "lost", "doubled"),
    [
        ([1, 2, 3], [3, 1, 2], 0, 0),
        ([1, 2], [1, 2, 3], 1, 0),  # no receipt
        ([1, 2, 3], [1, 2], 1, 0),  # a receipt for what is forgotten
        ([1, 2, 3], [1, 2, 2, 3], 0, 1),
        ([1, 2, 3, 3], [1, 2, 3], 0, 1),
        ([1, 2, 2], [1, 2, 3], 1, 1),  # a receipt that went to the wrong customer
    ],
)
def test_every_payment_has_one_receipt_and_one_entry(
    receipts: list[int], booked: list[int], lost: int, doubled: int
) -> None:
    assert judge(3, Counter(receipts), booked) == (lost, doubled)


def test_a_report_is_good_if_every_payment_was_answered_once() -> None:
    assert BankReport(3, 3, 0, 0, []).is_good
    assert not BankReport(3, 2, 1, 0, []).is_good
    assert not BankReport(3, 3, 0, 1, []).is_good
    assert not BankReport(3, 4, 0, 0, []).is_good


def test_a_silence_belongs_to_each_kill_within_it() -> None:
    assert longest_silences([1.0, 1.5], [0.5, 2.5, 2.75]) == [2.0, 2.0]
    assert longest_silences([1.0], []) == [0.0]
    assert longest_silences([], [1.0, 2.0]) == []
