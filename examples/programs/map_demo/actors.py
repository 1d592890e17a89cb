"""The demo's actors, as a user of holdfast writes them: a reader, a mapper in a process of its own, a planner.

Nothing here knows of crashes, processes or recovery; those are words in the child specs (`tree` in `demo_runs.py`).
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable
from itertools import islice
from pathlib import Path

import numpy as np

from holdfast import Actor, Binding, Message, Refusal, on, subscribe

from .grid import Geometry, OccupancyGrid
from .log import LaserScan, LogCutOff, LogError, read_scans
from .planner import find_path, is_way_free

Position = tuple[float, float]

TOPIC = "/scan"
BURST = 0.02  # seconds: scans due within this are published together, one timer for all
LONGEST_PAUSE = 1.0  # seconds: a gap in the recording is not sat out
ROBOT_WIDTH = 1.0  # metres around a way that are fetched to judge it


class Scan(Message):
    """One sweep of the laser, number `number` of the log, from 1; `ranges` are float32, little endian."""

    number: int
    time: float
    x: float
    y: float
    heading: float
    start: float
    step: float
    max_range: float
    ranges: bytes


class Seen(Message):
    """What the mapper says of one place: evidence > 0 occupied, < 0 free, 0 never seen."""

    serial: int
    evidence: int
    last_scan: int


class LookAt(Message[Seen]):
    """What stands at this place? `serial` is the asker's number of the question."""

    serial: int
    place: Position


class MapPart(Message):
    """A rectangle of the map; `cells` are int8, row by row, row 0 in the south."""

    resolution: float
    x0: float
    y0: float
    columns: int
    rows: int
    cells: bytes
    last_scan: int


class GetPart(Message[MapPart]):
    """The map between two corners, asked for on behalf of question `serial`."""

    serial: int
    low: Position
    high: Position


class MapperState(Message):
    """Everything a mapper holds, for the comparison at the end."""

    whole: MapPart
    scans: int
    gaps: int
    questions: dict[int, int]


class GetMap(Message[MapperState]):
    """The whole map, and how often each question was handled; counts as no question itself."""


class WayAnswer(Message):
    """Whether the way is free, by the map as it was after scan `last_scan`."""

    serial: int
    is_free: bool
    last_scan: int


class IsWayFree(Message[WayAnswer]):
    """Can the robot drive straight from start to goal?"""

    serial: int
    start: Position
    goal: Position


class FindPath(Message[list[Position]]):
    """The corner points of a way from start to goal within the part of the map between two corners."""

    serial: int
    start: Position
    goal: Position
    low: Position
    high: Position


class NoWay(Refusal):
    """The map shows no way from start to goal."""

    start: Position
    goal: Position


class LogRead(Message):
    """The log is read: how many scans were published, and what was wrong with the log, if anything was."""

    scans: int
    problem: str = ""
    cut_off: bool = False


class ReadLog(Message[LogRead]):
    """Publish a log from behind scan `after`, at `speed` times the pace of its recording; 0: as fast as it is taken."""

    file: str
    speed: float
    after: int = 0


class Reader(Actor):
    """Publishes the scans of a log. A bad line ends the reading, not the reader."""

    @on(ReadLog)
    async def read(self, request: ReadLog) -> LogRead:
        number = request.after
        try:
            async for scan in _paced(islice(read_scans(Path(request.file)), number, None), request.speed):
                number += 1
                # Returns when every subscriber's mailbox has taken it: a slow mapper slows the reader.
                await self.ctx.publish(TOPIC, _message(number, scan))
        except LogError as error:
            return LogRead(number, str(error), isinstance(error, LogCutOff))
        return LogRead(number)


class Mapper(Actor):
    """Builds the map from the scans, and answers questions about it."""

    def __init__(self, geometry: Geometry) -> None:
        self.grid = OccupancyGrid(geometry)
        self.scans = 0
        self.last_scan = 0
        self.gaps = 0
        self.questions: dict[int, int] = {}

    @subscribe(TOPIC)
    @on(Scan)
    def add(self, scan: Scan) -> None:
        self.gaps += scan.number != self.last_scan + 1
        self.last_scan = scan.number
        self.scans += 1
        ranges = np.frombuffer(scan.ranges, "<f4")
        self.grid.update(
            (scan.x, scan.y), scan.heading, ranges, start=scan.start, step=scan.step, max_range=scan.max_range
        )

    @on(LookAt)
    def look_at(self, question: LookAt) -> Seen:
        self._count(question.serial)
        return Seen(question.serial, self.grid.at(*question.place), self.last_scan)

    @on(GetPart)
    def get_part(self, question: GetPart) -> MapPart:
        self._count(question.serial)
        return _part(self.grid.window(question.low, question.high), self.last_scan)

    @on(GetMap, readonly=True)
    def get_everything(self, question: GetMap) -> MapperState:
        return MapperState(_part(self.grid, self.last_scan), self.scans, self.gaps, self.questions)

    def _count(self, serial: int) -> None:
        self.questions[serial] = self.questions.get(serial, 0) + 1


class Planner(Actor):
    """Judges ways by the mapper's map; holds nothing itself."""

    mapper: Binding[Mapper]

    @on(IsWayFree)
    async def is_way_free(self, question: IsWayFree) -> WayAnswer:
        (x1, y1), (x2, y2) = question.start, question.goal
        low = min(x1, x2) - ROBOT_WIDTH, min(y1, y2) - ROBOT_WIDTH
        high = max(x1, x2) + ROBOT_WIDTH, max(y1, y2) + ROBOT_WIDTH
        part = await self.mapper.ask(GetPart(question.serial, low, high), timeout=60.0)
        return WayAnswer(question.serial, is_way_free(as_grid(part), question.start, question.goal), part.last_scan)

    @on(FindPath)
    async def find_path(self, question: FindPath) -> list[Position]:
        part = await self.mapper.ask(GetPart(question.serial, question.low, question.high), timeout=60.0)
        path = find_path(as_grid(part), question.start, question.goal)
        if path is None:
            raise NoWay(question.start, question.goal)
        return path


def as_grid(part: MapPart) -> OccupancyGrid:
    """The map in a message as a grid; its cells cannot be written to."""
    cells = np.frombuffer(part.cells, np.int8).reshape(part.rows, part.columns)
    return OccupancyGrid(Geometry(part.resolution, part.x0, part.y0, part.columns, part.rows), cells)


def _part(grid: OccupancyGrid, last_scan: int) -> MapPart:
    here = grid.geometry
    return MapPart(here.resolution, here.x0, here.y0, here.columns, here.rows, grid.cells.tobytes(), last_scan)


def _message(number: int, scan: LaserScan) -> Scan:
    return Scan(
        number,
        scan.time,
        scan.x,
        scan.y,
        scan.heading,
        scan.start,
        scan.step,
        scan.max_range,
        scan.ranges.astype("<f4").tobytes(),
    )


async def _paced(scans: Iterable[LaserScan], speed: float) -> AsyncIterator[LaserScan]:
    """The scans, each not before its time."""
    clock = asyncio.get_running_loop().time
    due, before = clock(), None
    for scan in scans:
        if speed and before is not None:
            due += min(max(scan.time - before, 0.0) / speed, LONGEST_PAUSE)
        before = scan.time
        if due - clock() > BURST:
            await asyncio.sleep(due - clock())
        yield scan
