"""Sequence charts of a run: who handled what, from whom, when, and how it changed the actor. As text and as HTML."""

from __future__ import annotations

import html
import reprlib
from collections.abc import Sequence
from typing import Any, NamedTuple

from ...actors.kernel.cell import Cell
from ...actors.kernel.envelope import Item
from ...actors.kernel.message import message_of
from ...actors.kernel.node import Node
from ..library_code import is_module_of_library
from ..turns import Substitute, TurnWatcher
from .turn_log import told

SHOWN = 40
"""Turns that the text shows, the last ones."""
WIDEST = 6
"""Columns of the text; where more actors take part, each row names who acts instead."""
COLUMN = 20
BRIEF = reprlib.Repr()
BRIEF.maxother = BRIEF.maxstring = 60

STYLE = """body{font:14px system-ui,sans-serif;margin:2em}h1{font-size:18px}
pre{background:#f4f4f4;padding:1em;overflow:auto}
svg text{font:12px ui-monospace,monospace}.life{stroke:#bbb}.sent{stroke:#555;marker-end:url(#tip)}
.turn{fill:#3b6ea5}.crash{fill:#b03030}.name{font-weight:bold}.state{fill:#666}.time{fill:#999}"""


class ChartRow(NamedTuple):
    """One turn: when on the virtual clock, whose, what it handled, who sent that, and what it changed."""

    at: float
    path: str
    sender: str
    what: str
    change: str
    crashed: bool = False


class Recorder(TurnWatcher):
    """Draws up the rows of a run as its turns happen."""

    def __init__(self) -> None:
        self.rows: list[ChartRow] = []
        self._places: dict[object, str] = {}  # by node: what is written before its addresses
        self._last: dict[str, str] = {}  # by address: in which of these places there was a turn last
        self._open: dict[Cell, tuple[int, int, dict[str, str]]] = {}

    def call(self, node: Node, name: str) -> None:
        """The program of a node has this name, or none."""
        if name:
            self._places[node] = f"{name}:"

    def begins(self, cell: Cell, item: Any) -> Substitute | None:
        message = message_of(item)
        what = told(cell, item) if message is None else BRIEF.repr(message)
        sender: Cell | None = item.sender if isinstance(item, Item) else None
        self._open[cell] = len(self.rows), cell.life, _state(cell)
        place = self._places.get(cell.node, "")
        source = "" if sender is None else self._place_of(sender, place) + sender.path
        self._last[cell.path] = place
        self.rows.append(ChartRow(cell.node.loop.time(), place + cell.path, source, what, ""))
        return None

    def _place_of(self, sender: Cell, place: str) -> str:
        """Where the sender of a message is that is handled in a place: there, or where its address had a turn last."""
        is_here = sender.path.split("/", 2)[1:2] == [sender.node.name]
        return place if is_here else self._last.get(sender.path, "")

    def ended(self, cell: Cell, item: Any) -> None:
        number, life, before = self._open.pop(cell, (-1, 0, {}))
        if number < 0:
            return
        has_ended = cell.actor is None or cell.life != life
        after = {} if has_ended else _state(cell)
        parts = [f"{name}: {before.get(name, '-')} -> {now}" for name, now in after.items() if before.get(name) != now]
        change = "its life ends" if has_ended else ", ".join(parts)
        self.rows[number] = self.rows[number]._replace(change=change, crashed=has_ended)


def _state(cell: Cell) -> dict[str, str]:
    """The variables of an actor, in brief. Reading them calls code of theirs, which may raise."""
    actor = cell.actor
    if actor is None or is_module_of_library(type(actor).__module__):  # What is ours is no news to its user.
        return {}
    found: dict[str, str] = {}
    for name, value in vars(actor).items():
        if name.startswith("__") or name in ("ctx", "_table"):
            continue
        try:
            found[name] = BRIEF.repr(value)
        except Exception as error:  # A repr of the user's: the chart says so and goes on.
            found[name] = f"<{type(error).__name__} in its repr>"
    return found


def columns(rows: Sequence[ChartRow]) -> list[str]:
    """Who takes part, in order of appearance."""
    found: dict[str, None] = {}
    for row in rows:
        if row.sender:
            found[row.sender] = None
        found[row.path] = None
    return list(found)


def short(path: str) -> str:
    """The end of an address, behind the program that it is in, if that has a name."""
    program, colon, address = path.rpartition(":")
    return f"{program}{colon}{address.rsplit('/', 1)[-1] or address}"


def as_text(rows: Sequence[ChartRow]) -> str:
    """The last turns as a chart of characters: `*` is the turn, an arrow leads there from the sender's column."""
    shown = rows[-SHOWN:]
    if not shown:
        return ""
    names = columns(shown)
    lines = [f"the last {len(shown)} of {len(rows)} turns:"]
    if len(names) > WIDEST:
        for row in shown:
            source = f"{row.sender} -> " if row.sender else ""
            lines.append(f"  {row.at:>9.3f}  {source}{row.path}: {row.what}{_change(row)}")
        return "\n".join(lines)
    width = min(COLUMN, max(len(short(name)) for name in names) + 3)
    lines.append("  " + " " * 11 + "".join(short(name)[: width - 1].ljust(width) for name in names))
    for row in shown:
        cells = ["|".ljust(width)] * len(names)
        to = names.index(row.path)
        text = list("".join(cells))
        if row.sender and row.sender != row.path:
            start = names.index(row.sender)
            low, high = sorted((start, to))
            text[low * width + 1 : high * width] = "-" * ((high - low) * width - 1)
            text[start * width] = "+"
            text[to * width + (1 if to < start else -1)] = "<" if to < start else ">"
        text[to * width] = "x" if row.crashed else "*"
        lines.append(f"  {row.at:>9.3f}  {''.join(text)} {row.what}{_change(row)}")
    return "\n".join(lines)


def _change(row: ChartRow) -> str:
    return f"   [{row.change}]" if row.change else ""


def as_html(rows: Sequence[ChartRow], title: str, note: str) -> str:
    """The whole run as a page of its own."""
    names = columns(rows)
    place = {name: 110 + 150 * index for index, name in enumerate(names)}
    width, height = 150 * len(names) + 720, 24 * len(rows) + 70
    parts = [f'<svg width="{width}" height="{height}" xmlns="http://www.w3.org/2000/svg">']
    parts.append(
        '<defs><marker id="tip" markerWidth="8" markerHeight="8" refX="7" refY="3" orient="auto">'
        '<path d="M0,0 L7,3 L0,6 z" fill="#555"/></marker></defs>'
    )
    for name, x in place.items():
        parts.append(f'<text class="name" x="{x}" y="18" text-anchor="middle">{html.escape(short(name))}')
        parts.append(f"<title>{html.escape(name)}</title></text>")
        parts.append(f'<line class="life" x1="{x}" y1="28" x2="{x}" y2="{height - 10}"/>')
    for number, row in enumerate(rows):
        y, x = 48 + 24 * number, place[row.path]
        parts.append(f'<text class="time" x="4" y="{y + 4}">{row.at:.3f}</text>')
        if row.sender and row.sender != row.path:
            start = place[row.sender]
            end = x + (-8 if start < x else 8)
            parts.append(f'<line class="sent" x1="{start}" y1="{y}" x2="{end}" y2="{y}"/>')
        kind = "crash" if row.crashed else "turn"
        parts.append(f'<rect class="{kind}" x="{x - 6}" y="{y - 8}" width="12" height="16" rx="3"/>')
        after = place[names[-1]] + 30
        text = f'{html.escape(row.what)} <tspan class="state">{html.escape(row.change)}</tspan>'
        parts.append(f'<text x="{after}" y="{y + 4}">{text}</text>')
    parts.append("</svg>")
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    body = f"<h1>{html.escape(title)}</h1><pre>{html.escape(note)}</pre>{''.join(parts)}"
    return f'<!doctype html><html lang="en">{head}{body}</html>\n'
