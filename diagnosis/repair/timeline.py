"""A case as a picture: who was touched, when, and what was said of it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from .notices import Story

CASE: Final = "the case"
"""The row of what is about no component alone."""
COLOURS: Final = {
    "RepairBegan": "tab:red",
    "Planned": "tab:blue",
    "ApprovalWanted": "tab:purple",
    "ActionBegan": "tab:orange",
    "ActionEnded": "tab:olive",
    "Undone": "tab:brown",
    "Held": "tab:gray",
    "Repaired": "tab:green",
    "AdviceScored": "tab:green",
    "GaveUp": "black",
}
MOST_WORDS: Final = 90
"""Characters of a sentence that are drawn."""


def draw_story(story: Story, path: Path) -> None:
    """Draw the time line of a case as a PNG: a row for each component, seconds since the case began.

    Raises:
        ImportError: matplotlib is not installed; it is in the extra `programs`.
        OSError: the file cannot be written.
    """
    from matplotlib.figure import Figure  # of the extra `programs`

    began = story.entries[0].time
    rows = list(dict.fromkeys(name for entry in story.entries for name in entry.components or (CASE,)))
    figure = Figure(figsize=(11, 0.4 * len(rows) + 0.28 * len(story.entries) + 1.5), layout="constrained")
    axes = figure.add_subplot(2, 1, 1)
    axes.set_title(f"case {story.case}")
    for entry in story.entries:
        for name in entry.components or (CASE,):
            axes.plot(entry.time - began, rows.index(name), "o", color=COLOURS.get(entry.what, "tab:gray"))
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xlabel("seconds")
    axes.grid(axis="x", alpha=0.3)
    words = figure.add_subplot(2, 1, 2)
    words.axis("off")
    lines = [f"{entry.time - began:8.1f} s   {entry.text[:MOST_WORDS]}" for entry in story.entries]
    words.text(0.0, 1.0, "\n".join(lines), va="top", family="monospace", fontsize=8)
    figure.savefig(path, dpi=120)
