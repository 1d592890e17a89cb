"""Draws sequence diagrams: each text file beside this one becomes an SVG. `python docs/pictures/sequence.py` does all.

The first line of a text is its title, the second a description for those who cannot see it. Then, one a line:

    root home: home of the address     a column; the first word says where it lives: root, process, store or outside
    a -> b: text                       a numbered step, from one column to another
    a ..> b: text                      the same, drawn dashed: an answer, or something that is only heard of
    a: text                            a numbered step within one column
    = text                             a line across: another phase begins
    x a: text                          the process or actor in this column dies here
"""

from __future__ import annotations

import re
from html import escape
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
COLOURS = {
    "root": ("#dbeafe", "#2563eb"),
    "process": ("#fae8ff", "#a21caf"),
    "store": ("#fef3c7", "#b45309"),
    "outside": ("#dcfce7", "#15803d"),
}
INK, GREY, RED, CARD = "#1f2937", "#64748b", "#b91c1c", "#f8fafc"
WIDTH, MARGIN, HEAD, ROW = 800, 20, 58, 40
STYLE = 'aria-labelledby="t d" font-family="sans-serif" font-size="13"'
ARROW = f"""<defs><marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" orient="auto">
<path d="M0 0 L10 5 L0 10 z" fill="{INK}"/></marker></defs>"""
CHARACTER = 6.7
"""Pixels that a character takes at the size of a label, on average."""
COLUMN = re.compile(r"(root|process|store|outside) (\w+): (.+)")
STEP = re.compile(r"(\w+) (->|\.\.>) (\w+): (.+)")
NOTE = re.compile(r"(\w+): (.+)")
DEATH = re.compile(r"x (\w+): (.+)")


class Column(NamedTuple):
    """One of those who take part."""

    where: str
    name: str
    label: str


class Row(NamedTuple):
    """One line of the diagram; `kind` is "->", "..>", "note", "phase" or "death"."""

    kind: str
    start: int
    end: int
    text: str


class Picture(NamedTuple):
    """A text, read."""

    title: str
    description: str
    columns: list[Column]
    rows: list[Row]


def read(text: str) -> Picture:
    """Read a text.

    Raises:
        ValueError: a line says nothing that can be drawn.
    """
    title, description, *lines = text.splitlines()
    columns, rows, places = list[Column](), list[Row](), dict[str, int]()
    for line in filter(None, lines):
        if found := COLUMN.fullmatch(line):
            places[found[2]] = len(columns)
            columns.append(Column(found[1], found[2], found[3]))
        elif found := STEP.fullmatch(line):
            rows.append(Row(found[2], places[found[1]], places[found[3]], found[4]))
        elif found := DEATH.fullmatch(line):
            rows.append(Row("death", places[found[1]], places[found[1]], found[2]))
        elif line.startswith("= "):
            rows.append(Row("phase", 0, 0, line[2:]))
        elif found := NOTE.fullmatch(line):
            rows.append(Row("note", places[found[1]], places[found[1]], found[2]))
        else:
            raise ValueError(f"{title}: this line cannot be drawn: {line}")
    return Picture(title, description, columns, rows)


def width_of(text: str) -> int:
    """The pixels that a label is taken to need."""
    return round(len(text) * CHARACTER)


def middles(picture: Picture) -> list[int]:
    """The x of each column: evenly spread over the width."""
    first = MARGIN + max(width_of(picture.columns[0].label) // 2 + 12, 40)
    last = WIDTH - MARGIN - max(width_of(picture.columns[-1].label) // 2 + 12, 40)
    return [first + (last - first) * number // (len(picture.columns) - 1) for number in range(len(picture.columns))]


def draw(picture: Picture) -> str:
    """The SVG of a picture, on a light card, so that it can be read on a dark page too."""
    xs, columns = middles(picture), picture.columns
    height = HEAD + ROW * len(picture.rows) + 30
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" role="img" {STYLE}>',
        f'<title id="t">{escape(picture.title)}</title>',
        f'<desc id="d">{escape(picture.description)}</desc>',
        ARROW,
        f'<rect width="{WIDTH}" height="{height}" rx="10" fill="{CARD}"/>',
    ]
    for x, column in zip(xs, columns, strict=True):
        fill, stroke = COLOURS[column.where]
        half = width_of(column.label) // 2 + 12
        out += [
            f'<path d="M{x} {HEAD - 10} V{height - 14}" stroke="{stroke}" stroke-dasharray="2 4"/>',
            f'<rect x="{x - half}" y="14" width="{2 * half}" height="32" rx="7" fill="{fill}" stroke="{stroke}"/>',
            f'<text x="{x}" y="34" text-anchor="middle" fill="{INK}">{escape(column.label)}</text>',
        ]
    number = 0
    for place, row in enumerate(picture.rows):
        y = HEAD + ROW * place + 26
        if row.kind not in ("phase", "death"):
            number += 1
        out += drawn(row, number, y, xs)
    return "\n".join([*out, "</svg>", ""])


def drawn(row: Row, number: int, y: int, xs: list[int]) -> list[str]:
    """One line of the diagram."""
    x, end = xs[row.start], xs[row.end]
    match row.kind:
        case "phase":
            return [
                f'<path d="M{MARGIN} {y} H{WIDTH - MARGIN}" stroke="{GREY}"/>',
                label(row.text, MARGIN, y - 8, GREY),
            ]
        case "death":
            cross = f'<path d="M{x - 8} {y - 12} l16 16 m0 -16 l-16 16" stroke="{RED}" stroke-width="3"/>'
            return [beside(row.text, x, y + 1, RED), cross]
        case "note":
            return [beside(row.text, x, y, INK), badge(x, y - 4, number)]
        case _:
            dashes = ' stroke-dasharray="6 4"' if row.kind == "..>" else ""
            side = 1 if end > x else -1
            line = f'<path d="M{x + 10 * side} {y} H{end - 2 * side}" stroke="{INK}" stroke-width="1.4"{dashes}'
            text = label(row.text, (x + end - width_of(row.text)) // 2, y - 12, INK)
            return [f'{line} marker-end="url(#a)"/>', text, badge(x, y, number)]


def beside(text: str, x: int, y: int, colour: str) -> str:
    """A text to the right of a column, or to its left where there is no room."""
    right = x + 16
    return label(text, right if right + width_of(text) <= WIDTH - MARGIN else right - 32 - width_of(text), y, colour)


def label(text: str, x: int, y: int, colour: str) -> str:
    """A text that begins at x, or earlier if it would not fit; lines behind it are covered."""
    x = max(MARGIN, min(x, WIDTH - MARGIN - width_of(text)))
    cover = f'stroke="{CARD}" stroke-width="5" paint-order="stroke" stroke-linejoin="round"'
    return f'<text x="{x}" y="{y}" fill="{colour}" {cover}>{escape(text)}</text>'


def badge(x: int, y: int, number: int) -> str:
    """The number of a step."""
    return (
        f'<circle cx="{x}" cy="{y}" r="10" fill="{INK}"/>'
        f'<text x="{x}" y="{y + 4}" text-anchor="middle" font-size="11" fill="#ffffff">{number}</text>'
    )


if __name__ == "__main__":
    for file in sorted(HERE.glob("*.txt")):
        file.with_suffix(".svg").write_text(draw(read(file.read_text("utf-8"))), "utf-8")
