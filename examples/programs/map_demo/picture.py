"""Two maps side by side as a PNG, with every cell in which they differ marked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from .grid import OccupancyGrid, known_bounds
from .planner import Position

Pixels = NDArray[np.uint8]

UNKNOWN, FREE, OCCUPIED = (176, 182, 190), (255, 255, 255), (24, 28, 36)
DIFFERENT, WAY, INK, PAPER = (226, 32, 44), (28, 110, 214), (24, 28, 36), (244, 245, 247)
BORDER = 16
TITLE = 44


def draw(
    left: OccupancyGrid, right: OccupancyGrid, *, titles: tuple[str, str], path: list[Position] | None = None
) -> Image.Image:
    """Draw two maps of one place, north up, cut to what is known; differing cells are red in both.

    Raises:
        ValueError: the maps are not of the same place.
    """
    if left.geometry != right.geometry:
        raise ValueError("the two maps are not of the same place")
    bounds = known_bounds(left, right)
    different = left.cells != right.cells
    panels = [_panel(grid, different, bounds, path or []) for grid in (left, right)]
    width, height = panels[0].size
    sheet = Image.new("RGB", (2 * width + 3 * BORDER, height + TITLE + BORDER), PAPER)
    pen = ImageDraw.Draw(sheet)
    for column, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        x = BORDER + column * (width + BORDER)
        sheet.paste(panel, (x, TITLE))
        pen.text((x, 10), title, fill=INK, font=ImageFont.load_default(22))
    return sheet


def save(image: Image.Image, file: Path) -> None:
    """Write the picture as a PNG, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    unfinished = file.with_name(f".{file.name}.part")
    image.save(unfinished, format="PNG", optimize=True)
    unfinished.replace(file)


def _panel(
    grid: OccupancyGrid, different: NDArray[np.bool_], bounds: tuple[slice, slice], path: list[Position]
) -> Image.Image:
    pixels = _pixels(grid.cells[bounds])
    pixels[different[bounds]] = DIFFERENT
    image = Image.fromarray(np.ascontiguousarray(pixels[::-1]))
    if len(path) > 1:
        points = [_point(grid, bounds, image.height, position) for position in path]
        ImageDraw.Draw(image).line(points, fill=WAY, width=3, joint="curve")
    return image


def _pixels(cells: NDArray[np.int8]) -> Pixels:
    pixels = np.empty((*cells.shape, 3), np.uint8)
    pixels[:] = UNKNOWN
    pixels[cells < 0] = FREE
    pixels[cells > 0] = OCCUPIED
    return pixels


def _point(grid: OccupancyGrid, bounds: tuple[slice, slice], height: int, position: Position) -> tuple[float, float]:
    row, column = grid.geometry.cell(*position)
    return column - bounds[1].start, height - 1 - (row - bounds[0].start)
