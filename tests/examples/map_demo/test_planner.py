"""The planner: the known way, and none where there is none."""

from itertools import pairwise

import numpy as np
import pytest
from map_demo.grid import Geometry, OccupancyGrid
from map_demo.planner import find_path, free_space, is_way_free, length

FREE, WALL = -8, 17


def scene(*rows: str) -> OccupancyGrid:
    """A map drawn with north up: `.` free, `#` occupied, `?` never seen; a cell is a metre, so a robot is one cell."""
    cells = np.array([[{".": FREE, "#": WALL, "?": 0}[c] for c in row] for row in reversed(rows)], np.int8)
    return OccupancyGrid(Geometry(1.0, 0.0, 0.0, cells.shape[1], cells.shape[0]), cells)


WALLED = scene(
    ".........",
    ".........",
    "######...",
    ".........",
    ".........",
)


def test_the_way_round_the_wall() -> None:
    path = find_path(WALLED, (0.5, 0.5), (0.5, 4.5))
    assert path is not None
    assert (path[0], path[-1]) == ((0.5, 0.5), (0.5, 4.5))
    assert any(x > 6.0 for x, _ in path), "it goes round the open end"
    assert 14.0 < length(path) < 20.0
    for here, there in pairwise(path):
        assert is_way_free(WALLED, here, there)


def test_a_straight_way_has_two_points() -> None:
    assert find_path(WALLED, (0.5, 0.5), (8.5, 0.5)) == [(0.5, 0.5), (8.5, 0.5)]


def test_here_to_here() -> None:
    assert find_path(WALLED, (0.5, 0.5), (0.6, 0.6)) == [(0.5, 0.5)]


def test_no_way_through_a_closed_wall() -> None:
    closed = scene(".....", ".....", "#####", ".....", ".....")
    assert find_path(closed, (0.5, 0.5), (0.5, 4.5)) is None
    assert not is_way_free(closed, (0.5, 0.5), (0.5, 4.5))


def test_the_wave_does_not_wrap_round_the_edge() -> None:
    assert find_path(scene("..#..", "..#.."), (0.5, 0.5), (4.5, 0.5)) is None


@pytest.mark.parametrize("goal", [(4.5, 2.5), (0.5, 1.5), (99.0, 0.5), (-3.0, 0.5)])
def test_no_way_into_a_wall_beside_it_or_off_the_map(goal: tuple[float, float]) -> None:
    assert find_path(WALLED, (0.5, 0.5), goal) is None
    assert not is_way_free(WALLED, (0.5, 0.5), goal)


def test_what_was_never_seen_is_not_free() -> None:
    assert not is_way_free(scene("..?.."), (0.5, 0.5), (4.5, 0.5))
    assert is_way_free(scene("....."), (0.5, 0.5), (4.5, 0.5))


def test_walls_are_inflated_by_the_robots_radius() -> None:
    free = free_space(scene(".......", "...#...", ".......").cells, radius=2)
    assert free.tolist() == [
        [True, True, False, False, False, True, True],
        [True, False, False, False, False, False, True],
        [True, True, False, False, False, True, True],
    ]
