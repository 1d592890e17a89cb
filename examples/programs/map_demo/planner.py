"""Ways through an occupancy grid: is the straight way free, and which way leads there."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .grid import Cells, OccupancyGrid

Mask = NDArray[np.bool_]
Cell = tuple[int, int]
Position = tuple[float, float]

ROBOT_RADIUS = 0.3  # metres


def free_space(cells: Cells, radius: int) -> Mask:
    """Cells where a robot of this radius (in cells) may stand: seen free, nothing occupied nearer than that.

    >>> free_space(np.array([[-8, -8, -8, 17, 0]], np.int8), radius=1).tolist()
    [[True, True, False, False, False]]
    """
    occupied = np.pad(cells > 0, radius)
    blocked = np.zeros(cells.shape, np.bool_)
    rows, columns = cells.shape
    for down in range(2 * radius + 1):
        for right in range(2 * radius + 1):
            if (down - radius) ** 2 + (right - radius) ** 2 <= radius**2:
                blocked |= occupied[down : down + rows, right : right + columns]
    return (cells < 0) & ~blocked


def is_way_free(grid: OccupancyGrid, start: Position, goal: Position) -> bool:
    """Whether a robot can drive straight from start to goal over cells known to be free."""
    free = free_space(grid.cells, _radius(grid))
    return _sees(free, grid.geometry.cell(*start), grid.geometry.cell(*goal))


def find_path(grid: OccupancyGrid, start: Position, goal: Position) -> list[Position] | None:
    """The way of fewest cells from start to goal as corner points, both ends included; None if there is none."""
    free = free_space(grid.cells, _radius(grid))
    cells = _shortest(free, grid.geometry.cell(*start), grid.geometry.cell(*goal))
    return None if cells is None else [grid.geometry.position(*cell) for cell in _straighten(free, cells)]


def length(path: list[Position]) -> float:
    """Length of a path in metres.

    >>> length([(0.0, 0.0), (3.0, 4.0), (3.0, 5.0)])
    6.0
    """
    return sum(math.dist(here, there) for here, there in pairwise(path))


def _radius(grid: OccupancyGrid) -> int:
    return max(1, round(ROBOT_RADIUS / grid.geometry.resolution))


def _holds(free: Mask, cell: Cell) -> bool:
    rows, columns = free.shape
    return bool(0 <= cell[0] < rows and 0 <= cell[1] < columns)


def _sees(free: Mask, here: Cell, there: Cell) -> bool:
    if not (_holds(free, here) and _holds(free, there)):
        return False
    steps = 2 * max(abs(there[0] - here[0]), abs(there[1] - here[1])) + 1
    rows = np.rint(np.linspace(here[0], there[0], steps)).astype(np.int64)
    columns = np.rint(np.linspace(here[1], there[1], steps)).astype(np.int64)
    along: Mask = free[rows, columns]
    return bool(along.all())


def _shortest(free: Mask, start: Cell, goal: Cell) -> list[Cell] | None:
    if not (_holds(free, start) and _holds(free, goal) and free[start] and free[goal]):
        return None
    # A border of one closed cell: a neighbour's flat index then never wraps into another row.
    closed = np.pad(free, 1)
    width = closed.shape[1]
    first, last = ((row + 1) * width + column + 1 for row, column in (start, goal))
    distances = _wavefront(closed.reshape(-1), width, first, last)
    if distances[last] < 0:
        return None
    return [(flat // width - 1, flat % width - 1) for flat in _descend(distances, width, last)]


def _wavefront(free: Mask, width: int, start: int, goal: int) -> NDArray[np.int32]:
    """Steps from start to each cell reached, -1 elsewhere; it stops when the wave is at the goal."""
    distances = np.full(free.shape, -1, np.int32)
    owner = np.zeros(free.shape, np.int32)
    distances[start] = step = 0
    wave = np.array([start])
    while len(wave) and distances[goal] < 0:
        step += 1
        wave = np.concatenate((wave - width, wave - 1, wave + 1, wave + width))
        wave = wave[free[wave] & (distances[wave] < 0)]
        distances[wave] = step
        owner[wave] = np.arange(len(wave), dtype=np.int32)
        wave = wave[owner[wave] == np.arange(len(wave))]  # a cell reached from two sides stays in the wave once
    return distances


def _descend(distances: NDArray[np.int32], width: int, goal: int) -> list[int]:
    path = [goal]
    while distances[path[-1]] > 0:
        here = path[-1]
        neighbours = (here - width, here - 1, here + 1, here + width)
        path.append(next(cell for cell in neighbours if distances[cell] == distances[here] - 1))
    return path[::-1]


def _straighten(free: Mask, cells: list[Cell]) -> list[Cell]:
    """Leave out the cells between corners, as long as the straight way between them is free."""
    kept = [cells[0]]
    for before, cell in pairwise(cells):
        if not _sees(free, kept[-1], cell):
            kept.append(before)
    return [*kept, cells[-1]] if len(cells) > 1 else kept
