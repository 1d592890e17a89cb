"""A map by matching laser scans, as hector_mapping makes it: no odometry, the map alone says where the robot is.

Data: a drive through a two-room laboratory (mines_exp1.dat.gz), 756 scans at 10 Hz.
Correct: every scan is in the map, and seen from where the robot was, it lies on the map's walls.
Command: python examples/programs/mapping.py [--limit N] [--method fresh] [--kill-at 9s]
"""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, DamagedData, Feed, Program, Timed, Verdict, find_file, main, read_numbers
from map_demo.grid import Geometry, OccupancyGrid
from scans import Floats, LikelihoodField, between, compose, end_points, place

import holdfast as hf

FILE = "mines_exp1.dat.gz"
COLUMNS, FIRST_RANGE, BEAMS = 707, 24, 682
STEP = math.radians(240.0) / (BEAMS - 1)
START = -math.radians(120.0)
NEAREST, FARTHEST = 0.15, 5.0  # metres: the laser's own limits
MAP = Geometry(resolution=0.05, x0=-11.0, y0=-12.0, columns=440, rows=440)
EVERY = 3  # beams: neighbours say the same


class Scan(hf.Message[int]):
    """One sweep of the laser, `ranges` in metres as float32, 0 where nothing came back. The reply: scans so far."""

    ranges: bytes


class Mapper(hf.Actor):
    """Holds the map and the robot's way through it; the map begins where the robot does."""

    def __init__(self) -> None:
        self.grid = OccupancyGrid(MAP)
        self.trail: list[Floats] = []  # poses of the laser: x, y, heading

    @hf.on(Scan)
    def add(self, scan: Scan) -> int:
        ranges = np.frombuffer(scan.ranges, "<f4")
        pose = self._locate(ranges)
        self.trail.append(pose)
        seen = np.where((ranges > NEAREST) & (ranges < FARTHEST), ranges, np.float32(np.inf))
        self.grid.update((pose[0], pose[1]), pose[2], seen, start=START, step=STEP, max_range=FARTHEST)
        return len(self.trail)

    def _locate(self, ranges: np.ndarray) -> Floats:
        if not self.trail:
            return np.zeros(3)
        last, before = self.trail[-1], self.trail[max(-2, -len(self.trail))]
        guess = compose(last, between(before, last))  # The robot goes on as it did.
        return LikelihoodField.of(self.grid).match(points_of(ranges)[::EVERY], guess)


def points_of(ranges: np.ndarray) -> Floats:
    """The end points of a scan, seen from the laser."""
    return end_points(ranges, start=START, step=STEP, nearest=NEAREST, farthest=FARTHEST)


class Mapping(Program):
    name = "mapping"

    def __init__(self, data: Path = DATA, limit: int | None = None) -> None:
        rows = islice(read_numbers(find_file(data, FILE), columns=COLUMNS), limit)
        self.scans = [(row[0] / 1e6, np.array(row[FIRST_RANGE : FIRST_RANGE + BEAMS], "<f4") / 1000) for row in rows]
        if not self.scans:
            raise DamagedData(f"{data / FILE}: no scan in it")

    def start(self) -> hf.Start[Any]:
        return hf.start(Mapper)

    def feed(self) -> Feed:
        for time, ranges in self.scans:
            yield Timed(time - self.scans[0][0], Scan(ranges.tobytes()))

    def judge(self, state: dict[str, Any]) -> Verdict:
        grid, trail = state["grid"], state["trail"]
        field = LikelihoodField.of(grid)
        fits = [
            float(np.mean(field.at(place(points_of(ranges), pose)) < 2 * MAP.resolution))
            for (_, ranges), pose in zip(self.scans, trail, strict=False)
        ]
        fit = float(np.mean(fits)) if fits else 0.0
        known = int(np.count_nonzero(grid.cells)) * MAP.resolution**2
        figures = (
            f"{len(trail)} of {len(self.scans)} scans, {100 * fit:.1f} % of what they saw on walls, {known:.0f} m2"
        )
        return Verdict(len(trail) == len(self.scans) and fit > 0.85, figures)


if __name__ == "__main__":
    main(Mapping)
