"""`make fleet` in a short form: three servers and two nodes, of which the leading ones are really killed."""

import json
from pathlib import Path

from fleet import app
from typer.testing import CliRunner

SCANS = 60


def test_nothing_is_lost_though_the_leading_node_and_server_are_killed(small_log: Path) -> None:
    picture = small_log.with_name("maps.png")
    arguments = ["--log", str(small_log), "--picture", str(picture), "--speed", "30", "--kills", "2", "--json"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    found = json.loads(result.stdout)
    assert (result.exit_code, found["identical"]) == (0, True), found
    assert (found["kills"], found["scans"], found["differing_cells"]) == (2, SCANS, 0)
    asks = found["asks"]
    assert asks["sent"] == asks["answered"] > 0
    assert (asks["lost"], asks["doubled"]) == (0, 0)
