"""Build the source archive and, from it, the wheel, so that the same commit gives the same bytes anywhere, at any time.

Only files that git knows go in, as they are now. Times in the archives are that of the commit, or `SOURCE_DATE_EPOCH`
(seconds since 1970); owners, modes and order do not depend on who builds where.

Command: python .ci/build.py [FOLDER]    (`dist` if left out; it is emptied)
"""

from __future__ import annotations

import gzip
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GIT = ["git", "-C", str(ROOT), "-c", "safe.directory=*"]  # A clone made by another user is built as well.


def commit_time() -> int:
    """Return the time of the build in seconds since 1970: that of the commit, if the environment says no other."""
    told = os.environ.get("SOURCE_DATE_EPOCH")
    if told:
        return int(told)
    return int(subprocess.run([*GIT, "log", "-1", "--format=%ct"], check=True, capture_output=True).stdout)


def copy_tracked(target: Path) -> None:
    """Copy the files that git knows: what was built before, or lies about, must not be shipped."""
    listed = subprocess.run([*GIT, "ls-files", "-z"], check=True, capture_output=True, text=True).stdout
    for name in filter(None, listed.split("\0")):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, target / name)


def build(kind: str, source: Path, target: Path) -> Path:
    """Build one archive, `sdist` or `wheel`, with the backend that is installed."""
    command = [sys.executable, "-m", "build", "--no-isolation", f"--{kind}", "--outdir", str(target), str(source)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    [built] = target.iterdir()
    return built


def even_out(archive: Path, target: Path, seconds: int) -> None:
    """Write a source archive anew: sorted, with one time, and without owners and the builder's modes."""
    with (
        tarfile.open(archive) as old,
        target.open("wb") as file,
        gzip.GzipFile(fileobj=file, filename="", mode="wb", mtime=seconds) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as new,
    ):
        for member in sorted(old.getmembers(), key=lambda one: one.name):
            runs = member.isdir() or member.mode & 0o100
            even = member.replace(
                mtime=seconds, mode=0o755 if runs else 0o644, uid=0, gid=0, uname="", gname="", deep=False
            )
            even.pax_headers = {}
            new.addfile(even, old.extractfile(member) if member.isfile() else None)


def main(target: Path) -> None:
    """Build both archives into an empty folder."""
    seconds = commit_time()
    os.environ["SOURCE_DATE_EPOCH"] = str(seconds)  # The backend reads it for the wheel.
    os.umask(0o022)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        copy_tracked(folder / "tracked")
        made = build("sdist", folder / "tracked", folder / "sdist")
        archive = target / made.name
        even_out(made, archive, seconds)
        with tarfile.open(archive) as packed:
            packed.extractall(folder / "unpacked", filter="data")
        [source] = (folder / "unpacked").iterdir()
        shutil.copy(build("wheel", source, folder / "wheel"), target)
    for built in sorted(target.iterdir()):
        print(built)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "dist").resolve())
