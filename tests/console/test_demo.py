"""The demo from end to end on a small log, with a real process that is really killed."""

import json
from pathlib import Path

from PIL import Image
from typer.testing import CliRunner

from holdfast.console.commands import commands


def run(log: Path, *options: str) -> tuple[int, dict[str, object]]:
    picture = log.with_name("maps.png")
    arguments = ["demo", "--log", str(log), "--picture", str(picture), "--speed", "0", "--json", *options]
    result = CliRunner().invoke(commands, arguments, catch_exceptions=False)
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
