"""Docstrings of public names can be read alone and say more than the names do, by the rules of `public_docs.py`."""

import doctest

import pytest

from tests import public_docs
from tests.public_docs import offenders, problem, public_docstrings


def test_no_public_docstring_offends() -> None:
    assert len(list(public_docstrings())) > 600
    assert offenders() == []


@pytest.mark.parametrize(
    ("name", "text", "wrong"),
    [
        ("Timer.cancel", None, "is missing"),
        ("Timer.cancel", "It is over: nothing comes any more.", "begins with a pronoun"),
        ("Timer.cancel", "Its message does not come any more.", "begins with a pronoun"),
        ("Timer.cancel", "What is done at the end of a timer.", "begins with a pronoun"),
        ("Timer.is_active", "Whether the message of the timer may still come.", "is no whole sentence"),
        ("Timer.cancel", "Cancel the timer.", "says less than the name"),
        ("StashError", "A stash error.\n\nRaised by `stash` when it is full.", "says less than the name"),
        ("Timer.cancel", "Cancel the timer, so that no message comes any more.", ""),
        ("Timer.is_active", "Say whether the message of the timer may still come.", ""),
    ],
)
def test_what_offends(name: str, text: str | None, wrong: str) -> None:
    assert problem(name, text) == wrong


def test_the_examples_of_the_rules() -> None:
    assert doctest.testmod(public_docs).failed == 0
