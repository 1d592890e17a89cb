"""Safety checks taken out of a copy of the package, one at a time: somebody has to miss each of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

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
