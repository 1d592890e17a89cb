"""The rows of `holdfast top`: a list that is drawn line by line, for it is drawn again each second."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from rich.segment import Segment
from rich.style import Style
from textual.binding import Binding, BindingType
from textual.geometry import Region, Size
from textual.scroll_view import ScrollView
from textual.strip import Strip

GAP = "  "
HEAD = Style(bold=True, underline=True)
CURSOR = Style(reverse=True)
WIDEST = 60
"""Characters of a column at most."""


class RowList(ScrollView, can_focus=True):
    """A list with columns, a fixed head and a cursor.

    Args:
        columns: their names.
        numbers: the names of those that stand to the right.
        style_of: the style of a cell, by the name of its column and its text; None: as all others.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up,k", "move(-1)", show=False),
        Binding("down,j", "move(1)", show=False),
        Binding("pageup", "move(-20)", show=False),
        Binding("pagedown", "move(20)", show=False),
        Binding("home", "move(-1000000)", show=False),
        Binding("end", "move(1000000)", show=False),
    ]

    def __init__(
        self, columns: tuple[str, ...], numbers: frozenset[str], style_of: Callable[[str, str], Style | None]
    ) -> None:
        super().__init__()
        self._columns, self._numbers, self._style_of = columns, numbers, style_of
        self._widths = tuple(map(len, columns))
        self._cells: list[tuple[str, ...]] = []
        self._keys: list[str] = []
        self._cursor = 0

    @property
    def keys(self) -> list[str]:
        """The keys of the rows, from above."""
        return list(self._keys)

    @property
    def key_at_cursor(self) -> str:
        """The key of the row at the cursor; empty if there is none."""
        return self._keys[self._cursor] if self._cursor < len(self._keys) else ""

    def cell(self, key: str, column: str) -> str:
        """The text of a cell."""
        return self._cells[self._keys.index(key)][self._columns.index(column)]

    def show_rows(self, rows: dict[str, tuple[str, ...]]) -> None:
        """Show these rows, by key; the cursor stays with its row. Nothing is drawn that is as it was."""
        keys, cells, at = list(rows), list(rows.values()), self.key_at_cursor
        if (keys, cells) == (self._keys, self._cells):
            return
        self._keys, self._cells = keys, cells
        self._cursor = keys.index(at) if at in rows else min(self._cursor, max(0, len(keys) - 1))
        longest = [max(map(len, column)) for column in zip(self._columns, *cells, strict=True)]
        self._widths = tuple(min(one, WIDEST) for one in longest)
        self.virtual_size = Size(sum(self._widths) + len(GAP) * len(self._widths), len(keys) + 1)
        self.refresh()

    def action_move(self, rows: int) -> None:
        """Move the cursor by so many rows, as far as there are any."""
        self._cursor = max(0, min(self._cursor + rows, len(self._keys) - 1))
        top = int(self.scroll_offset.y)
        room = max(1, self.scrollable_content_region.height - 1)
        if not top <= self._cursor < top + room:
            self.scroll_to(y=self._cursor if self._cursor < top else self._cursor - room + 1, animate=False)
        self.refresh(Region(0, 0, self.size.width, self.size.height))

    def render_line(self, y: int) -> Strip:
        """One line of what is to be seen: the head, or a row."""
        scroll_x, scroll_y = self.scroll_offset
        at = y - 1 + int(scroll_y)
        if y == 0:
            strip = Strip([self._piece(name, name, width, HEAD) for name, width in self._sized(self._columns)])
        elif at < len(self._cells):
            base = CURSOR if at == self._cursor else None
            pieces = zip(self._columns, self._sized(self._cells[at]), strict=True)
            strip = Strip(
                [self._piece(name, text, width, base or self._style_of(name, text)) for name, (text, width) in pieces]
            )
        else:
            return Strip.blank(self.size.width)
        return strip.crop_extend(int(scroll_x), int(scroll_x) + self.size.width, None)

    def _sized(self, cells: tuple[str, ...]) -> list[tuple[str, int]]:
        return list(zip(cells, self._widths, strict=True))

    def _piece(self, column: str, text: str, width: int, style: Style | None) -> Segment:
        shown = text if len(text) <= width else f"{text[: width - 1]}…"
        return Segment((shown.rjust(width) if column in self._numbers else shown.ljust(width)) + GAP, style)
