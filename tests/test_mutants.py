"""Mutants of the package: `HOLDFAST_MUTANTS=100 python -m pytest -s tests/test_mutants.py` says which ones survive."""

from __future__ import annotations

import ast
import os
import random
from pathlib import Path

import pytest

from tests import mutation
from tests.removing import ROOT

SAMPLE = '''
class Door:
    def open(self, key: int = 1) -> bool:
        """Open it."""
        assert key != 7
        if key < 3 and self.locks:
            raise ValueError(key)
        self.wake()
        return bool(key)
'''


def test_each_fault_is_made_once_and_is_code() -> None:
    found = list(mutation.mutants("door.py", SAMPLE))
    assert {(one.line, one.what) for one in found} == {
        (6, "the condition is negated"), (6, "and, or are swapped"), (6, "Lt becomes LtE"), (6, "3 becomes 4"),
        (7, "the raise is dropped"), (8, "the call is dropped"), (9, "None is returned"),
    }  # fmt: skip
    original = ast.unparse(ast.parse(SAMPLE))
    assert len({one.text for one in found} | {original}) == len(found) + 1


def test_the_seed_says_which_ones_and_each_has_tests() -> None:
    first = mutation.drawn(7, 5)
    assert first == mutation.drawn(7, 5) != mutation.drawn(8, 5)
    for mutant in first:
        files = mutation.likely(mutant.file)
        assert files
        assert all((ROOT / file).exists() for file in files)
    assert mutation.likely("supervision/intensity.py")[0] == "tests/supervision/test_intensity.py"


@pytest.mark.skipif("HOLDFAST_MUTANTS" not in os.environ, reason="HOLDFAST_MUTANTS=n makes n mutants")
def test_most_mutants_are_seen(tmp_path: Path) -> None:
    """Some change nothing that anybody could see, so it is for a reader to judge those that are printed."""
    count = int(os.environ["HOLDFAST_MUTANTS"])
    seed = int(os.environ.get("HOLDFAST_SEED") or random.SystemRandom().randrange(2**32))
    survivors = mutation.hunt(seed, count)
    assert len(survivors) <= count // 2, f"seed {seed}: the tests do not see them"
