"""The Willow Garage office as a map, and a simulated robot that drives in it.

The robot is not a part of the programs: it goes on when they crash, and knows where it really is.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
from common import find_file, reading
from map_demo.grid import Geometry, OccupancyGrid
from numpy.typing import NDArray
from scans import Floats, LikelihoodField, compose, distances, place
from scipy.ndimage import maximum_filter

FILE = "willow-2010-02-18-0.10.pgm.gz"
RESOLUTION = 0.1  # metres a cell, as the .yaml beside it says
FREE = 206  # grey values from here on; 205 is unknown, and what is darker is a wall or the doubtful edge of one

PERIOD = 0.2  # seconds from one command to the next
BEAMS = 90
LASER_RANGE = 10.0  # metres


def read_map(data: Path) -> OccupancyGrid:
    """The map: evidence -1 free, 1 at the edge of what is free (walls, and where the recording ends), 0 unknown.

    Raises:
        MissingData, DamagedData: naming the file.
    """
    path = find_file(data, FILE)
    with reading(path):
        grey = _read_grey(gzip.decompress(path.read_bytes()))
        if (grey < FREE).all():
            raise ValueError("no cell of it is free")
    free = grey[::-1] >= FREE  # The picture begins in the north, the map in the south.
    edge = (maximum_filter(free, size=3) != 0) & ~free
    return OccupancyGrid(Geometry(RESOLUTION, 0.0, 0.0, *free.T.shape), edge.astype(np.int8) - free.astype(np.int8))


def room_of(grid: OccupancyGrid) -> LikelihoodField:
    """How far each place is from what is not free."""
    return LikelihoodField(grid.geometry, distances(grid.cells < 0, grid))


def _read_grey(pgm: bytes) -> NDArray[np.uint8]:
    """A binary PGM file as an array of shape (rows, columns)."""
    fields, at = list[bytes](), 0
    while len(fields) < 4:  # magic, columns, rows, white
        line, _, _ = pgm[at:].partition(b"\n")
        if not line:
            raise ValueError("its head is cut off")
        fields += line.partition(b"#")[0].split()
        at += len(line) + 1
    columns, rows = int(fields[1]), int(fields[2])
    if fields[0] != b"P5" or fields[3] != b"255" or len(pgm) - at != rows * columns:
        raise ValueError(f"no PGM picture of {columns} x {rows} grey cells")
    return np.frombuffer(pgm, np.uint8, offset=at).reshape(rows, columns)


class Robot:
    """A robot that drives as it is told, and stops for good at a wall."""

    def __init__(self, grid: OccupancyGrid, pose: tuple[float, float, float]) -> None:
        self._room = room_of(grid)
        self.pose = np.array(pose)
        self.travelled = 0.0  # metres
        self.has_hit_wall = False

    def drive(self, speed: float, turn: float) -> Floats:
        """Go on for one period at a speed (m/s) and a rate of turning (rad/s); the true step, seen from before."""
        if self.has_hit_wall:
            return np.zeros(3)
        middle = turn * PERIOD / 2
        step = np.array([speed * PERIOD * np.cos(middle), speed * PERIOD * np.sin(middle), turn * PERIOD])
        self.pose = compose(self.pose, step)
        self.travelled += abs(speed) * PERIOD
        self.has_hit_wall = bool(self._room.at(self.pose[None, :2])[0] < RESOLUTION / 2)
        return step

    def is_at(self, place: tuple[float, float], *, within: float = 0.5) -> bool:
        """Whether it is really there."""
        return bool(np.hypot(*(self.pose[:2] - place)) < within)

    def scan(self) -> Floats:
        """Ranges of beams all around, in metres; at most `LASER_RANGE`."""
        bearings = bearings_of_beams() + self.pose[2]
        directions = np.column_stack([np.cos(bearings), np.sin(bearings)])
        ranges = np.zeros(BEAMS)
        for _ in range(200):  # A beam can go on at least as far as the nearest wall is.
            room = self._room.at(self.pose[:2] + ranges[:, None] * directions)
            goes_on = (room > RESOLUTION / 2) & (ranges < LASER_RANGE)
            if not goes_on.any():
                break
            ranges = np.minimum(ranges + np.where(goes_on, room, 0.0), LASER_RANGE)
        return ranges


def bearings_of_beams() -> Floats:
    """Directions of the beams, in radians from the heading."""
    return np.arange(BEAMS) * (2 * np.pi / BEAMS) - np.pi


def steer(pose: Floats, towards: tuple[float, float]) -> tuple[float, float]:
    """Speed and rate of turning that bring a robot to a point: turn on the spot, then drive.

    >>> steer(np.zeros(3), (5.0, 0.0))
    (1.0, 0.0)
    """
    dx, dy = place(np.array([towards]) - pose[:2], np.array([0.0, 0.0, -pose[2]]))[0]
    bearing = float(np.arctan2(dy, dx))
    speed = max(0.0, 1.0 - 2.0 * abs(bearing)) * min(1.0, float(np.hypot(dx, dy)) / PERIOD)
    return speed, float(np.clip(2.0 * bearing, -2.0, 2.0))
