"""The occupancy grid: a small scene whose map is known, and the same bits in each run."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from map_demo.grid import (
    HIT,
    LIMIT,
    MISS,
    MOST_CELLS,
    USABLE_RANGE,
    Geometry,
    OccupancyGrid,
    differing,
    known_bounds,
)

SMALL = Geometry(resolution=1.0, x0=0.0, y0=0.0, columns=10, rows=5)


def look_east(grid: OccupancyGrid, distance: float, position: tuple[float, float] = (0.5, 2.5)) -> None:
    """One beam along the row of the position."""
    grid.update(position, 0.0, np.array([distance], np.float32), start=0.0, step=0.1, max_range=50.0)


def test_a_beam_frees_the_cells_it_crosses_and_hits_the_one_it_ends_in() -> None:
    grid = OccupancyGrid(SMALL)
    look_east(grid, 6.0)
    assert grid.cells[2].tolist() == [-MISS] * 6 + [HIT, 0, 0, 0]
    assert not grid.cells[[0, 1, 3, 4]].any()


def test_a_room() -> None:
    """A robot in the middle of a square room of 8 m sees four walls and a free floor."""
    grid = OccupancyGrid(Geometry.covering(0.0, 0.0, 0.0, 0.0, margin=5.0))
    bearings = np.radians(np.arange(720) / 2)
    ranges = (4.0 / np.maximum(np.abs(np.cos(bearings)), np.abs(np.sin(bearings)))).astype(np.float32)
    for _ in range(3):
        grid.update((0.0, 0.0), 0.0, ranges, start=0.0, step=math.radians(0.5), max_range=50.0)
    rows, columns = np.nonzero(grid.cells > 0)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        x, y = grid.geometry.position(row, column)
        assert max(abs(x), abs(y)) == pytest.approx(4.0, abs=0.25)
    assert len(rows) >= 4 * 39
    inside = [grid.at(x / 5, y / 5) for x in range(-18, 19) for y in range(-18, 19)]
    assert max(inside) < 0
    assert grid.at(4.6, 0.0) == 0


def test_a_hit_beats_a_beam_that_passes_through_the_same_cell() -> None:
    grid = OccupancyGrid(SMALL)
    ranges = np.array([3.0, 8.0], np.float32)
    grid.update((0.5, 2.5), 0.0, ranges, start=0.0, step=0.0, max_range=50.0)
    assert grid.cells[2, 3] == HIT


def test_nothing_came_back_says_nothing() -> None:
    grid = OccupancyGrid(SMALL)
    for distance in (50.0, 51.2, math.inf, math.nan):
        look_east(grid, distance)
    assert not grid.cells.any()


def test_a_range_too_far_to_use_frees_but_does_not_hit() -> None:
    grid = OccupancyGrid(Geometry(1.0, 0.0, 0.0, 40, 3))
    look_east(grid, USABLE_RANGE + 5.0, (0.5, 1.5))
    assert grid.at(USABLE_RANGE - 2.0, 1.5) == -MISS
    assert grid.cells.max() == 0


def test_evidence_is_limited_and_beams_may_leave_the_grid() -> None:
    grid = OccupancyGrid(SMALL)
    for _ in range(50):
        look_east(grid, 6.0)
        look_east(grid, 40.0, (0.5, 3.5))
    assert (grid.cells.max(), grid.cells.min()) == (LIMIT, -LIMIT)
    assert grid.cells[3].tolist() == [-LIMIT] * 10


scans = st.lists(
    st.tuples(
        st.floats(-30, 30), st.floats(-30, 30), st.floats(-4, 4), st.lists(st.floats(0, 60, width=32), max_size=20)
    ),
    max_size=8,
)


@given(scans)
def test_the_same_scans_give_the_same_bits(taken: list[tuple[float, float, float, list[float]]]) -> None:
    """Also if the second map was saved and brought back half-way."""
    geometry = Geometry.covering(-20.0, -20.0, 20.0, 20.0)
    first, second = OccupancyGrid(geometry), OccupancyGrid(geometry)
    for number, (x, y, heading, ranges) in enumerate(taken):
        if number == len(taken) // 2:
            cells = np.frombuffer(bytearray(second.cells.tobytes()), np.int8).reshape(second.cells.shape)
            second = OccupancyGrid(geometry, cells)
        for grid in (first, second):
            grid.update((x, y), heading, np.array(ranges, np.float32), start=-1.5, step=0.02, max_range=50.0)
    assert first.cells.tobytes() == second.cells.tobytes()
    assert differing(first, second) == 0


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(0, 3000), st.floats(0, 3000))
def test_a_grid_covers_its_poses_within_its_limit(x: float, y: float, width: float, height: float) -> None:
    geometry = Geometry.covering(x, y, x + width, y + height)
    assert geometry.rows * geometry.columns <= MOST_CELLS * 1.01
    assert geometry.holds(*geometry.cell(x, y))
    assert geometry.holds(*geometry.cell(x + width, y + height))


def test_a_window_is_a_copy_in_its_place() -> None:
    grid = OccupancyGrid(SMALL)
    look_east(grid, 6.0)
    window = grid.window((4.2, 1.1), (7.9, 3.3))
    assert window.cells.shape == (3, 4)
    assert window.at(6.5, 2.5) == grid.at(6.5, 2.5) == HIT
    window.cells[:] = 1
    assert grid.at(4.5, 2.5) == -MISS


@pytest.mark.parametrize(("low", "high"), [((-9.0, -9.0), (99.0, 99.0)), ((50.0, 50.0), (60.0, 60.0))])
def test_a_window_is_cut_to_the_grid(low: tuple[float, float], high: tuple[float, float]) -> None:
    window = OccupancyGrid(SMALL).window(low, high)
    assert window.cells.size in (1, SMALL.rows * SMALL.columns)


def test_what_differs_and_what_is_known() -> None:
    left, right = OccupancyGrid(SMALL), OccupancyGrid(SMALL)
    assert known_bounds(left, right) == (slice(0, 5), slice(0, 10))
    look_east(left, 6.0)
    assert differing(left, right) == 7
    assert known_bounds(left, right) == (slice(2, 3), slice(0, 7))
    assert differing(left, OccupancyGrid(Geometry(1.0, 0.0, 0.0, 3, 3))) == 50


def test_outside_is_unknown() -> None:
    assert OccupancyGrid(SMALL).at(-1.0, 99.0) == 0
