"""What all viewers see of a system, and how it differs from what they have seen: pure, and sent as plain rows."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterable
from typing import Any, Final

import msgspec

from ..overview import ActorRow, ProcessUse, SystemLook

SAME_TURN: Final = 0.3
"""Seconds by which the beginning of a turn may seem to move from look to look: its row is the same one."""
MEASURED: Final = 1.0
"""Seconds over which the use of a processor is measured."""
TURNING: Final = re.compile("[\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""Marks that have the text behind them run the other way."""
NOTHING: Final = ActorRow("", "", "", "", 0, 0, 0, "", 0.0, "", (), (), "", False)

Row = ActorRow
"""A row with the moment at which its turn began (Unix time, 0.0: none waits) where a look has how long it takes."""


class RowAdded(msgspec.Struct, frozen=True, array_like=True):
    """A row that is new, or other than before; of a new one the sibling that it follows ("": none, it is the first)."""

    row: Row
    behind: str | None = None


class ProcessNow(msgspec.Struct, frozen=True, array_like=True):
    """What a process uses: its memory in bytes, and its share of one processor in percent, None if not known yet."""

    pid: int
    memory_bytes: int
    cpu_percent: float | None


class PictureChange(msgspec.Struct, frozen=True, omit_defaults=True):
    """How the picture differs from the one before; of `rows` the new ones stand parents before children."""

    now: float
    rows: list[RowAdded] = []
    gone: list[str] = []
    processes: list[ProcessNow] | None = None

    @property
    def is_empty(self) -> bool:
        """Whether nobody needs to be told."""
        return not self.rows and not self.gone and self.processes is None


@dataclasses.dataclass(slots=True)
class _Sample:
    seconds: float
    cpu: dict[int, float]


class Picture:
    """The rows of a system as they were seen last, parents before children."""

    def __init__(self) -> None:
        self.system, self.pid = "", 0
        self.rows: dict[str, Row] = {}
        self.processes: list[ProcessNow] = []
        self._sample: _Sample | None = None

    def take(self, look: SystemLook, now: float) -> PictureChange | None:
        """Take a look at all actors; None: their order is another one, and viewers need the whole picture.

        Args:
            look: at all actors of the system.
            now: the Unix time of it.
        """
        self.system, self.pid = look.system, look.pid
        before, rows = self.rows, {row.path: self._placed(row, now) for row in look.rows}
        gone = [path for path in before if path not in rows]
        is_moved = _orders(rows, before) != _orders(before, rows)
        self.rows = rows
        changed = _changed(before, rows)
        processes = self._used(look)
        return None if is_moved else PictureChange(now, changed, gone, processes)

    def take_some(self, look: SystemLook, asked: Collection[str], now: float) -> PictureChange:
        """Take a look at some actors only; those who were asked about and are not in it are gone, with all below."""
        seen = {row.path: self._placed(row, now) for row in look.rows}
        ends = {path for path in asked if path in self.rows and path not in seen}
        gone = [path for path in self.rows if _is_below(path, ends)] if ends else []
        rows: list[RowAdded] = []
        for path in gone:
            del self.rows[path]
        last = {} if seen.keys() <= self.rows.keys() else {path.rpartition("/")[0]: path for path in self.rows}
        for path, row in sorted(seen.items(), key=lambda one: one[0].count("/")):
            known = self.rows.get(path)
            if known is None:
                above = path.rpartition("/")[0]
                if above and above not in self.rows:
                    continue  # Its supervisor is new, too, and is seen by the next look at all.
                rows.append(RowAdded(row, last.get(above, "")))
                last[above] = path
            elif known != row:
                rows.append(RowAdded(row))
            self.rows[path] = row
        return PictureChange(now, rows, gone)

    def _placed(self, row: ActorRow, now: float) -> Row:
        """The row with the moment at which its turn began: what only grows with time is no change."""
        if not row.turn:
            return row
        began, known = now - row.turn_seconds, self.rows.get(row.path, NOTHING)
        if known.turn == row.turn and abs(known.turn_seconds - began) < SAME_TURN:
            began = known.turn_seconds
        return msgspec.structs.replace(row, turn_seconds=began)

    def _used(self, look: SystemLook) -> list[ProcessNow] | None:
        """What processes use, once a second; None: it is as it was, or was told a moment ago."""
        sample, cpu = self._sample, {use.pid: use.cpu_seconds for use in look.processes}
        is_known = {one.pid for one in self.processes} == cpu.keys()
        if sample is not None and is_known and look.seconds - sample.seconds < MEASURED:
            return None
        then = sample if sample is not None else _Sample(look.seconds, {})
        told = [_now(use, then, look.seconds) for use in look.processes]
        self._sample = _Sample(look.seconds, cpu)
        is_same, self.processes = told == self.processes, told
        return None if is_same else told


def _now(use: ProcessUse, then: _Sample, seconds: float) -> ProcessNow:
    passed = seconds - then.seconds
    is_measured = use.pid in then.cpu and passed > 0
    percent = round(100.0 * (use.cpu_seconds - then.cpu[use.pid]) / passed, 1) if is_measured else None
    return ProcessNow(use.pid, round(use.memory_bytes, -5), percent)


def _is_below(path: str, ends: set[str]) -> bool:
    """Whether it is one of these, or below one of them."""
    while path:
        if path in ends:
            return True
        path = path.rpartition("/")[0]
    return False


def _orders(paths: Iterable[str], among: Collection[str]) -> dict[str, list[str]]:
    """Of each supervisor the order of its children, as far as they are among these."""
    orders: dict[str, list[str]] = {}
    for path in paths:
        if path in among:
            orders.setdefault(path.rpartition("/")[0], []).append(path)
    return orders


def _changed(before: dict[str, Row], rows: dict[str, Row]) -> list[RowAdded]:
    """The rows that are other ones; each new one with the sibling before it."""
    changed: list[RowAdded] = []
    last: dict[str, str] = {}
    for path, row in rows.items():
        above = path.rpartition("/")[0]
        known = before.get(path)
        if known is None:
            changed.append(RowAdded(row, last.get(above, "")))
        elif known != row:
            changed.append(RowAdded(row))
        last[above] = path
    return changed


def plain(value: Any) -> bytes:
    """A value as JSON; what JSON has no word for is told as text.

    Marks that turn the direction of what stands behind them are shown by their numbers: a text of an actor may not
    turn round the words of others.
    """
    data = msgspec.json.encode(value, enc_hook=str)
    if data.isascii():
        return data
    return TURNING.sub(lambda mark: f"⟨U+{ord(mark[0]):04X}⟩", data.decode()).encode()
