"""The conformance suite is judged by engines that are each broken in one way: it finds every one of them.

`HOLDFAST_CROSSED=1` judges by all of them; else those do that have been missed once, and every sixth of the others.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from tests.checkpoint.one_file import OneFile
from tests.testing.stores.judge import ALWAYS, MODULES, broken, first_broken_promise

ALL = [engine for module in MODULES.values() for engine in broken(module)]
OTHERS = [engine for engine in ALL if engine not in ALWAYS]
JUDGED = ALL if "HOLDFAST_CROSSED" in os.environ else [*ALWAYS, *OTHERS[::6]]
DOCUMENT = Path(__file__).parents[3] / "docs" / "recovery" / "durability.md"


def test_the_engine_they_are_made_of_keeps_every_promise(tmp_path: Path) -> None:
    assert first_broken_promise(lambda folder: OneFile(folder / "my.store"), tmp_path) == ""


@pytest.mark.some(15)
@pytest.mark.parametrize("engine", JUDGED, ids=lambda engine: engine.__name__)
def test_a_broken_engine_is_found(engine: type[OneFile], tmp_path: Path) -> None:
    found = first_broken_promise(lambda folder: engine(folder / "my.store"), tmp_path)
    print(f"{engine.__name__}: {found[:1000]}")  # shown with -s
    assert found, f"nobody sees that it {(engine.__doc__ or '')[:1].lower()}{(engine.__doc__ or '')[1:]}"


def test_the_document_counts_them() -> None:
    rows = dict(re.findall(r"^\| ([a-z, ]+) \| (\d+) \| all \|", DOCUMENT.read_text("utf-8"), re.MULTILINE))
    counted = {what: str(len(broken(module))) for what, module in MODULES.items()}
    assert {what: rows.get(what) for what in MODULES} == counted
    assert f"{len(ALL)} engines" in DOCUMENT.read_text("utf-8")
