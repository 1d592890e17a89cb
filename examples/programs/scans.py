"""Matching a laser scan with a map, as the two laser programs do it.

A scan fits a map where its end points lie on occupied cells. The *likelihood field* of a map holds the distance from
each cell to the nearest occupied one; the pose of a scan is where these distances, at its end points, are least.

Source: Pedrosa, Pereira and Lau 2017 (LaMa); the search itself is SciPy's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from map_demo.grid import Geometry, OccupancyGrid
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.optimize import least_squares

import holdfast as hf

Floats = NDArray[np.floating[Any]]


FARTHEST = 1.0  # metres: from there on it does not matter how far away the next wall is
TOLERANCE = 0.1  # metres: end points farther than this from a wall pull less and less, as what has moved should


class Start(hf.Message):
    """The robot stands about here."""

    x: float
    y: float
    heading: float


class Estimate(hf.Message):
    """Where the robot is, as far as the program knows."""

    x: float
    y: float
    heading: float


def place(points: Floats, pose: Floats) -> Floats:
    """Points seen from a pose (x, y, heading), in the world; shape (n, 2).

    >>> place(np.array([[1.0, 0.0]]), np.array([2.0, 3.0, np.pi / 2])).round(6).tolist()
    [[2.0, 4.0]]
    """
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    placed: Floats = points @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]
    return placed


def compose(pose: Floats, step: Floats) -> Floats:
    """The pose after a step that is seen from the pose."""
    return np.array([*place(step[None, :2], pose)[0], wrap(pose[2] + step[2])])


def between(pose: Floats, later: Floats) -> Floats:
    """The step from a pose to a later one: `compose(pose, between(pose, later))` is `later`."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = later[:2] - pose[:2]
    return np.array([cosine * dx + sine * dy, cosine * dy - sine * dx, wrap(later[2] - pose[2])])


def wrap(angle: float) -> float:
    """An angle between -pi and pi."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def end_points(ranges: NDArray[np.float32], *, start: float, step: float, nearest: float, farthest: float) -> Floats:
    """Where the beams of a scan end, seen from the laser; those outside these ranges (metres) are left out."""
    bearings = start + step * np.arange(len(ranges))
    good = (ranges > nearest) & (ranges < farthest)
    ends: Floats = ranges[good, None] * np.column_stack([np.cos(bearings[good]), np.sin(bearings[good])])
    return ends


def distances(inside: NDArray[np.bool_], grid: OccupancyGrid) -> Floats:
    """For each cell of a map how far the next one is that is not `inside`, in metres; shape (rows, columns)."""
    return np.asarray(distance_transform_edt(inside), np.float64) * grid.geometry.resolution


@dataclass
class LikelihoodField:
    """Distances to the nearest occupied cell, in metres; `distances` has shape (rows, columns)."""

    geometry: Geometry
    distances: Floats

    @staticmethod
    def of(grid: OccupancyGrid) -> LikelihoodField:
        """The field of a map; distances end at `FARTHEST`."""
        return LikelihoodField(grid.geometry, np.minimum(distances(grid.cells <= 0, grid), FARTHEST))

    def at(self, points: Floats) -> Floats:
        """Distances at points, interpolated between the middles of cells; outside the map: `FARTHEST`."""
        columns, rows = (points - (self.geometry.x0, self.geometry.y0)).T / self.geometry.resolution - 0.5
        found: Floats = map_coordinates(self.distances, (rows, columns), order=1, mode="constant", cval=FARTHEST)
        return found

    def match(self, points: Floats, guess: Floats, *, trust: float = 0.0) -> Floats:
        """The pose near `guess` from which the end points of a scan fit the map best.

        Args:
            points: where the beams end, seen from the laser; shape (n, 2).
            guess: a pose to begin the search at.
            trust: how many times a metre (or radian) away from the guess is as bad as one of a beam from a wall. In a
                long corridor nothing but the guess says how far along the robot is.
        """

        def misfit(pose: Floats) -> Floats:
            return np.concatenate([self.at(place(points, pose)), trust * (pose - guess)])

        found = least_squares(misfit, guess, loss="cauchy", f_scale=TOLERANCE, diff_step=1e-3, max_nfev=15)
        return np.array([found.x[0], found.x[1], wrap(found.x[2])])
