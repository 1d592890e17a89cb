"""Where is the robot? Matching each scan with a given map says it, as in LaMa_local.

Data: the MIT Killian Court log of `rtb-data`, with the poses its authors found. Every second scan makes the map; the
others are localised in it, from an odometry made of the recorded steps and noise.
Correct: the error stays small.
Command: python examples/programs/scan_localisation.py [--limit N] [--method fresh] [--kill-at 9s]
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, DamagedData, Feed, MissingData, Program, Timed, Verdict, main
from map_demo.grid import USABLE_RANGE, Geometry, OccupancyGrid
from map_demo.log import LaserScan, LogError, killian_court, read_scans
from scans import Estimate, Floats, LikelihoodField, Start, between, compose, end_points

import holdfast as hf

FILE = "killian.g2o.zip"
NEAREST = 0.3  # metres
GOOD = 0.5  # metres that nineteen of twenty answers may be wrong at most
NOISE = np.array([0.02, 0.02, 0.005])  # of the odometry, in each step: of its metres, its metres, radians
TRUST = 10.0  # in the odometry


class Moved(hf.Message[Estimate]):
    """The robot went a step (seen from before it); where beams end, seen from the laser: float32 pairs, metres."""

    forward: float
    left: float
    turned: float
    ends: bytes


class Localiser(hf.Actor):
    """Holds where the robot is and was. The map is given to every life anew."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self._field = LikelihoodField.of(grid)
        self.pose: Floats = np.zeros(3)
        self.trail: list[Floats] = []

    @hf.on(Start)
    def begin(self, start: Start) -> None:
        self.pose = np.array([start.x, start.y, start.heading])

    @hf.on(Moved)
    def follow(self, moved: Moved) -> Estimate:
        ends = np.frombuffer(moved.ends, "<f4").reshape(-1, 2).astype(np.float64)
        self.pose = compose(self.pose, np.array([moved.forward, moved.left, moved.turned]))
        if len(ends):
            self.pose = self._field.match(ends, self.pose, trust=TRUST)
        self.trail.append(self.pose)
        x, y, heading = self.pose.tolist()
        return Estimate(x, y, heading)


class ScanLocalisation(Program):
    name = "scan_localisation"

    def __init__(self, data: Path = DATA, limit: int | None = None) -> None:
        scans = _read(data, limit)
        self.grid = _map_of(scans[::2])
        self.scans = scans[1::2]
        self.truth = [np.array([scan.x, scan.y, scan.heading]) for scan in self.scans]
        self.errors: list[float] = []  # metres, one for each answer; infinite without one

    def start(self) -> hf.Start[Any]:
        return hf.start(Localiser, self.grid)

    def feed(self) -> Feed:
        random = np.random.default_rng(3)
        x, y, heading = self.truth[0].tolist()
        yield Timed(0.0, Start(x, y, heading))
        before = self.truth[0]
        for scan, pose in zip(self.scans, self.truth, strict=True):
            step = between(before, pose)
            moved = np.array([np.hypot(step[0], step[1])] * 2 + [1.0])
            forward, left, turned = (step + NOISE * moved * random.standard_normal(3)).tolist()
            answer: Estimate | None = yield Timed(
                scan.time - self.scans[0].time, Moved(forward, left, turned, _ends(scan).astype("<f4").tobytes())
            )
            self.errors.append(np.inf if answer is None else float(np.hypot(answer.x - pose[0], answer.y - pose[1])))
            before = pose

    def judge(self, state: dict[str, Any]) -> Verdict:
        median, most, worst = np.quantile(self.errors, [0.5, 0.95, 1.0], method="higher")
        figures = f"error {median:.2f} m, for 95 % at most {most:.2f} m, at most {worst:.2f} m"
        return Verdict(bool(most < GOOD) and self.errors[-1] < 2 * GOOD, figures)


def _read(data: Path, limit: int | None) -> list[LaserScan]:
    """As many scans as give `limit` messages: the first message says where the robot starts."""
    try:
        path = data / FILE if (data / FILE).is_file() else killian_court()
    except LogError:
        raise MissingData(f"there is no file {FILE}: pip install rtb-data") from None
    try:
        scans = list(islice(read_scans(path), None if limit is None else max(2, 2 * (limit - 1))))
    except LogError as error:
        raise DamagedData(str(error)) from error
    if len(scans) < 2:
        raise DamagedData(f"{path}: {len(scans)} scans, expected two at least")
    return scans


def _map_of(scans: list[LaserScan]) -> OccupancyGrid:
    x, y = [scan.x for scan in scans], [scan.y for scan in scans]
    grid = OccupancyGrid(Geometry.covering(min(x), min(y), max(x), max(y)))
    for scan in scans:
        ranges = scan.ranges
        position = scan.x, scan.y
        grid.update(position, scan.heading, ranges, start=scan.start, step=scan.step, max_range=scan.max_range)
    return grid


def _ends(scan: LaserScan) -> Floats:
    return end_points(scan.ranges, start=scan.start, step=scan.step, nearest=NEAREST, farthest=USABLE_RANGE)


if __name__ == "__main__":
    main(ScanLocalisation)
