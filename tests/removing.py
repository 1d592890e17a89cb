"""Safety checks taken out of a copy of the package, one at a time: somebody has to miss each of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

import holdfast

ROOT = Path(holdfast.__file__).parent
NEVER_COPIED = (".*", "__pycache__", "build", "dist", "*.egg-info")


class Check(NamedTuple):
    """A check, what the code is without it, and who misses it."""

    file: str
    there: str
    gone: str
    test: str
    select: str


def is_true(check: Check) -> bool:
    """Whether the check, and the test that misses it, are where the table says."""
    first = check.select.partition(" ")[0]
    return (ROOT / check.file).read_text().count(check.there) == 1 and first in (ROOT / check.test).read_text()


def copied(folder: Path) -> Path:
    """The package and its tests, to be broken."""
    copy = folder / "holdfast"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*NEVER_COPIED))
    (copy / ".link").mkdir()
    (copy / ".link" / "holdfast").symlink_to("..")
    return copy


@contextmanager
def without(copy: Path, check: Check) -> Generator[None]:
    """In this block the check is not there."""
    file = copy / check.file
    whole = file.read_text()
    file.write_text(whole.replace(check.there, check.gone))
    try:
        yield
    finally:
        file.write_text(whole)


def missed(copy: Path, check: Check) -> str:
    """What the test says; "" if it does not fail."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist"]
    done = subprocess.run(
        [*command, check.test, "-k", check.select],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy / ".link"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    return done.stdout if done.returncode == 1 and " failed" in done.stdout else ""


Test = Callable[..., None]


def as_tests(checks: dict[str, Check]) -> tuple[Test, Test]:
    """The tests of a table: that it says what there is; and, if that is wanted, that each check is missed."""
    copies: list[Path] = []

    @pytest.mark.parametrize("name", checks)
    def table_is_true(name: str) -> None:
        assert is_true(checks[name])

    @pytest.mark.skipif("HOLDFAST_REMOVED" not in os.environ, reason="HOLDFAST_REMOVED=1 has the checks removed")
    @pytest.mark.parametrize("name", checks)
    def a_test_fails(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
        if not copies:
            copies.append(copied(tmp_path_factory.mktemp("removed")))
        with without(copies[0], checks[name]):
            assert missed(copies[0], checks[name]), f"{checks[name].test} does not miss it"

    return table_is_true, a_test_fails
