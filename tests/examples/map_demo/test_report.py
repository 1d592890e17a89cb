"""The verdict: what counts as lost, as doubled, as different."""

import json
from dataclasses import replace

import numpy as np
from map_demo.grid import Geometry, OccupancyGrid
from map_demo.report import (
    Asks,
    DemoReport,
    MapperKill,
    MapperRecovery,
    RunOutcome,
    as_json,
    as_lines,
    judge_asks,
    recovery_ms,
)

PLACE = Geometry(1.0, 0.0, 0.0, 4, 3)
GOOD = RunOutcome(OccupancyGrid(PLACE), scans=9, gaps=0, asks=Asks(5, 5, 0, 0), seconds=1.0)
REPORT = DemoReport(
    GOOD, replace(GOOD, kills=[MapperKill(42, 3)], recoveries=[MapperRecovery({"detect": 0.002}, 7)]), "hybrid", 2.5
)


def changed(**fields: object) -> DemoReport:
    return replace(REPORT, disturbed=replace(REPORT.disturbed, **fields))  # type: ignore[arg-type]


def test_all_answered_once_is_none_lost() -> None:
    assert judge_asks(3, {1: 1, 2: 1, 3: 1}, {1: 1, 2: 1, 3: 1}) == Asks(3, 3, 0, 0)


def test_a_forgotten_question_is_lost() -> None:
    assert judge_asks(2, {1: 1, 2: 1}, {2: 1}) == Asks(2, 2, 1, 0)


def test_an_unanswered_question_is_lost_though_it_was_handled() -> None:
    assert judge_asks(2, {1: 1}, {1: 1, 2: 1}) == Asks(2, 1, 1, 0)


def test_handled_twice_or_answered_twice_is_doubled() -> None:
    assert judge_asks(3, {1: 1, 2: 2, 3: 1}, {1: 2, 2: 1, 3: 1}) == Asks(3, 3, 0, 2)


def test_an_equal_run_is_good() -> None:
    assert REPORT.is_identical
    assert REPORT.is_good


def test_one_bit_is_a_difference() -> None:
    cells = np.zeros((3, 4), np.int8)
    cells[1, 2] = 1
    report = changed(grid=OccupancyGrid(PLACE, cells))
    assert report.differing_cells == 1
    assert not report.is_good
    assert any("DIFFERS" in line and "1 of 12" in line for line in as_lines(report))


def test_a_lost_or_doubled_ask_or_scan_is_not_good() -> None:
    bad = [changed(asks=Asks(5, 4, 1, 0)), changed(asks=Asks(5, 5, 0, 1)), changed(scans=8), changed(gaps=1)]
    assert not any(report.is_good for report in bad)


def test_a_bad_line_is_a_fault_and_a_cut_off_one_is_none() -> None:
    assert not changed(problem="x.g2o, line 3: bad").is_good
    assert changed(problem="x.g2o, line 3: cut off", cut_off=True).is_good


def test_recovery_is_summed_up_by_phase() -> None:
    assert recovery_ms([]) == {}
    several = [(0.001, 0.1), (0.002, 0.3), (0.009, 0.2)]
    recoveries = [MapperRecovery({"detect": detect, "replay": replay}, 1) for detect, replay in several]
    assert recovery_ms(recoveries) == {"detect": 2.0, "replay": 200.0, "total": 209.0}


def test_the_json_has_the_promised_keys() -> None:
    found = json.loads(json.dumps(as_json(REPORT)))
    assert {key: found[key] for key in ("identical", "kills", "asks", "recovery_ms", "seconds")} == {
        "identical": True,
        "kills": 1,
        "asks": {"sent": 5, "answered": 5, "lost": 0, "doubled": 0},
        "recovery_ms": {"detect": 2.0, "total": 2.0},
        "seconds": 2.5,
    }


def test_the_lines_say_what_happened() -> None:
    text = "\n".join(as_lines(REPORT))
    assert "5 sent, 5 answered, 0 lost, 0 doubled" in text
    assert "identical" in text
    assert "1 times SIGKILL" in text
