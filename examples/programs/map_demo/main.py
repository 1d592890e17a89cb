"""Runs the `demo` command, from its plan to its verdict on the screen."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from rich.console import Console

from holdfast import run

from .demo_runs import DemoPlan, compare
from .picture import draw, save
from .report import DemoReport
from .show import Watcher, watcher_for

Comparison: TypeAlias = Callable[[DemoPlan, Watcher], Coroutine[None, None, DemoReport]]
"""Makes the runs of a demo."""


def run_demo(
    plan: DemoPlan, console: Console, *, picture: Path, as_json: bool, compared: Comparison = compare
) -> DemoReport:
    """Run the plan and show it: live on a terminal, as lines elsewhere, or as one JSON object.

    Args:
        plan: what to do.
        console: where it is shown.
        picture: the file that both maps are drawn into.
        as_json: whether only one JSON object is printed.
        compared: makes the runs, and compares them.

    Raises:
        LogError: there is not one scan to run on.
        HoldfastError: the system gave up.
        OSError: there is no folder to put the picture into.
    """
    if not picture.resolve().parent.is_dir():
        raise NotADirectoryError(f"{picture}: there is no folder {picture.resolve().parent} to put the picture into")
    watcher = watcher_for(console, as_json_object=as_json)
    try:
        report = with_picture(run(compared(plan, watcher)), picture)
        watcher.finish(report)
    finally:
        watcher.close()
    return report


def with_picture(report: DemoReport, file: Path) -> DemoReport:
    """Draw both maps into a file; if it cannot be written, the report says so and stands."""
    left, right = report.undisturbed, report.disturbed
    titles = "undisturbed", f"{report.method}, killed {len(right.kills)} times: {_verdict(report)}"
    try:
        save(draw(left.grid, right.grid, titles=titles, path=list(left.path if left.path == right.path else ())), file)
    except OSError as error:
        return replace(report, notices=(*report.notices, f"picture  not written: {error}"))
    return replace(report, picture=str(file))


def _verdict(report: DemoReport) -> str:
    cells = report.differing_cells
    return f"{cells:,} cells differ" if cells else "identical"
