"""The chart of a run as a page: the turns that lead to the failure, and behind a switch all of them."""

from __future__ import annotations

import html
from collections.abc import Sequence

from .chart_recorder import ChartRow
from .chart_text import columns, heading, short

STYLE = """body{font:14px system-ui,sans-serif;margin:2em}h1{font-size:18px}
pre{background:#f4f4f4;padding:1em;overflow:auto}
svg text{font:12px ui-monospace,monospace}.life{stroke:#bbb}.sent{stroke:#555;marker-end:url(#tip)}
.turn{fill:#3b6ea5}.crash{fill:#b03030}.name{font-weight:bold}.state{fill:#666}.time{fill:#999}
.whole,#all:checked~.led{display:none}#all:checked~.whole{display:block}"""


def as_html(led: Sequence[ChartRow], rows: Sequence[ChartRow], title: str, note: str) -> str:
    """A run as a page of its own.

    Args:
        led: the turns that are shown at first.
        rows: all turns of the run, which the switch shows.
        title: of the page.
        note: the text above.
    """
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    switch = f'<input type="checkbox" id="all"><label for="all">show all {len(rows)} turns</label>'
    parts = f'<div class="led"><p>{html.escape(heading(led, rows))}</p>{_drawn(led)}</div>'
    if len(led) < len(rows):
        parts = f'{switch}{parts}<div class="whole">{_drawn(rows)}</div>'
    body = f"<h1>{html.escape(title)}</h1><pre>{html.escape(note)}</pre>{parts}"
    return f'<!doctype html><html lang="en">{head}{body}</html>\n'


def _drawn(rows: Sequence[ChartRow]) -> str:
    """These turns as an SVG picture, one below another."""
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
        y, x = 48 + 24 * number, place[row.name]
        parts.append(f'<text class="time" x="4" y="{y + 4}">{row.at:.3f}</text>')
        if row.source and row.source != row.name:
            start = place[row.source]
            end = x + (-8 if start < x else 8)
            parts.append(f'<line class="sent" x1="{start}" y1="{y}" x2="{end}" y2="{y}"/>')
        kind = "crash" if row.crashed else "turn"
        parts.append(f'<rect class="{kind}" x="{x - 6}" y="{y - 8}" width="12" height="16" rx="3"/>')
        after = place[names[-1]] + 30
        text = f'{html.escape(row.what)} <tspan class="state">{html.escape(row.change)}</tspan>'
        parts.append(f'<text x="{after}" y="{y + 4}">{text}</text>')
    parts.append("</svg>")
    return "".join(parts)
