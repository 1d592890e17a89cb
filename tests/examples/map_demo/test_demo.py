"""The demo from end to end on a small log, with a real process that is really killed."""

import json
from pathlib import Path

import pytest
from demo import app
from PIL import Image
from typer.testing import CliRunner, Result

UNUSABLE = 2


def demo(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


def run(log: Path, *options: str) -> tuple[int, dict[str, object]]:
    picture = log.with_name("maps.png")
    arguments = ["--log", str(log), "--picture", str(picture), "--speed", "0", "--json", *options]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    with Image.open(picture) as image:
        assert image.format == "PNG"
    return result.exit_code, json.loads(result.stdout)


def test_nothing_is_lost_and_the_maps_are_equal(small_log: Path) -> None:
    status, found = run(small_log, "--kills", "2")
    assert status == 0
    assert found["identical"] is True
    assert (found["kills"], found["scans"], found["differing_cells"]) == (2, 60, 0)
    asks = found["asks"]
    assert isinstance(asks, dict)
    assert asks["sent"] == asks["answered"] > 0
    assert (asks["lost"], asks["doubled"]) == (0, 0)


def test_without_recovery_the_map_is_lost(small_log: Path) -> None:
    status, found = run(small_log, "--kills", "1", "--method", "fresh")
    assert status == 1
    assert found["identical"] is False


def test_without_kills_nothing_differs(small_log: Path) -> None:
    status, found = run(small_log, "--kills", "0", "--method", "fresh")
    assert (status, found["identical"], found["recovery_ms"]) == (0, True, {})


def test_a_cut_off_log_is_used_as_far_as_it_goes(small_log: Path) -> None:
    small_log.write_text(small_log.read_text()[:-40])
    status, found = run(small_log, "--kills", "1")
    assert (status, found["scans"]) == (0, 59)
    assert "line 61: the log is cut off in this line" in str(found["problem"])


def test_a_bad_line_ends_the_reading_and_nothing_else(small_log: Path) -> None:
    lines = small_log.read_text().splitlines(keepends=True)
    lines[40] = lines[40].replace(" 50.0 ", " fifty ")
    small_log.write_text("".join(lines))
    status, found = run(small_log, "--kills", "1")
    assert (status, found["scans"], found["identical"]) == (1, 39, True)
    assert f"{small_log}, line 41: field 6: 'fifty' is not a finite number" in str(found["problem"])


def test_no_such_log(tmp_path: Path) -> None:
    result = demo("--log", str(tmp_path / "gone.g2o"))
    assert result.exit_code == UNUSABLE
    assert f"{tmp_path / 'gone.g2o'}: No such file" in result.stderr


def test_a_log_of_another_format_is_named_with_its_line(tmp_path: Path) -> None:
    log = tmp_path / "a.csv"
    log.write_text("# time and range\n1.0,2.0\n")
    result = demo("--log", str(log))
    assert result.exit_code == UNUSABLE
    assert f"{log}, line 2: neither a g2o record nor a comment" in result.stderr


def test_no_folder_for_the_picture(tmp_path: Path, small_log: Path) -> None:
    result = demo("--log", str(small_log), "--picture", str(tmp_path / "gone" / "maps.png"))
    assert result.exit_code == UNUSABLE
    assert "there is no folder" in result.stderr


@pytest.mark.parametrize("option", [("--kills", "-1"), ("--method", "prayer"), ("--speed", "-2"), ("--interval", "0")])
def test_an_option_out_of_range_is_refused(option: tuple[str, str]) -> None:
    result = demo(*option)
    assert result.exit_code == UNUSABLE
    assert option[0] in result.stderr
