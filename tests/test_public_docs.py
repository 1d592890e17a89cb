"""Public names are documented: by docstrings that can be read alone (`public_docs.py`), and by code that runs."""

import ast
import doctest
from types import ModuleType

import pytest

import holdfast as hf
from tests import public_docs, used_names
from tests.public_docs import offenders, problem, public_docstrings
from tests.used_names import imported, unused, used


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


@pytest.mark.parametrize("module", [public_docs, used_names], ids=lambda module: module.__name__)
def test_the_examples_of_the_rules(module: ModuleType) -> None:
    assert doctest.testmod(module).failed == 0


def test_every_public_name_is_used_in_code_that_runs() -> None:
    """In a block of a document that is no quotation, in `examples/`, or in a docstring example."""
    assert sorted(unused()) == [], "show how it is used, in the page that explains it"


@pytest.mark.parametrize(
    ("text", "is_used"),
    [
        ("import holdfast as hf\nhf.errors.StoreError", True),
        ("from holdfast.errors import StoreError as Bad\ntry: ...\nexcept Bad: ...", True),
        ("from holdfast import errors\ndef f(no: errors.StoreError): ...", True),
        ("from holdfast.errors import StoreError", False),
        ("import holdfast as hf\nprint('hf.errors.StoreError')", False),
        ("class StoreError(Exception): ...\nraise StoreError", False),
    ],
)
def test_what_counts_as_a_use(text: str, is_used: bool) -> None:
    tree = ast.parse(text)
    assert (hf.errors.StoreError in list(used(tree, imported(tree)))) is is_used
