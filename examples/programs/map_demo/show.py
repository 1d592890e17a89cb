"""Three ways to watch the demo: a live display, plain lines, one JSON object. They show what they are told."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from time import monotonic
from typing import Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text
from rich.tree import Tree

from .report import PHASES, TAKEOVER, DemoReport, MapperKill, MapperRecovery, as_json, as_lines

REFRESH = 0.1  # seconds between two pictures of the live display
TENTHS = 10  # plain text: lines of progress in one run


@dataclass(frozen=True)
class Progress:
    """How far a run is. `pid` is the mapper's process, or the leading node, None while there is none."""

    run: str
    scans: int
    total: int
    sent: int
    answered: int
    waiting: int
    pid: int | None
    machines: Sequence[str] = ()


class Watcher(Protocol):
    """What a run tells while it goes on."""

    def begin(self, run: str, total: int) -> None:
        """A run over `total` scans begins."""

    def progress(self, now: Progress) -> None:
        """More scans are handled, or more questions answered."""

    def killed(self, kill: MapperKill) -> None:
        """The mapper's process got SIGKILL."""

    def recovered(self, recovery: MapperRecovery) -> None:
        """Show that the mapper is back."""

    def notice(self, text: str) -> None:
        """Something the user should know, such as a log that is cut off."""

    def finish(self, report: DemoReport) -> None:
        """Show the verdict when both runs are over."""

    def close(self) -> None:
        """Nothing more will come, perhaps because of an error."""


class PlainLines:
    """Lines of text, for a pipe or a file."""

    def __init__(self, console: Console) -> None:
        self._console, self._tenth = console, 0

    def begin(self, run: str, total: int) -> None:
        self._tenth = 0
        self._print(f"{run}: {total:,} scans")

    def progress(self, now: Progress) -> None:
        tenth = TENTHS * now.scans // now.total
        if tenth > self._tenth:
            self._tenth = tenth
            self._print(f"  scan {now.scans:,} of {now.total:,}; {now.answered:,} of {now.sent:,} questions answered")

    def killed(self, kill: MapperKill) -> None:
        self._print(f"  SIGKILL to process {kill.pid}, after scan {kill.last_scan:,}")

    def recovered(self, recovery: MapperRecovery) -> None:
        self._print(f"  recovered, {recovery.replayed:,} messages replayed: {_milliseconds(recovery.phases)}")

    def notice(self, text: str) -> None:
        self._print(f"note: {text}")

    def finish(self, report: DemoReport) -> None:
        self._print("")
        for line in as_lines(report):
            self._print(line)

    def close(self) -> None:
        pass

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)


class Json:
    """One JSON object at the end."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def begin(self, run: str, total: int) -> None:
        pass

    def progress(self, now: Progress) -> None:
        pass

    def killed(self, kill: MapperKill) -> None:
        pass

    def recovered(self, recovery: MapperRecovery) -> None:
        pass

    def notice(self, text: str) -> None:
        pass  # The object's "problem" says it.

    def finish(self, report: DemoReport) -> None:
        self._console.print(json.dumps(as_json(report)), markup=False, highlight=False, soft_wrap=True)

    def close(self) -> None:
        pass


class Rich:
    """A live picture of the tree, the progress, the kills and the recoveries, for a terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        # Refreshed from the event loop: the thread of an auto-refresh would run beside the actors.
        self._live = Live(console=console, auto_refresh=False)
        self._live.start()
        self._now = Progress("", 0, 1, 0, 0, 0, None)
        self._kills: list[MapperKill] = []
        self._recoveries: list[MapperRecovery] = []
        self._shown = 0.0

    def begin(self, run: str, total: int) -> None:
        self._now = Progress(run, 0, total, 0, 0, 0, None)
        self._draw()

    def progress(self, now: Progress) -> None:
        self._now = now
        if monotonic() - self._shown >= REFRESH:
            self._draw()

    def killed(self, kill: MapperKill) -> None:
        self._kills.append(kill)
        self._now = replace(self._now, pid=None)
        self._draw()

    def recovered(self, recovery: MapperRecovery) -> None:
        self._recoveries.append(recovery)
        self._draw()

    def notice(self, text: str) -> None:
        self._console.print(f"note: {text}", style="yellow", markup=False, highlight=False)

    def finish(self, report: DemoReport) -> None:
        self._draw()
        self.close()
        style = "bold green" if report.is_good else "bold red"
        for line in as_lines(report):
            verdict = style if line.startswith("map") else ""
            self._console.print(line, style=verdict, markup=False, highlight=False, soft_wrap=True)

    def close(self) -> None:
        self._live.stop()

    def _draw(self) -> None:
        self._shown = monotonic()
        parts: list[RenderableType] = [_tree(self._now), _bar(self._now)]
        if self._kills:
            parts.append(_table(self._kills, self._recoveries))
        self._live.update(Group(*parts), refresh=True)


def watcher_for(console: Console, *, as_json_object: bool) -> Watcher:
    """The watcher that suits where the output goes."""
    if as_json_object:
        return Json(console)
    return Rich(console) if console.is_terminal else PlainLines(console)


def _tree(now: Progress) -> Tree:
    alive = now.pid is not None
    mapper = f"process {now.pid}" if alive else "recovering" if now.scans else "starting"
    tree = Tree(Text(f"/demo  {now.run}", style="bold"))
    robot = tree.add("robot  supervisor, one_for_one")
    robot.add("reader  task, publishes /scan")
    robot.add(Text(f"mapper  {mapper}", style="green" if alive else "red"))
    robot.add("planner  task")
    if now.machines:
        fleet = tree.add("fleet")
        for machine in now.machines:
            fleet.add(machine)
    return tree


def _bar(now: Progress) -> Table:
    grid = Table.grid(padding=(0, 2))
    questions = f"questions {now.answered:,} of {now.sent:,}, {now.waiting} open"
    bar = ProgressBar(total=now.total, completed=now.scans, width=30)
    grid.add_row(bar, f"scans {now.scans:,} of {now.total:,}", questions)
    return grid


def _table(kills: Sequence[MapperKill], recoveries: Sequence[MapperRecovery]) -> Table:
    """One row a kill; two kills in one recovery share the row of the first, so rows may stay open."""
    table = Table(title="recovery, ms", title_justify="left")
    known = [phase for phase in (*PHASES, TAKEOVER) if any(phase in one.phases for one in recoveries)] or PHASES
    for heading in ("SIGKILL", "after scan", *known):
        table.add_column(heading, justify="right")
    for row, kill in enumerate(kills):
        phases: Mapping[str, float] = recoveries[row].phases if row < len(recoveries) else {}
        times = (f"{1000 * phases[phase]:.1f}" if phase in phases else "" for phase in known)
        table.add_row(str(kill.pid), f"{kill.last_scan:,}", *times)
    return table


def _milliseconds(phases: Mapping[str, float]) -> str:
    return ", ".join(f"{phase} {1000 * seconds:.1f} ms" for phase, seconds in phases.items())
