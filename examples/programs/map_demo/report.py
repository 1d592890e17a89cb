"""The report of the demo: what two runs measured, and whether their maps are equal bit by bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from .grid import OccupancyGrid, differing
from .planner import Position, length

PHASES = ("detect", "isolate", "restart", "restore", "replay", "release")
TAKEOVER = "takeover"
"""Of a fleet: from a kill to the first answer to what was asked behind it."""


@dataclass(frozen=True)
class Asks:
    """The fate of all questions of one run."""

    sent: int
    answered: int
    lost: int
    doubled: int


@dataclass(frozen=True)
class MapperKill:
    """One SIGKILL: of which process, and after which scan of the log."""

    pid: int
    last_scan: int


@dataclass(frozen=True)
class MapperRecovery:
    """One return of the mapper: seconds by phase, and how many messages were replayed."""

    phases: Mapping[str, float]
    replayed: int


@dataclass(frozen=True)
class RunOutcome:
    """What one run ended with; `problem` is what was wrong with the log."""

    grid: OccupancyGrid
    scans: int
    gaps: int
    asks: Asks
    seconds: float
    kills: Sequence[MapperKill] = ()
    recoveries: Sequence[MapperRecovery] = ()
    failures: Sequence[str] = ()
    path: Sequence[Position] = ()
    problem: str = ""
    cut_off: bool = False


@dataclass(frozen=True)
class DemoReport:
    """Two runs over the same log, one of them disturbed."""

    undisturbed: RunOutcome
    disturbed: RunOutcome
    method: str
    seconds: float
    picture: str = ""
    notices: Sequence[str] = field(default_factory=tuple)

    @property
    def differing_cells(self) -> int:
        """Cells of the map in which the two runs differ in any bit."""
        return differing(self.undisturbed.grid, self.disturbed.grid)

    @property
    def is_identical(self) -> bool:
        """Same map, same scans, in the same order, with none left out."""
        same = self.undisturbed.scans == self.disturbed.scans and self.undisturbed.path == self.disturbed.path
        return same and self.disturbed.gaps == 0 and self.differing_cells == 0

    @property
    def is_good(self) -> bool:
        """Nothing differs, nothing was lost or doubled, and the log could be read (a cut-off last line is no fault)."""
        asks = self.disturbed.asks
        readable = self.disturbed.cut_off or not self.disturbed.problem
        return self.is_identical and asks.lost == 0 and asks.doubled == 0 and readable


def judge_asks(sent: int, answers: Mapping[int, int], handled: Mapping[int, int]) -> Asks:
    """Count the fates of questions 1..sent.

    A question is lost if it has no answer, or if its answer is forgotten: the mapper does not know that it was asked.
    It is doubled if it was answered, or handled, more than once.

    Args:
        sent: number of questions sent.
        answers: answers received, by serial number.
        handled: times the mapper handled a question, by serial number.

    >>> judge_asks(4, {1: 1, 2: 1, 4: 1}, {1: 1, 2: 2})
    Asks(sent=4, answered=3, lost=2, doubled=1)
    """
    serials = range(1, sent + 1)
    lost = sum(not answers.get(serial) or not handled.get(serial) for serial in serials)
    doubled = sum(answers.get(serial, 0) > 1 or handled.get(serial, 0) > 1 for serial in serials)
    return Asks(sent, sum(bool(answers.get(serial)) for serial in serials), lost, doubled)


def recovery_ms(recoveries: Sequence[MapperRecovery]) -> dict[str, float]:
    """Median milliseconds by phase, and of whole recoveries under `total`; empty without a recovery.

    >>> phases = {"detect": 0.001, "replay": 0.25}, {"detect": 0.003, "replay": 0.25}
    >>> recovery_ms([MapperRecovery(one, 9) for one in phases])
    {'detect': 2.0, 'replay': 250.0, 'total': 252.0}
    """
    if not recoveries:
        return {}
    each = [recovery.phases for recovery in recoveries]
    known = [phase for phase in (*PHASES, TAKEOVER) if any(phase in phases for phases in each)]
    medians = {phase: median(phases.get(phase, 0.0) for phases in each) for phase in known}
    medians["total"] = median(sum(phases.get(phase, 0.0) for phase in known) for phases in each)
    return {phase: round(1000 * seconds, 3) for phase, seconds in medians.items()}


def as_json(report: DemoReport) -> dict[str, object]:
    """The report as one JSON object."""
    run = report.disturbed
    asks = run.asks
    return {
        "identical": report.is_identical,
        "kills": len(run.kills),
        "asks": {"sent": asks.sent, "answered": asks.answered, "lost": asks.lost, "doubled": asks.doubled},
        "recovery_ms": recovery_ms(run.recoveries),
        "seconds": round(report.seconds, 3),
        "method": report.method,
        "scans": run.scans,
        "differing_cells": report.differing_cells,
        "picture": report.picture,
        "problem": run.problem,
    }


def as_lines(report: DemoReport) -> list[str]:
    """The report as lines of text."""
    return [*_map_lines(report), *_ask_lines(report.disturbed), *_run_lines(report), *report.notices]


def _map_lines(report: DemoReport) -> list[str]:
    run, cells = report.disturbed, report.disturbed.grid.cells.size
    lines = [
        f"scans    {run.scans:,} handled, {report.undisturbed.scans:,} undisturbed, {run.gaps} gaps in their order"
    ]
    if report.is_identical:
        lines.append(f"map      identical to the undisturbed run's in all {cells:,} cells")
    elif report.differing_cells:
        lines.append(f"map      DIFFERS from the undisturbed run's in {report.differing_cells:,} of {cells:,} cells")
    else:
        lines.append("map      identical, but scans or the planned path DIFFER from the undisturbed run's")
    if run.path:
        lines.append(f"path     {length(list(run.path)):.0f} m from the first place to the farthest one")
    return lines


def _ask_lines(run: RunOutcome) -> list[str]:
    asks = run.asks
    lines = [f"asks     {asks.sent:,} sent, {asks.answered:,} answered, {asks.lost:,} lost, {asks.doubled:,} doubled"]
    if asks.lost > asks.sent - asks.answered:
        lines.append("         lost also counts what was answered and then forgotten with the mapper's state")
    if run.failures:
        lines.append(f"         first failure: {run.failures[0]}")
    return lines


def _run_lines(report: DemoReport) -> list[str]:
    run = report.disturbed
    lines = [f"kills    {len(run.kills)} times SIGKILL, method {report.method}"]
    phases = recovery_ms(run.recoveries)
    if phases:
        times = ", ".join(f"{phase} {value:.1f}" for phase, value in phases.items())
        replayed = sum(recovery.replayed for recovery in run.recoveries)
        lines.append(f"recovery {len(run.recoveries)} times, {replayed:,} messages replayed; median ms: {times}")
    lines.append(f"time     {report.seconds:.1f} s for both runs")
    if report.picture:
        lines.append(f"picture  {report.picture}")
    if run.problem:
        lines.append(f"log      {run.problem}" + ("; everything before was used" if run.scans else ""))
    return lines
