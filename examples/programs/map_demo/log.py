"""Laser logs in g2o text: one `ROBOTLASER1` line a scan, streamed, with errors that name file and line."""

from __future__ import annotations

import gzip
import importlib.util
import io
import math
import re
import zipfile
import zlib
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from holdfast import HoldfastError

SCAN = "ROBOTLASER1"
FIELDS_BEFORE_RANGES = 9  # tag type start fov step max_range accuracy remission_mode n
FIELDS_AFTER_RANGES = 14  # laser x y theta, robot x y theta, tv rv forward side turn, time, host, logger_time
FEWEST_FIELDS = {"VERTEX_SE2": 5, "EDGE_SE2": 12}
RECORD = re.compile(r"[A-Z][A-Z0-9_]*(:[A-Z0-9_]+)?$")


class LogError(HoldfastError):
    """A log cannot be used from this line on; line 0 is the file as a whole."""

    file: str
    line: int
    reason: str

    def __str__(self) -> str:
        where = f"{self.file}, line {self.line}" if self.line else self.file
        return f"{where}: {self.reason}"


class LogCutOff(LogError):
    """The log ends in the middle of a line; everything before that line is good."""


class _Malformed(ValueError):
    """What is wrong with one line; file and line number are added by the caller."""


@dataclass(frozen=True)
class LaserScan:
    """One sweep of the laser.

    Attributes:
        time: Unix time of the recording, seconds.
        x: position of the laser in the world, metres; so is `y`.
        heading: direction of the laser, radians, counter-clockwise from the x axis.
        start: direction of the first beam, radians from the heading.
        step: angle from one beam to the next, radians.
        max_range: ranges from here on mean "nothing came back", metres.
        ranges: distances in metres, float32, shape (n_beams,).
    """

    time: float
    x: float
    y: float
    heading: float
    start: float
    step: float
    max_range: float
    ranges: NDArray[np.float32]


@dataclass(frozen=True)
class Survey:
    """What a first pass over a log found: how much there is, where it is, and what is wrong with it.

    `problem` is None for a good log; scans before the problem count all the same.
    """

    scans: int
    x_min: float
    y_min: float
    x_max: float
    y_max: float
    start: tuple[float, float]
    farthest: tuple[float, float]
    first_time: float
    last_time: float
    problem: LogError | None


def killian_court() -> Path:
    """Find the MIT Killian Court log of the PyPI package `rtb-data`; it is used where it lies.

    Raises:
        LogError: the package is not installed.
    """
    found = importlib.util.find_spec("rtbdata")
    for folder in found.submodule_search_locations or () if found else ():
        path = Path(folder) / "data" / "killian.g2o.zip"
        if path.is_file():
            return path
    raise LogError("killian.g2o.zip", 0, "not found: pip install 'holdfast[demo]', or name a log with --log FILE")


def read_scans(path: Path) -> Iterator[LaserScan]:
    """Yield the scans of a log (g2o text, or .zip or .gz of it) in file order, in constant memory.

    Raises:
        LogCutOff: after the last whole line, if the log ends in the middle of one.
        LogError: the file is missing, is no such log, or a line cannot be read.
    """
    last = 0
    try:
        with _open_text(path) as lines:
            for last, line in enumerate(lines, start=1):
                scan = _read_line(line, str(path), last)
                if scan is not None:
                    yield scan
    except EOFError:  # gzip's way to say that its end is missing
        raise LogCutOff(str(path), last + 1, "the compressed file is cut off here") from None
    except UnicodeDecodeError:
        raise LogError(str(path), last + 1, "not text; a g2o log, or .zip or .gz of one, is expected") from None
    except (OSError, zipfile.BadZipFile, zlib.error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise LogError(str(path), last, reason) from None


def survey(path: Path) -> Survey:
    """Read a log once, without keeping it, for its size, its extent and its first problem.

    Raises:
        LogError: there is not one scan to use.
    """
    problem: LogError | None = None
    poses: list[tuple[float, float, float]] = []
    try:
        poses.extend((scan.x, scan.y, scan.time) for scan in read_scans(path))
    except LogError as error:
        problem = error
    if not poses:
        raise problem or LogError(str(path), 0, f"no {SCAN} line in it: not a laser log")
    return _summary(np.array(poses), problem)


def parse_scan(fields: list[str]) -> LaserScan:
    """Build a scan from the fields of a `ROBOTLASER1` line.

    Raises:
        ValueError: saying which field is missing or wrong.
    """
    beams = _count(fields, FIELDS_BEFORE_RANGES - 1, "number of ranges", least=1)
    after = FIELDS_BEFORE_RANGES + beams
    remissions = _count(fields, after, "number of remissions", least=0)
    pose = after + 1 + remissions
    if len(fields) < pose + FIELDS_AFTER_RANGES:
        raise _Malformed(f"{len(fields)} fields, expected {pose + FIELDS_AFTER_RANGES} for {beams} ranges")
    start, _, step, max_range = _floats(fields, 2, 6)
    x, y, heading = _floats(fields, pose, pose + 3)
    (time,) = _floats(fields, pose + 11, pose + 12)
    ranges = np.array(_floats(fields, FIELDS_BEFORE_RANGES, after, finite=False), dtype=np.float32)
    return LaserScan(time, x, y, heading, start, step, max_range, ranges)


def _summary(poses: NDArray[np.float64], problem: LogError | None) -> Survey:
    low, high = poses.min(axis=0), poses.max(axis=0)
    away = np.hypot(poses[:, 0] - poses[0, 0], poses[:, 1] - poses[0, 1])
    far = poses[int(away.argmax())]
    return Survey(
        scans=len(poses),
        x_min=float(low[0]),
        y_min=float(low[1]),
        x_max=float(high[0]),
        y_max=float(high[1]),
        start=(float(poses[0, 0]), float(poses[0, 1])),
        farthest=(float(far[0]), float(far[1])),
        first_time=float(low[2]),
        last_time=float(high[2]),
        problem=problem,
    )


@contextmanager
def _open_text(path: Path) -> Generator[Iterable[str], None, None]:
    """Open a log as lines that keep their line ends: the last one shows by it whether it is whole."""
    if path.suffix == ".gz":
        with gzip.open(path, "rt", encoding="utf-8", newline="\n") as lines:
            yield lines
    elif path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive, archive.open(_member(archive, path)) as raw:
            yield io.TextIOWrapper(raw, encoding="utf-8", newline="\n")
    else:
        with path.open(encoding="utf-8", newline="\n") as lines:
            yield lines


def _member(archive: zipfile.ZipFile, path: Path) -> str:
    names = [n for n in archive.namelist() if n.endswith(".g2o") and not n.startswith("__MACOSX/")]
    if len(names) != 1:
        raise LogError(str(path), 0, f"one .g2o file is expected in the archive, found {len(names)}")
    return names[0]


def _read_line(line: str, file: str, number: int) -> LaserScan | None:
    try:
        return _parse_line(line.split())
    except ValueError as error:
        if line.endswith("\n"):
            raise LogError(file, number, str(error)) from None
        raise LogCutOff(file, number, f"the log is cut off in this line ({error})") from None


def _parse_line(fields: list[str]) -> LaserScan | None:
    if not fields or fields[0].startswith("#"):
        return None
    if fields[0] == SCAN:
        return parse_scan(fields)
    if not RECORD.match(fields[0]):
        raise _Malformed(f"neither a g2o record nor a comment: {fields[0][:40]!r}")
    if len(fields) < FEWEST_FIELDS.get(fields[0], 0):
        raise _Malformed(f"{len(fields)} fields, expected {FEWEST_FIELDS[fields[0]]} in {fields[0]}")
    return None


def _count(fields: list[str], index: int, what: str, *, least: int) -> int:
    if index >= len(fields):
        raise _Malformed(f"the {what} is missing")
    try:
        count = int(fields[index])
    except ValueError:
        count = least - 1
    if count < least:
        raise _Malformed(f"field {index + 1}: {fields[index][:40]!r} is no {what}")
    return count


def _floats(fields: list[str], first: int, end: int, *, finite: bool = True) -> list[float]:
    try:
        values = [float(field) for field in fields[first:end]]
    except ValueError:
        values = []
    if len(values) == end - first and (not finite or all(map(math.isfinite, values))):
        return values
    wrong = next(i for i in range(first, end) if not _is_number(fields[i], finite=finite))
    raise _Malformed(f"field {wrong + 1}: {fields[wrong][:40]!r} is not a {'finite ' if finite else ''}number")


def _is_number(field: str, *, finite: bool) -> bool:
    try:
        return math.isfinite(float(field)) or not finite
    except ValueError:
        return False
