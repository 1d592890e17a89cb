"""An occupancy grid: for each cell of a floor plan, the evidence that something stands there.

Evidence is log-odds in twentieths, held in one signed byte a cell: integer arithmetic gives the same bits on every
machine and in every run, and a snapshot of a whole campus is two megabytes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

HIT = 17  # log-odds 0.85: a beam ended in this cell
MISS = 8  # log-odds -0.4: a beam went through it
LIMIT = 100  # log-odds +-5: beyond this more of the same is no news, and what moves away is forgotten in time
USABLE_RANGE = 20.0  # metres; farther beams lie so far apart that they only draw rays
MOST_CELLS = 4_000_000
FINEST = 0.2  # metres

Cells = NDArray[np.int8]


@dataclass(frozen=True)
class Geometry:
    """Where a grid lies in the world: cell (row, column) is the square from (x0, y0) + (column, row) * resolution."""

    resolution: float
    x0: float
    y0: float
    columns: int
    rows: int

    @staticmethod
    def covering(x_min: float, y_min: float, x_max: float, y_max: float, *, margin: float = USABLE_RANGE) -> Geometry:
        """The finest grid of at most `MOST_CELLS` that holds these positions and what is seen from them.

        >>> Geometry.covering(0.0, 0.0, 10.0, 5.0, margin=5.0)
        Geometry(resolution=0.2, x0=-5.0, y0=-5.0, columns=100, rows=75)
        """
        width, height = x_max - x_min + 2 * margin, y_max - y_min + 2 * margin
        resolution = max(FINEST, math.ceil(20 * math.sqrt(width * height / MOST_CELLS)) / 20)
        columns, rows = math.ceil(width / resolution - 1e-9), math.ceil(height / resolution - 1e-9)
        return Geometry(resolution, x_min - margin, y_min - margin, columns, rows)

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """(row, column) of a position; it may lie outside."""
        return math.floor((y - self.y0) / self.resolution), math.floor((x - self.x0) / self.resolution)

    def position(self, row: int, column: int) -> tuple[float, float]:
        """(x, y) of the middle of a cell."""
        return self.x0 + (column + 0.5) * self.resolution, self.y0 + (row + 0.5) * self.resolution

    def holds(self, row: int, column: int) -> bool:
        """Whether the cell lies in the grid."""
        return 0 <= row < self.rows and 0 <= column < self.columns


@dataclass
class OccupancyGrid:
    """The map. `cells` has shape (rows, columns): > 0 occupied, < 0 free, 0 never seen."""

    geometry: Geometry
    cells: Cells = field(default_factory=lambda: np.zeros((0, 0), np.int8))

    def __post_init__(self) -> None:
        if self.cells.size == 0:
            self.cells = np.zeros((self.geometry.rows, self.geometry.columns), np.int8)

    def update(
        self,
        position: tuple[float, float],
        heading: float,
        ranges: NDArray[np.float32],
        *,
        start: float,
        step: float,
        max_range: float,
    ) -> None:
        """Add one scan: cells in which a beam ended gain `HIT`, cells it crossed lose `MISS`, each once a scan.

        The order of scans matters, as evidence is cut at `LIMIT`. See `log.LaserScan` for the units.
        """
        lengths = ranges.astype(np.float64)
        returned = lengths < max_range  # False for NaN too
        lengths, bearings = lengths[returned], (heading + start + step * np.arange(len(ranges)))[returned]
        cosines, sines = np.cos(bearings), np.sin(bearings)
        near = lengths <= USABLE_RANGE
        hits = self._flat(position, lengths[near] * cosines[near], lengths[near] * sines[near])
        beams, along = _samples(np.minimum(lengths, USABLE_RANGE), self.geometry.resolution)
        self._apply(hits, self._flat(position, along * cosines[beams], along * sines[beams]))

    def at(self, x: float, y: float) -> int:
        """Evidence at a position; 0, unknown, outside the grid."""
        row, column = self.geometry.cell(x, y)
        return int(self.cells[row, column]) if self.geometry.holds(row, column) else 0

    def window(self, low: tuple[float, float], high: tuple[float, float]) -> OccupancyGrid:
        """A copy of the part between two corners, cut to the grid; it holds at least one cell."""
        whole = self.geometry
        (bottom, left), (top, right) = whole.cell(*low), whole.cell(*high)
        bottom, left = min(max(bottom, 0), whole.rows - 1), min(max(left, 0), whole.columns - 1)
        part = self.cells[bottom : max(top, bottom) + 1, left : max(right, left) + 1].copy()
        x0, y0 = whole.x0 + left * whole.resolution, whole.y0 + bottom * whole.resolution
        return OccupancyGrid(Geometry(whole.resolution, x0, y0, part.shape[1], part.shape[0]), part)

    def _flat(self, origin: tuple[float, float], dx: NDArray[np.float64], dy: NDArray[np.float64]) -> NDArray[np.int64]:
        """Flat indices of the cells at these offsets from a position; those outside the grid are left out."""
        here = self.geometry
        columns = np.floor((origin[0] - here.x0 + dx) / here.resolution).astype(np.int64)
        rows = np.floor((origin[1] - here.y0 + dy) / here.resolution).astype(np.int64)
        inside = (columns >= 0) & (columns < here.columns) & (rows >= 0) & (rows < here.rows)
        return (rows * here.columns + columns)[inside]

    def _apply(self, hits: NDArray[np.int64], crossed: NDArray[np.int64]) -> None:
        flat = self.cells.reshape(-1)
        # An index that occurs twice writes the same value twice, so each cell counts once; a hit beats a crossing.
        gained = np.minimum(flat[hits] + np.int8(HIT), LIMIT)
        flat[crossed] = np.maximum(flat[crossed] - np.int8(MISS), -LIMIT)
        flat[hits] = gained


def _samples(lengths: NDArray[np.float64], resolution: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Points along beams, closer than a cell, to half a cell before the end: (beam of each point, its distance)."""
    pitch = 0.7 * resolution
    counts = np.ceil(np.maximum(lengths - 0.5 * resolution, 0.0) / pitch).astype(np.int64)
    beams = np.repeat(np.arange(len(lengths), dtype=np.int64), counts)
    ordinals = np.arange(len(beams), dtype=np.float64) - np.repeat(np.cumsum(counts) - counts, counts)
    return beams, ordinals * pitch


def differing(left: OccupancyGrid, right: OccupancyGrid) -> int:
    """How many cells of two maps differ in any bit; maps of different places differ everywhere."""
    if left.geometry != right.geometry:
        return max(left.cells.size, right.cells.size)
    return int(np.count_nonzero(left.cells != right.cells))


def known_bounds(*grids: OccupancyGrid) -> tuple[slice, slice]:
    """Rows and columns in which any of these maps of one place knows something; everything if none does."""
    known = np.logical_or.reduce([grid.cells != 0 for grid in grids])
    return _extent(known.any(axis=1)), _extent(known.any(axis=0))


def _extent(line: NDArray[np.bool_]) -> slice:
    (where,) = np.nonzero(line)
    return slice(int(where[0]), int(where[-1]) + 1) if len(where) else slice(0, len(line))
