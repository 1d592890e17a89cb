"""The log parser: the real log, logs that are cut off, and lines that are wrong."""

import gzip
import importlib.util
import zipfile
from pathlib import Path

import numpy as np
import pytest
from map_demo.log import LogCutOff, LogError, killian_court, read_scans, survey

AFTER_REMISSIONS = "{x} 2.0 0.5 {x} 2.0 0.5 0 0 0 0 0 {time} host 12.5"


def scan_line(x: float = 1.0, time: float = 100.0, ranges: str = "1.5 2.5 81.0") -> str:
    beams = len(ranges.split())
    return f"ROBOTLASER1 0 -1.5 3.0 1.5 80.0 0.1 0 {beams} {ranges} 0 " + AFTER_REMISSIONS.format(x=x, time=time)


def log_text(scans: int = 3) -> str:
    lines = ["# a log", "VERTEX_SE2 0 1 2 0.5", *(scan_line(x=float(n), time=100.0 + n) for n in range(scans))]
    return "\n".join(lines) + "\n"


def write(folder: Path, text: str, name: str = "log.g2o") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_scan_has_its_fields_and_units(tmp_path: Path) -> None:
    (scan,) = read_scans(write(tmp_path, scan_line() + "\n"))
    assert (scan.x, scan.y, scan.heading, scan.time) == (1.0, 2.0, 0.5, 100.0)
    assert (scan.start, scan.step, scan.max_range) == (-1.5, 1.5, 80.0)
    assert scan.ranges.dtype == np.float32
    assert scan.ranges.tolist() == [1.5, 2.5, 81.0]


def test_remissions_are_skipped(tmp_path: Path) -> None:
    line = "ROBOTLASER1 0 -1.5 3.0 1.5 80.0 0.1 0 2 1.0 2.0 2 7 8 " + AFTER_REMISSIONS.format(x=3.5, time=9.0)
    (scan,) = read_scans(write(tmp_path, line + "\n"))
    assert (scan.x, scan.time, scan.ranges.tolist()) == (3.5, 9.0, [1.0, 2.0])


def test_a_range_that_is_no_number_of_metres_means_nothing_came_back(tmp_path: Path) -> None:
    (scan,) = read_scans(write(tmp_path, scan_line(ranges="inf nan 1.0") + "\n"))
    assert np.isinf(scan.ranges[0])
    assert np.isnan(scan.ranges[1])


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_text_gz_and_zip_give_the_same_scans(tmp_path: Path, ending: str) -> None:
    raw = log_text().replace("\n", ending).encode()
    (tmp_path / "a.g2o").write_bytes(raw)
    (tmp_path / "a.g2o.gz").write_bytes(gzip.compress(raw))
    with zipfile.ZipFile(tmp_path / "a.g2o.zip", "w") as archive:
        archive.writestr("a.g2o", raw)
        archive.writestr("__MACOSX/._a.g2o", b"\x00\x01")
    found = [[scan.x for scan in read_scans(tmp_path / name)] for name in ("a.g2o", "a.g2o.gz", "a.g2o.zip")]
    assert found == [[0.0, 1.0, 2.0]] * 3


def test_the_real_log() -> None:
    if importlib.util.find_spec("rtbdata") is None:
        pytest.skip("rtb-data is not installed")
    found = survey(killian_court())
    assert found.scans == 3873
    assert found.problem is None
    assert (round(found.x_min, 2), round(found.y_max, 2)) == (-63.77, 209.84)
    assert len(next(iter(read_scans(killian_court()))).ranges) == 180


@pytest.mark.parametrize("kept", [20, 40, -30, -8])
def test_a_cut_off_last_line_keeps_what_is_before(tmp_path: Path, kept: int) -> None:
    whole = log_text()
    last = whole.rstrip("\n").rpartition("\n")[2]
    path = write(tmp_path, whole[: -len(last) - 1] + last[:kept])
    found = survey(path)
    assert found.scans == 2
    assert isinstance(found.problem, LogCutOff)
    assert found.problem.line == 5
    assert str(path) in str(found.problem)
    assert "line 5" in str(found.problem)


def test_a_whole_last_line_needs_no_line_end(tmp_path: Path) -> None:
    found = survey(write(tmp_path, log_text().rstrip("\n")))
    assert (found.scans, found.problem) == (3, None)


def test_a_cut_off_gz_keeps_what_is_before(tmp_path: Path) -> None:
    raw = gzip.compress("".join(scan_line(x=n / 7, time=n * 1.7) + "\n" for n in range(2000)).encode())
    (tmp_path / "a.gz").write_bytes(raw[: len(raw) // 2])
    found = survey(tmp_path / "a.gz")
    assert 100 < found.scans < 2000
    assert isinstance(found.problem, LogCutOff)
    assert found.problem.line in (found.scans + 1, found.scans + 2)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("ROBOTLASER1 0 -1.5", "number of ranges is missing"),
        ("ROBOTLASER1 0 -1.5 3 1.5 80 0.1 0 many 1 2", "'many' is no number of ranges"),
        ("ROBOTLASER1 0 -1.5 3 1.5 80 0.1 0 0 0 " + AFTER_REMISSIONS, "'0' is no number of ranges"),
        ("ROBOTLASER1 0 -1.5 3 1.5 80 0.1 0 2 1 2", "number of remissions is missing"),
        (scan_line().replace("2.5", "2,5"), "field 11: '2,5' is not a number"),
        (scan_line().replace("2.0 0.5", "nan 0.5"), "field 15: 'nan' is not a finite number"),
        (scan_line().removesuffix(" host 12.5"), "25 fields, expected 27 for 3 ranges"),
        ("EDGE_SE2 0 1 0.5", "4 fields, expected 12 in EDGE_SE2"),
        ("hello world", "neither a g2o record nor a comment: 'hello'"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, reason: str) -> None:
    path = write(tmp_path, f"{scan_line()}\n{line}\n{scan_line()}\n")
    found = survey(path)
    assert found.scans == 1
    assert found.problem is not None
    assert not isinstance(found.problem, LogCutOff)
    assert str(found.problem).startswith(f"{path}, line 2: ")
    assert reason in str(found.problem)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"gone\.g2o: No such file"):
        survey(tmp_path / "gone.g2o")


def test_a_folder_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="directory"):
        survey(tmp_path)


def test_bytes_are_no_log(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_bytes(b"\x89PNG\r\n\xff\xfe\n")
    with pytest.raises(LogError, match="not text"):
        survey(path)


def test_a_file_that_only_calls_itself_zip_or_gz(tmp_path: Path) -> None:
    for name in ("a.zip", "a.gz"):
        with pytest.raises(LogError, match=name):
            survey(write(tmp_path, log_text(), name))


def test_an_archive_without_a_log(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(LogError, match=r"one \.g2o file is expected in the archive, found 0"):
        survey(tmp_path / "a.zip")


@pytest.mark.parametrize("text", ["", "# nothing\n", "VERTEX_SE2 0 1 2 0.5\n"])
def test_a_log_without_a_scan(tmp_path: Path, text: str) -> None:
    with pytest.raises(LogError, match="no ROBOTLASER1 line in it"):
        survey(write(tmp_path, text))


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def find_nothing(name: str) -> None:
        return None

    monkeypatch.setattr("importlib.util.find_spec", find_nothing)
    with pytest.raises(LogError, match=r"pip install 'holdfast\[demo\]'"):
        killian_court()
