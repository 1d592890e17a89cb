"""What a home keeps of one actor: its inputs, its ended turns, its timers, and the batch that becomes one append."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from ..actors.mail import Ask
from .journal import Entry, Journal
from .records import TICK, Feed

OVERHEAD = 200
"""Bytes an input is counted with besides its payload."""
EXPIRED = 1e-9
"""A deadline that has passed. (Asks forget theirs when they expire.)"""


class Input:
    """One journaled input."""

    __slots__ = (
        "ask",
        "body",
        "chain",
        "deliveries",
        "id",
        "kind",
        "name",
        "origin",
        "positions",
        "sender",
        "time",
        "turn",
    )

    def __init__(self, id: int, kind: str, name: str, body: bytes, when: float, sender: str | None) -> None:
        self.id, self.kind, self.name, self.body, self.time, self.sender = id, kind, name, body, when, sender
        self.ask: Ask | None = None
        self.chain: tuple[tuple[str, int], ...] = ()
        self.turn = 0  # the turn that ended it
        self.deliveries = 0  # deaths of the process in this very turn
        self.origin = ""  # the timer or pipe it comes from
        self.positions: list[int] = []

    def feed(self, turn: int = -1, pipes: tuple[int, ...] = (), *, has_begun: bool = False) -> Feed:
        """As the life gets it; what has begun is finished whatever its deadline."""
        ask = self.ask
        deadline = 0.0 if ask is None or has_begun else ask.deadline or EXPIRED
        origin = self.origin if self.kind == TICK else ""
        return Feed(
            self.id, turn, self.kind, self.name, self.body, self.time, self.sender,
            ask is not None, self.chain, pipes, deadline, origin,
        )  # fmt: skip


class Turn:
    """One ended turn since the last snapshot."""

    __slots__ = ("digests", "input", "status")

    def __init__(self, source: Input, status: str, digests: list[int]) -> None:
        self.input, self.status, self.digests = source, status, digests


class TimerState:
    """A timer of the actor; its clock runs here, whoever lives."""

    __slots__ = ("body", "due", "handle", "interval", "name")

    def __init__(self, name: str, body: bytes, due: float, interval: float) -> None:
        self.name, self.body, self.due, self.interval = name, body, due, interval
        self.handle: asyncio.TimerHandle | None = None


class Batch:
    """What becomes one append, and what happens when it is safe."""

    __slots__ = ("after", "entries", "sinks")

    def __init__(self) -> None:
        self.entries: list[tuple[str, Entry]] = []
        self.sinks: list[list[int]] = []
        self.after: list[Callable[[], None]] = []

    def add(self, path: str, entry: Entry, sink: list[int]) -> None:
        """One more entry; `sink` gets its position."""
        self.entries.append((path, entry))
        self.sinks.append(sink)

    def commit(self, journal: Journal) -> None:
        """Append all of it, then let it take effect."""
        if self.entries and journal.durable:
            for sink, position in zip(self.sinks, journal.append(self.entries), strict=True):
                sink.append(position)
        for effect in self.after:
            effect()
