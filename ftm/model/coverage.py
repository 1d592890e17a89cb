"""The coverage table (Table I of the paper, extended): what each mechanism tolerates, needs and costs."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from itertools import combinations

import msgspec

from .application import Application
from .change_model import Choice, FaultClasses, Resources, label, select
from .mechanism_declaration import FAULTS, NEEDS, Entry, Mechanisms


def built_in_mechanisms() -> Mechanisms:
    """The declarations of the mechanisms that come with the package. They are imported only here: they bring bricks."""
    mechanism = import_module(".mechanism", __package__)
    return [mechanism.find(name) for name in mechanism.BUILT_IN]


class Coverage(msgspec.Struct, frozen=True):
    """The table: one entry per mechanism."""

    entries: tuple[Entry, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """The heads of the columns."""
        return ("mechanism", *FAULTS, *NEEDS, "bandwidth", "CPU", "units", "layer")

    def rows(self) -> list[tuple[str, ...]]:
        """The cells: "x" for what is tolerated, "needed" for what is."""
        return [
            (
                entry.name,
                *("x" if fault in entry.tolerates else "" for fault in FAULTS),
                *("needed" if need in entry.needs else "" for need in NEEDS),
                entry.bandwidth,
                entry.cpu,
                str(entry.units),
                entry.layer,
            )
            for entry in self.entries
        ]

    def text(self) -> str:
        """As a table in Markdown."""
        return table(self.columns, self.rows())

    def __str__(self) -> str:
        return self.text()


class Situation(msgspec.Struct, frozen=True):
    """One line of the selection table: (F, A) and what is chosen."""

    faults: FaultClasses
    application: Application
    best: Choice | None
    why: str


def coverage(mechanisms: Mechanisms | None = None) -> Coverage:
    """The table of what mechanisms tolerate, need and cost."""
    return Coverage(tuple(Entry.of(one) for one in (built_in_mechanisms() if mechanisms is None else mechanisms)))


def selection_table(
    mechanisms: Mechanisms | None = None,
    *,
    faults: tuple[str, ...] = ("crash", "transient_value", "permanent_value"),
    resources: Resources | None = None,
) -> tuple[Situation, ...]:
    """What is chosen for each set of faults, with and without determinism and state access."""
    return tuple(
        _situation(
            FaultClasses(frozenset(chosen)),
            Application("it", is_deterministic=is_same, has_state_access=has_state),
            mechanisms,
            resources or Resources(units=3),
        )
        for count in range(1, len(faults) + 1)
        for chosen in combinations(faults, count)
        for is_same in (True, False)
        for has_state in (True, False)
    )


def selection_text(situations: tuple[Situation, ...]) -> str:
    """The selection table in Markdown."""
    rows = [
        (
            str(one.faults),
            "yes" if one.application.is_deterministic else "no",
            "yes" if one.application.has_state_access else "no",
            label(one.best.layers) if one.best else "none",
        )
        for one in situations
    ]
    return table(("faults", "deterministic", "state access", "chosen"), rows)


def _situation(
    faults: FaultClasses, application: Application, mechanisms: Mechanisms | None, resources: Resources
) -> Situation:
    selection = select(faults, application, resources, mechanisms)
    return Situation(faults, application, selection.best, selection.explain())


def table(columns: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Cells as a Markdown table whose columns line up."""
    widths = [max(len(cell) for cell in column) for column in zip(columns, *rows, strict=True)]
    lines = [_line(columns, widths), "|" + "|".join("-" * (width + 2) for width in widths) + "|"]
    return "\n".join([*lines, *(_line(row, widths) for row in rows)])


def _line(cells: tuple[str, ...], widths: list[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
