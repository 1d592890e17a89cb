"""What is shipped: the same bytes from the same commit, the tests in the source archive, and none in the wheel."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.packaging.wheel import ROOT, copy_sources

BESIDE = ("tests/", "benchmarks/", "examples/", "docs/", ".ci/")
BUILDS = pytest.mark.skipif("HOLDFAST_BUILDS" not in os.environ, reason="set HOLDFAST_BUILDS=1; it takes a minute")
MADE = {"PKG-INFO", "setup.cfg"}
"""What the build adds to a source archive, with what it notes of itself in `holdfast.egg-info/`."""


def git(folder: Path, *command: str) -> None:
    who = ("-c", "user.name=tester", "-c", "user.email=tester@example.org", "-c", "safe.directory=*")
    subprocess.run(["git", "-C", str(folder), *who, *command], check=True, capture_output=True, timeout=60)


def build(clone: Path, **environment: str) -> dict[str, Path]:
    """Build both archives of a clone, and return them by the ends of their names."""
    command = [sys.executable, ".ci/build.py", "dist"]
    kept = {name: value for name, value in os.environ.items() if name != "SOURCE_DATE_EPOCH"}
    done = subprocess.run(
        command, cwd=clone, env={**kept, **environment}, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return {file.suffix: file for file in (clone / "dist").iterdir()}


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository with the files as they are now, committed."""
    folder = copy_sources(tmp_path_factory.mktemp("first") / "here")
    git(folder, "init", "-q")
    git(folder, "add", "-A", "-f")
    git(folder, "commit", "-q", "--no-verify", "-m", "All", "--date", "2020-02-02T02:02:02")
    return folder


@pytest.fixture(scope="module")
def built(clone: Path) -> dict[str, Path]:
    return build(clone)


@BUILDS
def test_the_source_archive_holds_every_file(clone: Path, built: dict[str, Path]) -> None:
    with tarfile.open(built[".gz"]) as archive:
        names = {one.name.partition("/")[2] for one in archive.getmembers() if one.isfile()}
        owners = {(one.uid, one.gid, one.uname, one.gname) for one in archive.getmembers()}
    listed = subprocess.run(["git", "-C", str(clone), "ls-files"], check=True, capture_output=True, text=True)
    assert {name for name in names if not name.startswith("holdfast.egg-info/")} - MADE == set(listed.stdout.split())
    assert owners == {(0, 0, "", "")}


@BUILDS
def test_the_wheel_holds_no_tests_and_no_local_path(clone: Path, built: dict[str, Path]) -> None:
    with zipfile.ZipFile(built[".whl"]) as archive:
        names = archive.namelist()
        told = [name for name in names if str(clone).encode() in archive.read(name)]
    assert "holdfast/py.typed" in names
    assert [name for name in names if name.removeprefix("holdfast/").startswith(BESIDE)] == []
    assert [name for name in names if "/test_" in name or "conftest" in name] == []
    assert told == []


@BUILDS
def test_two_builds_of_a_commit_are_the_same_bytes(clone: Path, built: dict[str, Path], tmp_path: Path) -> None:
    """Elsewhere, later, in another time zone, with another mask of modes, and with remains of other builds."""
    other = tmp_path / "a folder elsewhere"
    subprocess.run(["git", "clone", "-q", str(clone), str(other)], check=True, capture_output=True, timeout=60)
    (other / "build/lib/holdfast").mkdir(parents=True)
    (other / "build/lib/holdfast/deleted.py").write_text("raise SystemExit\n")
    (other / "tests/untracked.db").write_text("remains")
    for file in other.rglob("*.py"):
        file.chmod(0o600)
        os.utime(file, (1_000_000_000, 1_000_000_000))
    again = build(other, TZ="Pacific/Auckland", LANG="C", PYTHONHASHSEED="7")
    assert again.keys() == built.keys() == {".gz", ".whl"}
    for kind, file in built.items():
        assert file.name == again[kind].name
        assert file.read_bytes() == again[kind].read_bytes(), f"the two builds of {file.name} differ"


def test_the_makefile_builds_so() -> None:
    assert ".ci/build.py dist" in (ROOT / "Makefile").read_text("utf-8")
