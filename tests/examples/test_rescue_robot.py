"""The paper's robot, with real processes and a board on a real connection: what is diagnosed, planned and done."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

PROGRAM = Path(__file__).parents[2] / "examples" / "rescue_robot.py"
TOPICS = ("/odom", "/map", "/scan", "/imu_data", "/cmd_vel")


def told(scenario: str, *options: str) -> dict[str, Any]:
    command = [sys.executable, str(PROGRAM), scenario, "--json", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    assert done.returncode == 0, done.stderr
    (one,) = json.loads(done.stdout)
    return one


def of(one: dict[str, Any], kind: str) -> list[Any]:
    return [line["what"] for line in one["lines"] if line["kind"] == kind]


def bad(one: dict[str, Any]) -> list[list[set[str]]]:
    """The candidates of each diagnosis."""
    return [[set(candidate["bad"]) for candidate in candidates] for candidates in of(one, "diagnosed")]


def in_the_end(one: dict[str, Any]) -> set[str]:
    last = {what.removeprefix("not "): what for what in of(one, "observed")}
    return set(last.values())


def test_power_up(tmp_path: Path) -> None:
    # D52, D53, D57, D58
    one = told("power-up", "--png", str(tmp_path))
    eleven = {"ja", "hu", "la", "lan", "lac", "hm", "jn", "hn", "in", "jtn", "jyn"}
    (first,) = of(one, "diagnosed")[0]
    assert set(first["bad"]) == eleven
    assert set(first["good"]) == {"js", "imu", "rviz"}  # of which the paper says nothing
    nodes = sorted(["lan", "hn", "hm", "jtn", "jn", "lac", "in", "jyn"])  # the paper's seven, and jyn
    plan = [["power_up(hu)", "power_up(ja)", "power_up(la)"], [f"start_node({node})" for node in nodes]]
    assert of(one, "planned") == [plan]
    assert sorted(of(one, "began")) == sorted(of(one, "done")) == sorted(plan[0] + plan[1])
    assert not of(one, "gave up")
    assert {f"ok({topic})" for topic in TOPICS} <= in_the_end(one)
    assert bad(one)[-1] == [set()]
    assert (tmp_path / "power-up.png").read_bytes().startswith(b"\x89PNG")


def test_device_shut_down() -> None:
    # D54, O3
    one = told("shut-down")
    assert bad(one)[0] == [set()]
    assert [{"ja"}] in bad(one)
    assert [{"jn"}, {"ja"}] in bad(one)  # alike, and the one that was just repaired comes last
    assert of(one, "planned") == [[["power_up(ja)"]], [["stop_node(jn)"], ["start_node(jn)"]]]
    assert of(one, "done") == ["power_up(ja)", "stop_node(jn)", "start_node(jn)"]
    assert of(one, "repaired") == [["power_up(ja)", "stop_node(jn)", "start_node(jn)"]]
    assert {f"ok({topic})" for topic in TOPICS} <= in_the_end(one)
    assert bad(one)[-1] == [set()]
