"""Builds for the tests of packaging: of what git knows, in a folder of their own, by the build backend that is here."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def sources() -> list[str]:
    """The files of the repository as they are now, also new ones, by their paths in it; or of a source archive."""
    if not (ROOT / ".git").exists():
        return sorted((ROOT / "holdfast.egg-info/SOURCES.txt").read_text("utf-8").split("\n"))
    listing = ["git", "-c", "safe.directory=*", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(listing, cwd=ROOT, check=True, capture_output=True, text=True, timeout=60)
    return sorted(path for path in set(done.stdout.split("\0")) if path and (ROOT / path).is_file())


def copy_sources(target: Path) -> Path:
    """Copy the files of the repository, with their modes and without their times."""
    for path in filter(None, sources()):
        copy = target / path
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes((ROOT / path).read_bytes())
        copy.chmod((ROOT / path).stat().st_mode)
    return target


def build(source: Path, *options: str) -> list[Path]:
    """Build what the options say (`--wheel`, `--sdist`, `--outdir`), and return the files."""
    command = [sys.executable, "-m", "build", "--no-isolation", *options, str(source)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    outdir = Path(options[options.index("--outdir") + 1]) if "--outdir" in options else source / "dist"
    return sorted(outdir.iterdir())
