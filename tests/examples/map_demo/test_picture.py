"""The picture: both maps side by side, north up, differences in red."""

from pathlib import Path

import numpy as np
import pytest
from map_demo.grid import Geometry, OccupancyGrid
from map_demo.picture import BORDER, DIFFERENT, FREE, OCCUPIED, TITLE, UNKNOWN, draw, save
from PIL import Image

PLACE = Geometry(1.0, 0.0, 0.0, 4, 3)


def grid(*rows: list[int]) -> OccupancyGrid:
    return OccupancyGrid(PLACE, np.array(rows, np.int8))


LEFT = grid([17, -8, -8, -8], [0, 0, 0, 0], [-8, 0, 0, 17])
RIGHT = grid([17, -8, 17, -8], [0, 0, 0, 0], [-8, 0, 0, 17])


def test_the_panels_show_what_the_maps_hold() -> None:
    sheet = draw(LEFT, RIGHT, titles=("a", "b"))
    assert sheet.size == (2 * 4 + 3 * BORDER, 3 + TITLE + BORDER)
    for x0 in (BORDER, BORDER + 4 + BORDER):
        panel = [[sheet.getpixel((x0 + column, TITLE + row)) for column in range(4)] for row in range(3)]
        assert panel == [
            [FREE, UNKNOWN, UNKNOWN, OCCUPIED],
            [UNKNOWN] * 4,
            [OCCUPIED, FREE, DIFFERENT, FREE],
        ]


def test_a_path_is_drawn_over_the_map() -> None:
    plain, drawn = (draw(LEFT, LEFT, titles=("a", "b"), path=path) for path in ([], [(0.5, 0.5), (3.5, 2.5)]))
    assert plain.tobytes() != drawn.tobytes()


def test_an_empty_map_can_be_drawn() -> None:
    draw(OccupancyGrid(PLACE), OccupancyGrid(PLACE), titles=("a", "b"))


def test_maps_of_different_places_are_refused() -> None:
    with pytest.raises(ValueError, match="not of the same place"):
        draw(LEFT, OccupancyGrid(Geometry(1.0, 0.0, 0.0, 2, 2)), titles=("a", "b"))


def test_it_is_written_whole_under_its_name(tmp_path: Path) -> None:
    file = tmp_path / "maps.png"
    save(draw(LEFT, RIGHT, titles=("a", "b")), file)
    with Image.open(file) as image:
        assert image.format == "PNG"
    assert list(tmp_path.iterdir()) == [file]
